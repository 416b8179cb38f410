"""Pictures of a reproduction: what every row made of a few frames, side by side as in the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.data.truths import Truth, Truths
from lidar2pano.evaluate import Measures, Seen, System
from lidar2pano.evaluate.evaluation import ask
from lidar2pano.formats.image_files import write_png, write_whole
from lidar2pano.labels import COMMON15

SHOWN = 3  # frames of the split that pictures are kept of
WIDTH = 620  # pixels of a picture in a sheet
HEAD = 18  # pixels of a heading

# sheet -> what it shows and of which rows; the truth comes first
SHEETS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "segments": (("colour", "segments"), ("truth", "titan", "pix2pix", "titan-pano")),
    "without-segments": (("colour",), ("truth", "titan-no-segments", "pix2pix-no-segments", "scunet")),
    "ablations": (("colour", "segments"), ("truth", "titan", "titan-no-lovasz", "titan-no-range", "ceiling")),
    "panoramas": (("panorama", "panorama-segments"), ("truth", "titan-pano", "titan-pano-vid2vid")),
}


def keep_pictures(folder: Path, one: System, found: Truths, measures: Measures) -> None:
    """Write what a system makes of the first, middle and last frames: NN.<what>.png in `folder`; the truth beside."""
    for number, index in enumerate(shown(len(found))):
        truth = found[index]
        _, seen = one.see(ask(truth, measures))
        _write(folder, number, _answers(seen))
        _write(folder.parent / "truth", number, _truths(truth))


def shown(frames: int) -> list[int]:
    """Indices of the frames that pictures are kept of: SHOWN, evenly over the split."""
    return sorted({round(part) for part in np.linspace(0, frames - 1, SHOWN)}) if frames else []


def _answers(seen: Seen) -> dict[str, np.ndarray | None]:
    around = seen.panorama
    return {
        "colour": seen.colour,
        "segments": seen.ids if seen.ids is None else COMMON15.paint(np.asarray(seen.ids)),
        "panorama": around.colour if around is not None and seen.painted else None,
        "panorama-segments": COMMON15.paint(around.segments) if around is not None else None,
    }


def _truths(truth: Truth) -> dict[str, np.ndarray | None]:
    around = truth.panorama
    return {
        "colour": truth.picture,
        "segments": None if truth.camera_ids is None else COMMON15.paint(_known(truth.camera_ids)),
        "panorama": around.colour if around is not None else None,
        "panorama-segments": (
            COMMON15.paint(_known(around.ids)) if around is not None and around.ids is not None else None
        ),
    }


def _known(ids: np.ndarray) -> np.ndarray:
    """Unsure pixels are unlabeled."""
    return np.where(ids < len(COMMON15), ids, 0).astype(np.uint8)


def _write(folder: Path, number: int, pictures: dict[str, np.ndarray | None]) -> None:
    for what, picture in pictures.items():
        if picture is not None:
            write_whole(folder / f"{number:02d}.{what}.png", lambda path, picture=picture: write_png(path, picture))


def write_sheets(pictures: Path, out: Path, names: dict[str, str]) -> list[Path]:
    """Write the sheets of which there are pictures as JPEG into `out`; names: row -> what stands above its column."""
    written = []
    for sheet, (kinds, rows) in SHEETS.items():
        columns = [row for row in rows if any((pictures / row).glob("*.png"))]
        if len(columns) < 2:
            continue
        lines = [_line(pictures, columns, number, kind) for number in range(SHOWN) for kind in kinds]
        lines = [line for line in lines if line is not None]
        if not lines:
            continue
        heads = [names.get(row, row) for row in columns]
        picture = _headed(np.concatenate(lines), heads)
        path = out / f"{sheet}.jpg"
        write_whole(path, lambda to, shown=picture: Image.fromarray(shown).save(to, format="JPEG", quality=88))
        written.append(path)
    return written


def _line(pictures: Path, rows: Sequence[str], number: int, kind: str) -> np.ndarray | None:
    """One frame's pictures of a kind, side by side; None where only the truth has one."""
    found = [_read(pictures / row / f"{number:02d}.{kind}.png") for row in rows]
    given = [picture for picture in found if picture is not None]
    if len(given) < 2:
        return None
    height = max(picture.shape[0] for picture in given)
    blank = np.full((height, WIDTH, 3), 255, dtype=np.uint8)
    return np.concatenate([_padded(blank if one is None else one, height) for one in found], 1)


def _padded(picture: np.ndarray, height: int) -> np.ndarray:
    gap = ((0, height - picture.shape[0]), (0, 0), (0, 0))
    return np.pad(picture, gap, constant_values=255)


def _read(path: Path) -> np.ndarray | None:
    if not path.is_file():
        return None
    with Image.open(path) as picture:
        whole = picture.convert("RGB")
        return np.array(whole.resize((WIDTH, round(WIDTH * whole.height / whole.width)), Image.Resampling.LANCZOS))


def _headed(picture: np.ndarray, heads: Iterable[str]) -> np.ndarray:
    strip = Image.new("RGB", (picture.shape[1], HEAD), "white")
    draw = ImageDraw.Draw(strip)
    for number, head in enumerate(heads):
        draw.text((number * WIDTH + 4, 3), head, fill="black")
    return np.concatenate([np.array(strip), picture])
