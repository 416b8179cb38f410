"""Saved panoramas, with their other outputs, as frames of the page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import COLOUR_FORMATS, DEPTH_STEPS, image_size, image_text, read_image
from lidar2pano.formats.json_files import parse_json, validated
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import open_path
from lidar2pano.name_order import sort_names
from lidar2pano.panorama import STEM_ENDINGS, VIEW_KEYWORD
from lidar2pano.viewer.page import PageFrame
from lidar2pano.views import MOST_PIXELS, VIEWS, View

ENDINGS = tuple(ending for ending, _ in COLOUR_FORMATS.values())
PROPORTION_TOLERANCE = 0.02


def panorama_files(path: Path) -> list[Path]:
    """Return the panoramas of a path: an image itself, or those of a folder in order of their names; else []."""
    if path.suffix in ENDINGS and not path.is_dir():
        return [path]
    if not path.is_dir():
        return []
    try:
        files = sort_names(file for file in path.iterdir() if file.suffix in ENDINGS and not file.is_dir())
    except OSError as error:
        raise InputError(f"{path}: cannot be looked into ({error.strerror}); ask for permission") from error
    return [file for file in files if not file.stem.endswith(STEM_ENDINGS) and not file.name.startswith(".")]


def read_frame(path: Path) -> PageFrame:
    """Read the panorama of an image, with its other outputs: .segments.png, .depth.png,
    .confidence.png, .source.png, .ply.

    Raises InputError for a damaged file and for any other image.
    """
    view = saved_view(path)
    parts = ("segments", "depth", "confidence", "source")
    segments, steps, levels, source = (_beside(path, f".{part}.png") for part in parts)
    cloud = _points(path.with_suffix(".ply"))
    return PageFrame(
        name=path.stem,
        view=view,
        colour=read_image(path, "RGB"),
        segments=None if segments is None else segments.astype(np.uint8),
        depth_m=None if steps is None else steps.astype(np.float32) / DEPTH_STEPS,
        confidence=None if levels is None else levels.astype(np.float32) / np.iinfo(np.uint8).max,
        xyz=None if cloud is None else cloud.xyz.astype(np.float32),
        remission=None if cloud is None or cloud.intensity is None else cloud.intensity.astype(np.float32),
        source=source.astype(np.uint8) if source is not None and source.any() else None,
    )


def saved_view(path: Path) -> View:
    """Return the view of a panorama's file: as its text says; else the usual one of the same proportions.

    Raises InputError for any other image.
    """
    width, height = image_size(path)
    try:
        written = validated(View, parse_json(image_text(path)[VIEW_KEYWORD], str(path)), str(path))
        return replace(written, rows=height, columns=width)
    except (KeyError, ValueError):  # no text, or another program's
        pass
    usual = VIEWS["panorama"]
    if abs(width * usual.rows / (height * usual.columns) - 1) > PROPORTION_TOLERANCE:
        raise InputError(
            f"{path}: {width}x{height} pixels are no panorama ({usual.columns // usual.rows} times as wide as high);"
            " name what `translate` wrote"
        )
    try:
        return replace(usual, rows=height, columns=width)
    except ValueError:
        raise InputError(f"{path}: {width}x{height} pixels are too many ({MOST_PIXELS} at most); shrink it") from None


def _beside(path: Path, ending: str) -> np.ndarray | None:
    file = path.with_name(path.stem + ending)
    if not file.is_file():
        return None
    values = read_image(file)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.integer):
        raise InputError(f"{file}: has colours where numbers belong; write it again with `translate --save all`")
    return values


def _points(path: Path) -> PointCloud | None:
    """Read the points saved with the panorama, in the sensor's frame, metres; None without a file."""
    return open_path(path).cloud(path) if path.is_file() else None
