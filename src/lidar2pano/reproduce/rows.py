"""The rows of the paper's tables, with the paper's own figures (Cortinhal et al. 2021), and ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from lidar2pano.errors import InputError, closest

LEVELS = ("1024", "512", "256", "128", "64", "32", "16")


def _pictures(ssim: float, fid: float, swd: tuple[float, ...], mean: float) -> dict[str, float]:
    levels = {f"swd_{level}": value for level, value in zip(LEVELS, swd, strict=True)}
    return {"ssim": ssim, "fid": fid, **levels, "swd": mean}


def _classes(*values: float) -> tuple[float, ...]:
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One system of the tables.

    name      as the paper has it;  parts: names of recipes (without -mini) in the order of the chain; "truth": the
              camera's own classes.
    segments  whether it is in the tables of segments (1, and 3 of the supplement);  pictures: in table 2.
    paper     the paper's figures of table 2, by our names;  miou: its mIoU in percent, None where it has none;
              classes: its IoU of the 14 classes in percent.
    """

    name: str
    parts: tuple[str, ...]
    segments: bool = False
    pictures: bool = True
    paper: Mapping[str, float] = field(default_factory=dict)
    miou: float | None = None
    classes: tuple[float, ...] = ()


ROWS: dict[str, Row] = {
    "pix2pix": Row(
        name="Pix2Pix -> Vid2Vid",
        parts=("pix2pix-segments", "vid2vid"),
        segments=True,
        paper=_pictures(0.2543, 73.476, (2.29, 2.22, 2.18, 2.15, 2.11, 2.13, 3.95), 2.59),
        miou=12.5,
        classes=_classes(8.8, 0, 0, 0, 0, 0, 57.7, 15.7, 32.8, 12.5, 32.7, 14.8, 0.5, 0),
    ),
    "titan": Row(
        name="TITAN-Net -> Vid2Vid",
        parts=("titan", "vid2vid"),
        segments=True,
        paper=_pictures(0.2610, 61.914, (2.22, 2.18, 2.15, 2.11, 2.08, 2.13, 3.78), 2.38),
        miou=31.1,
        classes=_classes(68.2, 9.9, 7.6, 7.6, 0, 7.3, 75.4, 48.3, 62.9, 33.6, 60.1, 49.9, 2, 3.7),
    ),
    "titan-no-lovasz": Row(
        name="TITAN-Net w/o Lovasz -> Vid2Vid",
        parts=("titan-no-lovasz", "vid2vid"),
        segments=True,
        miou=26.2,
        classes=_classes(60.5, 0, 0, 0.3, 0, 0.05, 78.0, 43.6, 56.9, 33.0, 52.8, 42.9, 0.08, 0.07),
    ),
    "scunet": Row(
        name="SC-UNET",
        parts=("scunet",),
        paper=_pictures(0.3158, 261.282, (2.65, 2.56, 2.36, 2.20, 2.14, 2.14, 4.07), 2.59),
    ),
    "pix2pix-no-segments": Row(
        name="Pix2Pix w/o SegMap",
        parts=("pix2pix-rgb",),
        paper=_pictures(0.2006, 209.150, (2.43, 2.35, 2.31, 2.31, 2.35, 2.42, 4.76), 2.71),
    ),
    "titan-no-segments": Row(
        name="TITAN-Net w/o SegMap",
        parts=("titan-no-segments",),
        paper=_pictures(0.3692, 326.298, (3.24, 3.14, 2.98, 2.61, 2.23, 2.10, 3.94), 2.89),
    ),
    "titan-no-range": Row(
        name="TITAN-Net w/o range view -> Vid2Vid",
        parts=("titan-no-range", "vid2vid"),
        segments=True,
        paper=_pictures(0.2442, 76.932, (2.31, 2.23, 2.18, 2.16, 2.15, 2.22, 4.47), 2.53),
    ),
    "titan-next": Row(name="TITAN-Next -> Vid2Vid", parts=("titan-next", "vid2vid"), segments=True),
    "titan-pano": Row(name="titan-pano -> painter", parts=("titan-pano", "painter"), segments=True),
    "titan-pano-vid2vid": Row(name="titan-pano -> Vid2Vid", parts=("titan-pano", "vid2vid"), segments=True),
    "ceiling": Row(
        name="camera's classes -> Vid2Vid (ceiling)",
        parts=("truth", "vid2vid"),
        paper=_pictures(0.4089, 20.3694, (2.10, 1.99, 1.86, 1.71, 1.56, 1.41, 1.70), 1.76),
    ),
}

# Milliseconds on a Quadro RTX 6000 for the front view alone (section 4.6).
PAPER_TIMES = {
    "SalsaNext": 40.79,
    "SD-Net": 198.75,
    "TITAN-Net": 42.15,
    "Vid2Vid (376 x 1241)": 123.72,
    "Pix2Pix": 22.48,
    "SC-UNET": 87.72,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """An ordering that the paper reports: `first` is better than `second` by `figure` of the camera's sector."""

    says: str
    figure: str
    first: str
    second: str
    higher: bool = False


CLAIMS = (
    Claim(says="TITAN-Net beats Pix2Pix in mIoU", figure="miou", first="titan", second="pix2pix", higher=True),
    Claim(says="Lovasz-Softmax raises mIoU", figure="miou", first="titan", second="titan-no-lovasz", higher=True),
    Claim(says="TITAN-Net beats Pix2Pix in SWD", figure="swd", first="titan", second="pix2pix"),
    Claim(says="TITAN-Net beats SC-UNET in SWD", figure="swd", first="titan", second="scunet"),
    Claim(says="TITAN-Net beats Pix2Pix in FID", figure="fid", first="titan", second="pix2pix"),
    Claim(says="segments lower TITAN-Net's SWD", figure="swd", first="titan", second="titan-no-segments"),
    Claim(says="segments lower Pix2Pix' SWD", figure="swd", first="pix2pix", second="pix2pix-no-segments"),
    Claim(says="the range view lowers SWD", figure="swd", first="titan", second="titan-no-range"),
    Claim(says="SC-UNET beats TITAN-Net in SSIM", figure="ssim", first="scunet", second="titan", higher=True),
    Claim(
        says="without segments TITAN-Net has the best SSIM",
        figure="ssim",
        first="titan-no-segments",
        second="scunet",
        higher=True,
    ),
    Claim(says="the ceiling has the lowest SWD", figure="swd", first="ceiling", second="titan"),
)


def chosen(names: str) -> dict[str, Row]:
    """Rows of a list "titan,scunet"; all where it is empty; InputError for an unknown name."""
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    for name in wanted:
        if name not in ROWS:
            raise InputError(f"--rows: no row {name!r}{closest(name, ROWS)}")
    return {name: row for name, row in ROWS.items() if not wanted or name in wanted}
