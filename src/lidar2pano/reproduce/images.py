"""Images of a reproduction: predictions side by side as in the paper's figures, and training curves."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame, FrameList, evenly_spaced
from lidar2pano.evaluate import MetricConfig, Prediction, System
from lidar2pano.evaluate.evaluation import system_input
from lidar2pano.formats.image_files import read_image, write_png, write_whole
from lidar2pano.labels import COMMON15
from lidar2pano.pipeline import Pipeline

SAMPLES = 3  # frames of the split whose images are kept
WIDTH = 620  # pixels of an image in a sheet
HEAD = 18  # pixels of a heading
Curve = list[tuple[int, float]]  # step, value

# sheet -> contents of its lines, and rows of the tables as columns; the ground truth comes first
SHEETS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "segments": (("colour", "segments"), ("ground-truth", "titan", "pix2pix", "titan-pano")),
    "without-segments": (("colour",), ("ground-truth", "titan-no-segments", "pix2pix-no-segments", "scunet")),
    "ablations": (("colour", "segments"), ("ground-truth", "titan", "titan-no-lovasz", "titan-no-range", "ceiling")),
    "panoramas": (("panorama", "panorama-segments"), ("ground-truth", "titan", "titan-pano", "titan-pano-vid2vid")),
}


def write_images(
    folder: Path, system: System, frames: FrameList, config: MetricConfig, painter: Pipeline | None = None
) -> None:
    """Write a system's predictions for the first, middle and last frames: NN.<content>.png; the ground truth beside.

    painter  paints the panoramas of a system that predicts the camera's image alone.
    """
    for number, index in enumerate(evenly_spaced(len(frames), SAMPLES)):
        frame = frames[index]
        _, prediction = system.predict(system_input(frame, config))
        if painter is not None:
            prediction = replace(prediction, panorama=painter(frame.scan))
        for subfolder, images in (
            (folder, _predicted_images(prediction)),
            (folder.parent / "ground-truth", _ground_truth_images(frame)),
        ):
            for content, image in images.items():
                if image is not None:
                    path = subfolder / f"{number:02d}.{content}.png"
                    write_whole(path, lambda temporary, image=image: write_png(temporary, image))


def _predicted_images(prediction: Prediction) -> dict[str, np.ndarray | None]:
    panorama = prediction.panorama
    return {
        "colour": prediction.image,
        "segments": _painted(prediction.camera_labels),
        "panorama": panorama.colour if panorama is not None and prediction.painted else None,
        "panorama-segments": _painted(panorama.segments) if panorama is not None else None,
    }


def _ground_truth_images(frame: Frame) -> dict[str, np.ndarray | None]:
    panorama, labels = frame.panorama, frame.camera_labels
    return {
        "colour": frame.image,
        "segments": None if labels is None else _painted(CITYSCAPES_TO_COMMON15[labels]),
        "panorama": panorama.image if panorama is not None else None,
        "panorama-segments": _painted(panorama.labels) if panorama is not None else None,
    }


def _painted(ids: np.ndarray | None) -> np.ndarray | None:
    """Return class colours; unknown pixels are unlabeled."""
    return None if ids is None else COMMON15.paint(np.where(ids < len(COMMON15), ids, 0).astype(np.uint8))


# --- sheets -----------------------------------------------------------------------------------------------------------


def write_sheets(images: Path, out: Path, names: dict[str, str]) -> list[Path]:
    """Write the sheets for which there are images as JPEG into `out`; names: row -> heading of its column."""
    written = []
    for title, (contents, rows) in SHEETS.items():
        columns = [row for row in rows if any((images / row).glob("*.png"))]
        lines = [_line(images, columns, number, content) for number in range(SAMPLES) for content in contents]
        lines = [line for line in lines if line is not None]
        if len(columns) < 2 or not lines:
            continue
        sheet = np.concatenate([_headings([names.get(row, row) for row in columns]), *lines])
        path = out / f"{title}.jpg"
        write_whole(path, lambda temporary, sheet=sheet: Image.fromarray(sheet).save(temporary, "JPEG", quality=88))
        written.append(path)
    return written


def _line(images: Path, rows: Sequence[str], number: int, content: str) -> np.ndarray | None:
    """Return one frame's images of one content, side by side; None if there are fewer than two."""
    row_images = [_read(images / row / f"{number:02d}.{content}.png") for row in rows]
    heights = [image.shape[0] for image in row_images if image is not None]
    if len(heights) < 2:
        return None
    blank = np.zeros((0, WIDTH, 3), dtype=np.uint8)
    columns = [blank if image is None else image for image in row_images]
    padding = [((0, max(heights) - len(image)), (0, 0), (0, 0)) for image in columns]
    return np.concatenate([np.pad(*pair, constant_values=255) for pair in zip(columns, padding, strict=True)], 1)


def _read(path: Path) -> np.ndarray | None:
    if not path.is_file():
        return None
    image = Image.fromarray(read_image(path, "RGB"))
    return np.array(image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS))


def _headings(names: Iterable[str]) -> np.ndarray:
    """Return a strip with the columns' names."""
    titles = list(names)
    strip = Image.new("RGB", (WIDTH * len(titles), HEAD), "white")
    draw = ImageDraw.Draw(strip)
    for number, title in enumerate(titles):
        draw.text((number * WIDTH + 4, 3), title, fill="black")
    return np.array(strip)


# --- training curves --------------------------------------------------------------------------------------------------


def scalars(run: Path) -> dict[str, Curve]:
    """Return tag -> (step, value) of a run's TensorBoard files; empty if it has none."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = run / "tensorboard"
    if not folder.is_dir():
        return {}
    logging.getLogger("tensorboard").setLevel(logging.WARNING)  # it logs every file that it has read to its end
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def write_curves(runs: dict[str, Path], path: Path) -> Path | None:
    """Draw every run's losses into one PNG, a panel a run; None if there is nothing to draw."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    panels = {name: losses for name, run in runs.items() if (losses := _losses(scalars(run)))}
    if not panels:
        return None
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(4 * columns, 2.6 * rows), squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.axis("off")
    for axes, (name, losses) in zip(grid.flat, panels.items(), strict=False):
        for tag, curve in losses.items():
            axes.plot(*zip(*curve, strict=True), label=tag, linewidth=1)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.legend(fontsize=6)
    figure.tight_layout()
    try:
        return write_whole(path, lambda temporary: figure.savefig(temporary, format="png", dpi=80))
    finally:
        plt.close(figure)


def _losses(curves: dict[str, Curve]) -> dict[str, Curve]:
    """Return the losses (rates and validation have a slash in their names) with two points or more."""
    return {tag: curve for tag, curve in curves.items() if len(curve) > 1 and "/" not in tag}
