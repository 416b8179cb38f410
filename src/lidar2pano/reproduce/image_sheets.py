"""Images of a reproduction: every row's predictions for a few frames, side by side as in the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame, FrameList
from lidar2pano.evaluate import MetricConfig, Prediction, System
from lidar2pano.evaluate.evaluation import system_input
from lidar2pano.formats.image_files import write_png, write_whole
from lidar2pano.labels import COMMON15
from lidar2pano.pipeline import Pipeline

SAMPLES = 3  # frames of the split whose images are kept
WIDTH = 620  # pixels of an image in a sheet
HEAD = 18  # pixels of a heading

# sheet -> contents of its lines, and rows of the tables as columns; the ground truth comes first
SHEETS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "segments": (("colour", "segments"), ("ground-truth", "titan", "pix2pix", "titan-pano")),
    "without-segments": (("colour",), ("ground-truth", "titan-no-segments", "pix2pix-no-segments", "scunet")),
    "ablations": (("colour", "segments"), ("ground-truth", "titan", "titan-no-lovasz", "titan-no-range", "ceiling")),
    "panoramas": (("panorama", "panorama-segments"), ("ground-truth", "titan", "titan-pano", "titan-pano-vid2vid")),
}


def write_images(
    folder: Path, one: System, frames: FrameList, config: MetricConfig, around: Pipeline | None = None
) -> None:
    """Write a system's predictions for the first, middle and last frames: NN.<content>.png; the ground truth beside.

    around  paints the panoramas of a system that predicts the camera's image alone.
    """
    for number, index in enumerate(sample_indices(len(frames))):
        frame = frames[index]
        _, prediction = one.predict(system_input(frame, config))
        if around is not None:
            prediction = replace(prediction, panorama=around(frame.scan))
        _write(folder, number, _predicted_images(prediction))
        _write(folder.parent / "ground-truth", number, _ground_truth_images(frame))


def sample_indices(frames: int) -> list[int]:
    """Indices of the frames whose images are kept: SAMPLES, evenly over the split."""
    return sorted({round(part) for part in np.linspace(0, frames - 1, SAMPLES)}) if frames else []


def _predicted_images(prediction: Prediction) -> dict[str, np.ndarray | None]:
    around = prediction.panorama
    return {
        "colour": prediction.image,
        "segments": _painted(prediction.camera_labels),
        "panorama": around.colour if around is not None and prediction.painted else None,
        "panorama-segments": _painted(around.segments) if around is not None else None,
    }


def _ground_truth_images(frame: Frame) -> dict[str, np.ndarray | None]:
    around, labels = frame.panorama, frame.camera_labels
    return {
        "colour": frame.image,
        "segments": None if labels is None else _painted(CITYSCAPES_TO_COMMON15[labels]),
        "panorama": around.image if around is not None else None,
        "panorama-segments": _painted(around.labels) if around is not None else None,
    }


def _painted(ids: np.ndarray | None) -> np.ndarray | None:
    """Class colours; unknown pixels are unlabeled."""
    return None if ids is None else COMMON15.paint(np.where(ids < len(COMMON15), ids, 0).astype(np.uint8))


def _write(folder: Path, number: int, images: dict[str, np.ndarray | None]) -> None:
    for content, image in images.items():
        if image is not None:
            write_whole(folder / f"{number:02d}.{content}.png", lambda path, image=image: write_png(path, image))


def write_sheets(images: Path, out: Path, names: dict[str, str]) -> list[Path]:
    """Write the sheets for which there are images as JPEG into `out`; names: row -> heading of its column."""
    written = []
    for sheet, (contents, rows) in SHEETS.items():
        columns = [row for row in rows if any((images / row).glob("*.png"))]
        if len(columns) < 2:
            continue
        lines = [_line(images, columns, number, content) for number in range(SAMPLES) for content in contents]
        lines = [line for line in lines if line is not None]
        if not lines:
            continue
        heads = [names.get(row, row) for row in columns]
        image = _headed(np.concatenate(lines), heads)
        path = out / f"{sheet}.jpg"
        write_whole(path, lambda to, sheet=image: Image.fromarray(sheet).save(to, format="JPEG", quality=88))
        written.append(path)
    return written


def _line(images: Path, rows: Sequence[str], number: int, content: str) -> np.ndarray | None:
    """One frame's images of one content, side by side; None where there are fewer than two."""
    found = [_read(images / row / f"{number:02d}.{content}.png") for row in rows]
    given = [image for image in found if image is not None]
    if len(given) < 2:
        return None
    height = max(image.shape[0] for image in given)
    blank = np.full((height, WIDTH, 3), 255, dtype=np.uint8)
    return np.concatenate([_padded(blank if one is None else one, height) for one in found], 1)


def _padded(image: np.ndarray, height: int) -> np.ndarray:
    gap = ((0, height - image.shape[0]), (0, 0), (0, 0))
    return np.pad(image, gap, constant_values=255)


def _read(path: Path) -> np.ndarray | None:
    if not path.is_file():
        return None
    with Image.open(path) as file:
        whole = file.convert("RGB")
        return np.array(whole.resize((WIDTH, round(WIDTH * whole.height / whole.width)), Image.Resampling.LANCZOS))


def _headed(image: np.ndarray, heads: Iterable[str]) -> np.ndarray:
    strip = Image.new("RGB", (image.shape[1], HEAD), "white")
    draw = ImageDraw.Draw(strip)
    for number, head in enumerate(heads):
        draw.text((number * WIDTH + 4, 3), head, fill="black")
    return np.concatenate([np.array(strip), image])
