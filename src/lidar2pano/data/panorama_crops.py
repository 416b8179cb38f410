"""PanoramaDataset: the scan on the cylinder around the camera, and the camera's labels of it, cropped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.cache import LruCache, PredictedLabels
from lidar2pano.data.frames import (
    CITYSCAPES_TO_COMMON15,
    IGNORE,
    Frame,
    PanoramaGroundTruth,
    SampleIndex,
    evenly_spaced,
)
from lidar2pano.data.layouts import frames_of
from lidar2pano.data.range_images import COARSE_BAND_DEG, without_remission
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import at_camera, camera_in_panorama
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.scan import Scan, change_sensor_remission, drop_above, drop_points, drop_rings
from lidar2pano.views import View

HIGHEST_DEG = (-4.0, 11.0)  # elevations of highest beams: an HDL-64E's lies at 2, an HDL-32E's at 10.7
SHIFT_PX = 24  # how far left or right of the camera's middle a crop may begin
LARGEST = 0.3  # logarithm of the most that a sample is enlarged by: sensors 1.3 to 2.3 m above the road for one at 1.73


class PanoramaSample(NamedTuple):
    """A sector of the panorama around the camera's; after collation every tensor gains a leading B.

    range_image    (5, H, W) float32: a RangeImage's channels, metres; zero if empty.
    segments       (H, W) int64 ids of SEMANTIC_KITTI of the pixels' points; 0 if empty.
    camera_labels  (H, W) int64 ids of COMMON15, IGNORE if unknown or outside the camera's image.
    depth_m        (H, W) float32: distance from the camera of the full scan's points, or of the true panorama where
                   there is one, metres; zero if none.
    name           "seq/frame".
    """

    range_image: Tensor
    segments: Tensor
    camera_labels: Tensor
    depth_m: Tensor
    name: str


class PanoramaWindow(NamedTuple):
    """A frame on the panorama's raster: in a window a little wider than the crops, or all of it.

    scan           with its point labels, if it has any;  view: the window or the whole raster, around the camera's
                   optical centre.
    camera_labels  (H, W) uint8, depth_m (H, W) float32: see PanoramaSample.
    """

    scan: Scan
    view: View
    camera_labels: Tensor
    depth_m: Tensor


class PanoramaDataset:
    """Scan/camera pairs of some splits on `view`, cropped to `columns` around the camera's sector.

    Of frames with a true panorama, crops come from every direction, unless only the camera's image has labels.

    view      the raster of the translator (its origin is replaced by the camera's centre, frame by frame).
    columns   width of the crop, a multiple of 16; shift_px: how far left or right of the camera's middle it may begin.
    elsewhere probability of a crop beginning anywhere there; others of a frame whose labels end somewhere do so
              SHIFT_PX at most from the middle.
    sensors   largest change of level, in octaves, of remission in three quarters of the augmented samples; an eighth
              has STAND_IN's, and half of all are enlarged. 0: all stay as they are.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        view: View,
        columns: int = 640,
        *,
        shift_px: int = SHIFT_PX,
        elsewhere: float = 1.0,
        sensors: float = 0.0,
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view, self.columns = view, columns
        self.shift_px, self.elsewhere, self.sensors = shift_px, elsewhere, sensors
        self.predicted: PredictedLabels | None = None
        self._cache, self._labels = LruCache(), LruCache()

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.frames)

    def window(self, index: int) -> PanoramaWindow:
        """Return the frame on the raster; InputError if a needed part is missing, or parts do not fit together."""
        return self._cache.get(index, lambda: self._read(self.frames[index]))

    def predict(self, label_points: Callable[[Scan], Tensor], weights: str | Path) -> None:
        """Use a segmenter's labels: half of the augmented samples do; plain ones do always, and scans without labels.

        weights  the segmenter's file: predictions are made once and kept on disk (PredictedLabels).
        """
        self.predicted = PredictedLabels(label_points, weights)

    def class_counts(self) -> np.ndarray:
        """Return (256,) int64: pixels of each camera label, in up to 500 evenly spaced frames."""
        counts = np.zeros(256)
        for frame in (self.frames[index] for index in evenly_spaced(len(self))):
            ids = frame.panorama_labels
            if ids is None or not _is_like(ids, self.view):
                labels = self._camera_labels(frame)[1].numpy()
            else:  # as `_camera_labels` has them, without reading the panorama itself
                labels = resized(ids, self.view, Image.Resampling.NEAREST)
                labels = np.where(labels == 0, IGNORE, labels)
            counts += np.bincount(labels.ravel(), minlength=256)
        return counts

    def __getitem__(self, key: SampleIndex | int) -> PanoramaSample:
        """Return the sample: points, labels, crop and mirror augmented by a SampleIndex's seed, or plain for an int."""
        index = key if isinstance(key, int) else key.index
        window, frame = self.window(index), self.frames[index]
        if window.scan.label is None and self.predicted is None:
            raise InputError(frame.missing("point_labels"))
        if isinstance(key, int):
            scan = window.scan if self.predicted is None else self._predicted(window.scan, index)
            return self._sample(window, scan, frame.name, (window.view.columns - self.columns) // 2)
        generator = np.random.default_rng(key.seed)
        scan = window.scan
        if self.predicted is not None and (generator.random() < 0.5 or scan.label is None):
            scan = self._predicted(scan, index)
        scan = without_sector(scan, generator)
        if generator.random() < 0.5:
            scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        if generator.random() < 0.3:
            scan = drop_rings(scan, generator, COARSE_BAND_DEG, generator.uniform(0, 0.5))
        if generator.random() < 0.3:
            scan = drop_above(scan, generator.uniform(*HIGHEST_DEG))
        if self.sensors:
            scan = self._of_another_sensor(scan, generator)
        sample = self._sample(window, scan, frame.name, self._start(window, generator))
        if self.sensors and generator.random() < 0.5:
            sample = enlarged(sample, float(np.exp(generator.uniform(-LARGEST, LARGEST))))
        return mirrored(sample) if generator.random() < 0.5 else sample

    def _of_another_sensor(self, scan: Scan, generator: np.random.Generator) -> Scan:
        """Return the scan, or one with another sensor's remission, or with none."""
        draw = generator.random()
        if draw < 0.75:
            return change_sensor_remission(scan, generator, self.sensors)
        return without_remission(scan) if draw < 0.875 else scan

    def _start(self, window: PanoramaWindow, generator: np.random.Generator) -> int:
        """Return the first column of an augmented crop."""
        spare = window.view.columns - self.columns
        near = self.elsewhere < 1 and generator.random() >= self.elsewhere
        if near and not (window.camera_labels != IGNORE).any(0).all():
            shift = min(SHIFT_PX, spare // 2)
            return spare // 2 + int(generator.integers(-shift, shift + 1))
        return int(generator.integers(spare + 1))

    def _predicted(self, scan: Scan, index: int) -> Scan:
        assert self.predicted is not None
        predicted, frame = self.predicted, self.frames[index]
        vars(frame)["scan"] = scan  # read already
        return replace(scan, label=self._labels.get(index, lambda: predicted.of(frame)))

    def _sample(self, window: PanoramaWindow, scan: Scan, name: str, start: int) -> PanoramaSample:
        range_image = project(scan, window.view.window(start, self.columns))
        assert scan.label is not None
        columns = slice(start, start + self.columns)
        return PanoramaSample(
            range_image=range_image.channels,
            segments=range_image.spread(torch.from_numpy(scan.label)),
            camera_labels=window.camera_labels[:, columns].long(),
            depth_m=window.depth_m[:, columns],
            name=name,
        )

    def _read(self, frame: Frame) -> PanoramaWindow:
        view, labels = self._camera_labels(frame)
        scan = replace(frame.scan, label=frame.point_labels)
        if self._all_around(frame):
            depth_m = torch.from_numpy(panorama_on(frame, self.view).depth_m)
        else:
            depth_m = project(scan, view).channels[0]
        return PanoramaWindow(scan, view, labels, depth_m)

    def _camera_labels(self, frame: Frame) -> tuple[View, Tensor]:
        """Return the sampled part of a frame's raster, and its camera labels, uint8 of COMMON15 or IGNORE."""
        if self._all_around(frame):
            panorama = panorama_on(frame, self.view)
            labels = torch.from_numpy(panorama.labels)
            return panorama.view, labels.where(labels != 0, IGNORE)
        ids, calibration = frame.require("camera_labels", "calibration")
        view = around_camera(at_camera(self.view, calibration), calibration, self.columns + 2 * self.shift_px)
        return view, camera_in_panorama(view, calibration).nearest(
            torch.from_numpy(CITYSCAPES_TO_COMMON15[ids]), IGNORE
        )

    def _all_around(self, frame: Frame) -> bool:
        """Return whether a frame is sampled on the whole raster; not if only the camera has labels."""
        if frame.panorama_labels is None and frame.camera_labels is not None:
            return False
        return frame.panorama_for(self.view) is not None


def without_sector(scan: Scan, generator: np.random.Generator) -> Scan:
    """Return the scan, or with probability 0.15 one with an unlabeled sector ahead, for networks to use geometry."""
    if scan.label is None or generator.random() >= 0.15:
        return scan
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    middle, half = generator.uniform(-0.8, 0.8), generator.uniform(0.05, 1.0)
    return replace(scan, label=scan.label * (np.abs(azimuth - middle) >= half))


def panorama_on(frame: Frame, view: View, camera_labels: bool = False) -> PanoramaGroundTruth:
    """Return a frame's true panorama, labels and depths included, on the raster `view` around the camera.

    Colours are means of pixels, labels and depths the nearest pixel's; rows beyond the panorama are not valid, 0 in all
    layers. InputError if the frame has none of them, or its panorama is of another shape. camera_labels: labels may be
    None.
    """
    panorama = frame.panorama_for(view)
    if panorama is None:
        raise InputError(frame.missing("panorama"))
    panorama = _as_tall(panorama, view)
    rows, columns = panorama.valid.shape
    if panorama.labels is None and not camera_labels:
        raise InputError(frame.missing("panorama_labels"))
    if panorama.depth_m is None:
        raise InputError(frame.missing("panorama_depths"))
    if not _is_like(panorama.valid, view):
        raise InputError(
            f"{frame.name}: its panorama is {columns}x{rows}; one like {view.columns}x{view.rows} is needed"
        )
    row = ((np.arange(view.rows) + 0.5) * rows / view.rows).astype(int)
    column = ((np.arange(view.columns) + 0.5) * columns / view.columns).astype(int)
    return PanoramaGroundTruth(
        view=replace(view, origin=panorama.view.origin),
        image=resized(panorama.image, view, Image.Resampling.BOX),
        valid=panorama.valid[row[:, None], column],
        labels=None if panorama.labels is None else resized(panorama.labels, view, Image.Resampling.NEAREST),
        depth_m=panorama.depth_m[row[:, None], column],
    )


def _is_like(layer: np.ndarray, view: View) -> bool:
    """Return whether a layer (h, w) has as many rows for its columns as a raster, within one."""
    rows, columns = layer.shape
    return abs(columns * view.rows - rows * view.columns) <= view.columns


def _as_tall(panorama: PanoramaGroundTruth, view: View) -> PanoramaGroundTruth:
    """Return the panorama with as many rows more or fewer, above and below, as the raster `view` asks for."""
    held = panorama.view
    if held.kind != view.kind:
        return panorama
    pitch = (held.up - held.down) / held.rows
    rows_up, rows_down = (round(beyond / pitch) for beyond in (view.up - held.up, held.down - view.down))
    if not (rows_up or rows_down):
        return panorama
    kept, added = slice(max(-rows_up, 0), held.rows - max(-rows_down, 0)), (max(rows_up, 0), max(rows_down, 0))
    layers = {
        name: np.pad(layer[kept], [added, *[(0, 0)] * (layer.ndim - 1)])
        for name in ("image", "valid", "labels", "depth_m")
        if (layer := getattr(panorama, name)) is not None
    }
    ends = {"up": held.up + rows_up * pitch, "down": held.down - rows_down * pitch}
    return replace(panorama, view=replace(held, rows=held.rows + rows_up + rows_down, **ends), **layers)


def resized(pixels: np.ndarray, view: View, resampling: Image.Resampling) -> np.ndarray:
    """Return an image, ids (h, w, ...) uint8 or shares (h, w) float32 at the size of the raster `view`."""
    return np.array(Image.fromarray(pixels).resize((view.columns, view.rows), resampling))


def around_camera(view: View, calibration: Calibration, columns: int) -> View:
    """Return the window of the raster, `columns` wide, in whose middle the camera looks."""
    ahead = np.linalg.inv(calibration.K @ calibration.T_camera_lidar[:3, :3]) @ np.array(
        [(calibration.size[0] - 1) / 2, (calibration.size[1] - 1) / 2, 1.0]
    )
    x, y, z = torch.from_numpy(ahead).unbind()
    _, column = pixels(x, y, z, view)
    start = min(max(round(float(column)) - columns // 2, 0), view.columns - columns)
    return view.window(start, columns)


def enlarged(sample: PanoramaSample, times: float) -> PanoramaSample:
    """Return the sample in a world so many times as large, which looks the same: as of a sensor that is mounted higher.

    Coordinates and depths, metres, are multiplied; remission and classes stay.
    """
    factors = torch.tensor([times, times, times, times, 1.0])[:, None, None]
    return sample._replace(range_image=sample.range_image * factors, depth_m=sample.depth_m * times)


def mirrored(sample: PanoramaSample) -> PanoramaSample:
    """Return the sample with left and right swapped, its points' y included."""
    flipped = {field: getattr(sample, field).flip(-1) for field in sample._fields if field != "name"}
    flipped["range_image"] = flipped["range_image"] * torch.tensor([1.0, 1, -1, 1, 1])[:, None, None]
    return sample._replace(**flipped)
