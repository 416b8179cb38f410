"""Panorama: the colour image all around, its classes and depths, and its files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import COLOUR_FORMATS, write_colour, write_depth, write_palette, write_whole
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.views import View

OUTPUTS = ("rgb", "segments", "labels", "depth")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraImage:
    """A panorama resampled into a perspective camera.

    colour    (h, w, 3) uint8 RGB.
    segments  (h, w) uint8 ids of COMMON15, 0 where the panorama does not reach.
    """

    colour: np.ndarray
    segments: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panorama:
    """The panorama of one scan, on the raster `view` (h rows, w columns; left edge and right edge are straight behind).

    name          of the scan;  frame: its number in the stream.
    colour        (h, w, 3) uint8 RGB.
    segments      (h, w) uint8 ids of COMMON15.
    depth_m       (h, w) float32 metres from the view's origin along the ray; 0 = none (sky).
    labels        (N,) int64 ids of SEMANTIC_KITTI of the scan's points, file order.
    dropped       points that were not used (NaN, Inf, nearer than OWN_VEHICLE_M); they are labelled 0.
    milliseconds  time per stage.
    """

    name: str
    frame: int
    view: View
    colour: np.ndarray
    segments: np.ndarray
    depth_m: np.ndarray
    labels: np.ndarray
    dropped: int = 0
    milliseconds: Mapping[str, float] = field(default_factory=dict)

    def to_camera(self, calibration: Calibration) -> CameraImage:
        """Look into the panorama through a perspective camera at its origin."""
        lookup = panorama_in_camera(self.view, calibration)
        colour = lookup.linear(torch.from_numpy(self.colour).movedim(2, 0).float())
        segments = lookup.nearest(torch.from_numpy(self.segments))
        return CameraImage(colour=colour.round().movedim(0, 2).to(torch.uint8).numpy(), segments=segments.numpy())

    def save(
        self,
        out: str | Path,
        what: str | Collection[str] = ("rgb",),
        calibration: Calibration | None = None,
        stem: str | None = None,
        image_format: str = "png",
    ) -> list[Path]:
        """Write the files that `what` names into the folder `out`, each complete or not at all; return their paths.

        what  of "rgb" (<stem>.png), "segments" (<stem>.segments.png, palette of COMMON15), "labels" (<stem>.label, raw
              uint32 per point), "depth" (<stem>.depth.png, 16 bit, metres x 256). With a calibration also
              <stem>.camera.png beside rgb and <stem>.camera-segments.png beside segments.
        image_format  of the colour images: "png", "webp" (.webp) or "jpeg" (.jpg), which lose a little.
        Raises InputError when a name is unknown or the folder cannot be written.
        """
        what = (what,) if isinstance(what, str) else what
        if unknown := sorted(set(what) - set(OUTPUTS)):
            raise InputError(f"nothing to save is called {unknown[0]!r}; there is {', '.join(OUTPUTS)}")
        if image_format not in COLOUR_FORMATS:
            raise InputError(f"no image format {image_format!r}; there is {', '.join(COLOUR_FORMATS)}")
        ending = COLOUR_FORMATS[image_format][0]
        camera = self.to_camera(calibration) if calibration and {"rgb", "segments"} & set(what) else None
        stem = stem or self.name
        writers: dict[str, Callable[[Path], None]] = {}
        if "rgb" in what:
            writers[stem + ending] = lambda path: write_colour(path, self.colour, image_format)
            if camera:
                writers[f"{stem}.camera{ending}"] = lambda path: write_colour(path, camera.colour, image_format)
        if "segments" in what:
            writers[f"{stem}.segments.png"] = lambda path: write_palette(path, self.segments)
            if camera:
                writers[f"{stem}.camera-segments.png"] = lambda path: write_palette(path, camera.segments)
        if "labels" in what:
            writers[f"{stem}.label"] = lambda path: SEMANTIC_KITTI.to_raw(self.labels).astype("<u4").tofile(path)
        if "depth" in what:
            writers[f"{stem}.depth.png"] = lambda path: write_depth(path, self.depth_m)
        return [write_whole(Path(out) / name, write) for name, write in writers.items()]
