"""The rows of the tables of Cortinhal et al. 2021 and of TITAN-Next with their published values, and our own rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from lidar2pano.errors import InputError, closest

LEVELS = ("1024", "512", "256", "128", "64", "32", "16")


def _image_values(ssim: float, fid: float, swd: tuple[float, ...], mean: float) -> dict[str, float]:
    levels = {f"swd_pairs_{level}": value for level, value in zip(LEVELS, swd, strict=True)}
    return {"ssim": ssim, "fid": fid, **levels, "swd_pairs": mean}


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """A system of the tables.

    name      as in the paper;  parts: names of recipes (without -mini) in the order of the chain; "oracle": the
              camera's ground-truth labels.
    segments  whether it is in the tables of segmentation (1, and 3 of the supplement).
    paper     published values of table 2, by our names;  miou: published mIoU in percent, None if there is none;
              classes: published IoU of the 14 classes in percent, empty if there are none.
    source    the publication of these values.
    """

    name: str
    parts: tuple[str, ...]
    segments: bool = False
    paper: Mapping[str, float] = field(default_factory=dict)
    miou: float | None = None
    classes: tuple[float, ...] = ()
    source: str = "the paper"


ROWS: dict[str, PaperRow] = {
    "pix2pix": PaperRow(
        name="Pix2Pix -> Vid2Vid",
        parts=("pix2pix-segments", "vid2vid"),
        segments=True,
        paper=_image_values(0.2543, 73.476, (2.29, 2.22, 2.18, 2.15, 2.11, 2.13, 3.95), 2.59),
        miou=12.5,
        classes=(8.8, 0, 0, 0, 0, 0, 57.7, 15.7, 32.8, 12.5, 32.7, 14.8, 0.5, 0),
    ),
    "titan": PaperRow(
        name="TITAN-Net -> Vid2Vid",
        parts=("titan", "vid2vid"),
        segments=True,
        paper=_image_values(0.2610, 61.914, (2.22, 2.18, 2.15, 2.11, 2.08, 2.13, 3.78), 2.38),
        miou=31.1,
        classes=(68.2, 9.9, 7.6, 7.6, 0, 7.3, 75.4, 48.3, 62.9, 33.6, 60.1, 49.9, 2, 3.7),
    ),
    "titan-no-lovasz": PaperRow(
        name="TITAN-Net w/o Lovasz -> Vid2Vid",
        parts=("titan-no-lovasz", "vid2vid"),
        segments=True,
        miou=26.2,
        classes=(60.5, 0, 0, 0.3, 0, 0.05, 78.0, 43.6, 56.9, 33.0, 52.8, 42.9, 0.08, 0.07),
    ),
    "scunet": PaperRow(
        name="SC-UNET",
        parts=("scunet",),
        paper=_image_values(0.3158, 261.282, (2.65, 2.56, 2.36, 2.20, 2.14, 2.14, 4.07), 2.59),
    ),
    "pix2pix-no-segments": PaperRow(
        name="Pix2Pix w/o SegMap",
        parts=("pix2pix-rgb",),
        paper=_image_values(0.2006, 209.150, (2.43, 2.35, 2.31, 2.31, 2.35, 2.42, 4.76), 2.71),
    ),
    "titan-no-segments": PaperRow(
        name="TITAN-Net w/o SegMap",
        parts=("titan-no-segments",),
        paper=_image_values(0.3692, 326.298, (3.24, 3.14, 2.98, 2.61, 2.23, 2.10, 3.94), 2.89),
    ),
    "titan-no-range": PaperRow(
        name="TITAN-Net w/o range view -> Vid2Vid",
        parts=("titan-no-range", "vid2vid"),
        segments=True,
        paper=_image_values(0.2442, 76.932, (2.31, 2.23, 2.18, 2.16, 2.15, 2.22, 4.47), 2.53),
    ),
    "titan-next": PaperRow(
        name="TITAN-Next -> Vid2Vid",
        parts=("titan-next", "vid2vid"),
        segments=True,
        paper={"fid": 29.56, "swd_pairs": 1.82},
        miou=54.8,
        source="its follow-up",
    ),
    "titan-pano": PaperRow(name="titan-pano -> latent painter", parts=("titan-pano", "latent-painter"), segments=True),
    "titan-pano-vid2vid": PaperRow(name="titan-pano -> Vid2Vid", parts=("titan-pano", "vid2vid"), segments=True),
    "ceiling": PaperRow(
        name="ground-truth labels -> Vid2Vid (oracle)",
        parts=("oracle", "vid2vid"),
        paper=_image_values(0.4089, 20.3694, (2.10, 1.99, 1.86, 1.71, 1.56, 1.41, 1.70), 1.76),
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
    """An ordering reported by the paper: `first` is better than `second` in `metric` of the camera's image."""

    text: str
    metric: str
    first: str
    second: str
    higher: bool = False


CLAIMS = (
    Claim(text="TITAN-Net beats Pix2Pix in mIoU", metric="miou", first="titan", second="pix2pix", higher=True),
    Claim(text="Lovasz-Softmax raises mIoU", metric="miou", first="titan", second="titan-no-lovasz", higher=True),
    Claim(text="TITAN-Net beats Pix2Pix in SWD", metric="swd_pairs", first="titan", second="pix2pix"),
    Claim(text="TITAN-Net beats SC-UNET in SWD", metric="swd_pairs", first="titan", second="scunet"),
    Claim(text="TITAN-Net beats Pix2Pix in FID", metric="fid", first="titan", second="pix2pix"),
    Claim(text="label maps lower TITAN-Net's SWD", metric="swd_pairs", first="titan", second="titan-no-segments"),
    Claim(text="label maps lower Pix2Pix' SWD", metric="swd_pairs", first="pix2pix", second="pix2pix-no-segments"),
    Claim(text="the range view lowers SWD", metric="swd_pairs", first="titan", second="titan-no-range"),
    Claim(text="SC-UNET beats TITAN-Net in SSIM", metric="ssim", first="scunet", second="titan", higher=True),
    Claim(
        text="without label maps TITAN-Net has the best SSIM",
        metric="ssim",
        first="titan-no-segments",
        second="scunet",
        higher=True,
    ),
    Claim(text="the oracle has the lowest SWD", metric="swd_pairs", first="ceiling", second="titan"),
)


def chosen(names: str) -> dict[str, PaperRow]:
    """Return the rows of a list "titan,scunet"; all if it is empty; InputError for an unknown name."""
    listed = [name.strip() for name in names.split(",") if name.strip()]
    for name in listed:
        if name not in ROWS:
            raise InputError(f"--rows: no row {name!r}{closest(name, ROWS)}")
    return {name: row for name, row in ROWS.items() if not listed or name in listed}
