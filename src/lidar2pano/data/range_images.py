"""RangeImageDataset, for the LiDAR's segmenter: augmented scans as range images, and their pixels' labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.cache import LruCache
from lidar2pano.data.frames import Frame, SampleIndex, evenly_spaced
from lidar2pano.data.layouts import frames_of
from lidar2pano.formats.interpretation import STAND_IN
from lidar2pano.geometry.projection import Normalisation, fitted_view, project
from lidar2pano.geometry.stitching import Camera, homogeneous, look, points_in, surfaces_in
from lidar2pano.labels import CITYSCAPES, COMMON15, SEMANTIC_KITTI, TABLES, THINGS
from lidar2pano.scan import (
    Scan,
    change_sensor_remission,
    drop_points,
    drop_rings,
    mirror,
    mix,
    shift,
    tilt,
    turn,
    vary_remission,
)
from lidar2pano.scene.depth import complete_depth
from lidar2pano.scene.surfaces import hides
from lidar2pano.views import VIEWS, View

# Heights of the bands of elevation left out by two augmentations.
HDL64E_BEAM_DEG = 0.42  # of one beam: between neighbours of an HDL-64E's 64 beams within 26.8 degrees
COARSE_BAND_DEG = 0.8  # of about two beams
MOST_HIGHER_M = 1.2  # than a car's roof at 1.7 m: from a small robot's mast to a lorry's cab
MOST_LEANING_DEG = 5.0
PASTED = tuple(np.flatnonzero(np.isin(TABLES[SEMANTIC_KITTI.name, COMMON15.name], THINGS)).tolist())
PLAIN = Normalisation()


class RangeImageSample(NamedTuple):
    """One range image with its labels; after collation every tensor gains a leading B.

    lidar   (5 or 6, H, W) float32, normalised range image.
    labels  (H, W) int64 ids of SEMANTIC_KITTI, 0 if empty or unlabeled.
    name    "seq/frame".
    """

    lidar: Tensor
    labels: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanAugmentation:
    """The augmentation of scans.

    turn_deg  how far a scan is turned at most, either way.
    chance    probability of each of moving, turning and dropping points; half of the scans are mirrored.
    moves     whether scans are moved: a moved scan's beams no longer lie in rows, so its roughness is wrong.
    remission how much brighter or darker, as a share, all of a scan is made at most.
    rings     probability of leaving out up to three quarters of its beams, as of sensors of fewer beams.
    no_remission  probability of no remission, as of some sensors.
    sensors   largest change of level, in octaves, of half of the scans: remission as another make of sensor has it
              (scan.change_sensor_remission); 0: none.
    mixed     probability of a half-turn and of things of another scan (scan.mix).
    places    probability of each of a sensor standing up to MOST_HIGHER_M higher or lower, and leaning by up to
              MOST_LEANING_DEG: beams still lie nearly in rows, unlike those of a scan moved sideways.
    """

    turn_deg: float = 180.0
    chance: float = 0.5
    moves: bool = True
    remission: float = 0.0
    rings: float = 0.0
    no_remission: float = 0.0
    sensors: float = 0.0
    mixed: float = 0.0
    places: float = 0.0


class RangeImageDataset:
    """Labelled scans of some splits, projected; augmented when indexed by a SampleIndex, plain by an int.

    columns       width of the azimuth crop for training (0: all of the view).
    augmentation  how samples are augmented.
    tallest       limit of rows added for scans beyond `view` (fitted_view); None: none are.
    normalise     makes a network's input of a range image.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        view: View,
        columns: int = 0,
        augmentation: ScanAugmentation | None = None,
        tallest: View | None = None,
        normalise: Normalisation = PLAIN,
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view, self.tallest = view, tallest
        self.columns = columns or view.columns
        self.augmentation = augmentation or ScanAugmentation()
        self.normalise = normalise
        self._cache = LruCache()

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.frames)

    def scan(self, index: int) -> Scan:
        """Return the labelled scan of a frame."""
        return self._cache.get(index, lambda: labelled_scan(self.frames[index]))

    def class_counts(self) -> np.ndarray:
        """Return (K,) int64: points of each class of SEMANTIC_KITTI, in up to 500 evenly spaced frames."""
        counts = np.zeros(len(SEMANTIC_KITTI))
        for index in evenly_spaced(len(self)):
            label = self.frames[index].point_labels  # the scan itself is read where a camera's classes stand for them
            label = self.scan(index).label if label is None else label
            assert label is not None
            counts += np.bincount(label, minlength=len(counts))
        return counts

    def __getitem__(self, key: SampleIndex | int) -> RangeImageSample:
        """Return the sample: augmented by the seed of a SampleIndex, or the plain whole range image for an int."""
        if isinstance(key, int):
            return self._sample(self.scan(key), self.frames[key].name)
        generator = np.random.default_rng(key.seed)
        scan = self.scan(key.index)
        if self.augmentation.mixed and generator.random() < self.augmentation.mixed:
            scan = mix(scan, self.scan(int(generator.integers(len(self)))), generator, PASTED)
        scan = augmented(scan, generator, self.augmentation)
        sample = self._sample(scan, self.frames[key.index].name)
        start = int(generator.integers(self.view.columns - self.columns + 1))
        window = (..., slice(start, start + self.columns))
        return sample._replace(lidar=sample.lidar[window], labels=sample.labels[window])

    def _sample(self, scan: Scan, name: str) -> RangeImageSample:
        range_image = project(scan, fitted_view(scan, self.view, self.tallest))
        assert scan.label is not None
        return RangeImageSample(self.normalise(range_image), range_image.spread(torch.from_numpy(scan.label)), name)


def labelled_scan(frame: Frame) -> Scan:
    """Return a frame's scan with its labels; where the data have none, with the classes of a labelled image.

    These are of the points in the camera's sight alone, before which no other surface stands; the others stay
    unlabeled. InputError without either.
    """
    if frame.point_labels is not None or frame.camera_labels is None:
        return frame.labelled_scan()
    scan, ids, calibration = frame.require("scan", "camera_labels", "calibration")
    xyz, view = torch.from_numpy(scan.xyz), VIEWS["panorama"]
    camera = Camera(image=np.broadcast_to(ids[..., None], (*ids.shape, 3)), calibration=calibration)
    points = points_in(camera, xyz.where(xyz.any(1, keepdim=True), torch.nan).T)  # the sensor's origin means: no echo
    surfaces = surfaces_in(camera, view, homogeneous(complete_depth(xyz, view))).flatten(1)
    sight = look(camera, points, view.focal_px, hides, surfaces)
    column, row = sight.place.long().numpy()
    classes = np.zeros(256, np.int64)
    classes[: len(CITYSCAPES)] = TABLES[CITYSCAPES.name, SEMANTIC_KITTI.name]
    label = np.zeros(len(scan), np.int64)
    label[sight.surface.numpy()] = classes[ids[row, column]]
    return replace(scan, label=label)


def augmented(scan: Scan, generator: np.random.Generator, augmentation: ScanAugmentation) -> Scan:
    """Augment as SalsaNext: move, mirror, turn, drop up to half of the points; vary or drop remission, drop beams."""
    if augmentation.rings and generator.random() < augmentation.rings:  # before it moves: beams belong to its own place
        scan = drop_rings(scan, generator, HDL64E_BEAM_DEG, generator.uniform(0, 0.75))
    if augmentation.moves and generator.random() < augmentation.chance:
        scan = shift(scan, generator, (5.0, 3.0, 0.5))
    if augmentation.places and generator.random() < augmentation.places:
        scan = shift(scan, generator, (0.0, 0.0, MOST_HIGHER_M))
    if augmentation.places and generator.random() < augmentation.places:
        scan = tilt(scan, generator.uniform(-np.pi, np.pi), np.radians(generator.uniform(0, MOST_LEANING_DEG)))
    if generator.random() < 0.5:
        scan = mirror(scan)
    if generator.random() < augmentation.chance:
        scan = turn(scan, np.radians(generator.uniform(-augmentation.turn_deg, augmentation.turn_deg)))
    if generator.random() < augmentation.chance:
        scan = drop_points(scan, generator, generator.uniform(0, 0.5))
    if augmentation.no_remission and generator.random() < augmentation.no_remission:
        return without_remission(scan)
    if augmentation.sensors and generator.random() < 0.5:
        return change_sensor_remission(scan, generator, augmentation.sensors)
    return vary_remission(scan, generator, augmentation.remission) if augmentation.remission else scan


def without_remission(scan: Scan) -> Scan:
    """Return the scan as of a sensor that measures no remission: all points have STAND_IN."""
    return replace(scan, remission=np.full_like(scan.remission, STAND_IN))
