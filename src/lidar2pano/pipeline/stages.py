"""The pipeline in the paper's order (its figure 2): measure, predict, remember, paint."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import (
    Normalisation,
    RangeImage,
    fitted_view,
    nearest_ranges,
    one_hot_layers,
    project,
)
from lidar2pano.geometry.rasters import likeliest, upsample_azimuth, upsample_classes
from lidar2pano.geometry.stitching import Camera
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import Memory, remember, steady
from lidar2pano.models.card import Card
from lidar2pano.models.latent_painter import LatentPainter
from lidar2pano.models.painter import LookPainter, StreamPainter, check_quality
from lidar2pano.models.salsanext import STRIDE
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline.camera_doubts import sound_cameras
from lidar2pano.pipeline.composition import compose
from lidar2pano.recordings.recorded_scans import read
from lidar2pano.scan import OWN_VEHICLE_M, Scan
from lidar2pano.scene.depth import denser, measured_depth
from lidar2pano.scene.record import ScanPoints, Scene
from lidar2pano.scene.surfaces import viewpoint_height
from lidar2pano.views import View, columns_between, sensor_view

TINY = 1e-20  # least probability whose logarithm is taken
ROAD, SKY, CONDITIONS = COMMON15.id_of("road"), COMMON15.id_of("sky"), len(SEMANTIC_KITTI)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmenter:
    """A range-view network with the view and normalisation it was trained on.

    network   (1, 5, H, W) -> (1, classes, H, W) logits.
    tallest   how far rows are added to the view for sensors that see more (fitted_view); None: none are.
    """

    network: nn.Module
    view: View
    normalise: Normalisation
    tallest: View | None = None

    @classmethod
    def from_card(cls, network: nn.Module, card: Card) -> Segmenter:
        """The segmenter that a weight file holds: `network, card = load(path)`."""
        normalise = validated(Normalisation, card.normalisation, "the card's normalisation")
        views = {role: validated(View, view, "the card's view") for role, view in card.views.items()}
        for view in views.values():
            if view.rows % STRIDE or view.columns < STRIDE:
                raise InputError(
                    f"the card's view of {view.rows} x {view.columns} pixels is no segmenter's: its rows must divide by"
                    f" {STRIDE}, and it has as many columns at least; fetch or make the file again"
                )
        return cls(network=network, view=views["input"], normalise=normalise, tallest=views.get("tallest input"))

    def at(self, view: View) -> Segmenter:
        """The segmenter on another view, whatever the scan."""
        return replace(self, view=view, tallest=None)

    def project(self, scan: Scan, device: str | torch.device = "cpu") -> RangeImage:
        """The range image that the network labels."""
        return project(scan, fitted_view(scan, self.view, self.tallest), device=device)

    @torch.inference_mode()
    def raster(self, image: RangeImage) -> Tensor:
        """Class ids (H, W) uint8 of a range image; raises InputError unless its rows divide by STRIDE."""
        x = self.normalise(image)[None]
        columns = x.shape[3]
        if spare := -columns % STRIDE:  # Pandar64's 1800 columns do not divide: go on beyond the seam, or empty
            beyond = x[..., :spare] if image.view.circular else x.new_zeros(*x.shape[:3], spare)
            x = torch.cat([x, beyond], dim=3)
        with fast_arithmetic(x.device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last))
        return likeliest(logits[..., :columns])[0]

    def label(self, image: RangeImage, timer: Timer) -> Tensor:
        """Class ids (N,) int64 of the points of a range image on `view`: the network, then the KNN clean-up."""
        with timer("segment"):
            ids = self.raster(image)
        with timer("clean_up"):
            return clean_up(image, ids)

    def points(self, scan: Scan, device: str | torch.device = "cpu") -> Tensor:
        """Class ids (N,) int64 of a scan's points."""
        _, image, _ = denser(scan, self.project(scan, device))
        return self.label(image, Timer(torch.device(device)))[: len(scan)]


class Measurement(NamedTuple):
    """A scan on the rasters of a pipeline.

    points               the scan's points.
    channels             (1, 5, H, W) float32: the scan's RangeImage on the scene's raster.
    translator_channels  (1, 5, h, w) float32: likewise on the raster that the translator reads.
    condition            (1, 20, h, w) float32 there: the points' classes, one-hot.
    """

    points: ScanPoints
    channels: Tensor
    translator_channels: Tensor
    condition: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Pipeline:
    """Three networks and the raster that they share.

    segmenter   scan -> a class of SEMANTIC_KITTI per point.
    translator  (channels (1, 5, H, W), condition (1, 20, H, W)) -> logits (1, 16, H, W) of COMMON15, depth (1, H, W) m.
    painter     (its past, Scene, look) -> (its past, (1, 3, 2H, 2W)).
    view        the scene's raster, H x W, around the optical centre of the camera that the panorama stands for.
    cards       of the weight files, by role.
    look        one of the painter's looks: "A", "A+B" for the mean of two, "" for its own.
    engine      the engine that computes the networks: of ENGINES, but not "auto".
    """

    segmenter: Segmenter
    translator: nn.Module
    painter: StreamPainter
    view: View
    device: torch.device
    cards: Mapping[str, Card] = field(default_factory=dict)
    look: str = ""
    engine: str = "torch"

    def __repr__(self) -> str:
        """Return networks, raster, device and engine, without the layers."""
        networks = [f"{card.network} ({card.recipe})" for card in self.cards.values()] or ["networks without cards"]
        raster = f"{self.view.rows} x {self.view.columns}"
        return f"{type(self).__name__}({' -> '.join(networks)}, {raster}, {self.device.type}, {self.engine})"

    def at(self, calibration: Calibration | LensCalibration) -> Pipeline:
        """Return the pipeline with its viewpoint moved to a camera's optical centre."""
        return replace(self, view=at_camera(self.view, calibration))

    def for_sensor(self, name: str) -> Pipeline:
        """Return the pipeline with the segmenter's view that fits a sensor of VIEWS; InputError where there is none."""
        return replace(self, segmenter=self.segmenter.at(sensor_view(name)))

    def in_look(self, look: str) -> Pipeline:
        """Return the pipeline that paints a look, "A" or "A+B"; InputError where the painter lacks it."""
        if not isinstance(self.painter, LookPainter):
            raise InputError(
                f"no look {look!r}: these weights paint one look only; choose a scene painter's, or name a painter's"
                f" file {look}.safetensors"
            )
        self.painter.look_shares(look)
        return replace(self, look=look)

    def in_variant(self, quality: str = "fast", seed: int = 0) -> Pipeline:
        """Return the pipeline that paints in a quality of QUALITIES, and the plausible picture of a seed.

        Raises InputError for an unknown quality, and where the painter has one quality and one picture only.
        """
        check_quality(quality)
        if isinstance(self.painter, LatentPainter):
            return replace(self, painter=self.painter.variant(quality, seed))
        if quality != "fast" or seed:
            raise InputError("these weights paint one picture, in one quality; choose a latent painter's for others")
        return self

    def __call__(self, scan: Scan | str | Path, cameras: Sequence[Camera] = ()) -> Panorama:
        """Return the panorama of a single scan, or of a scan file.

        cameras  whose pixels it takes where they see; calibrated in the scan's frame.
        """
        scan = read(scan) if isinstance(scan, str | Path) else scan
        return self.step(Memory(), scan, cameras=cameras)[1]

    def stream(
        self,
        scans: Iterable[Scan],
        poses: Iterable[np.ndarray] | None = None,
        cameras: Iterable[Sequence[Camera]] | None = None,
    ) -> Iterator[Panorama]:
        """Yield panoramas of consecutive scans; with a pose for each (see `remember`), temporally smoothed.

        cameras  of each scan, as for a single one.
        """
        memory = Memory()
        every_pose = itertools.repeat(None) if poses is None else poses
        every_camera = itertools.repeat(()) if cameras is None else cameras
        for scan, pose, own_cameras in zip(scans, every_pose, every_camera, strict=False):
            memory, panorama = self.step(memory, scan, pose, cameras=own_cameras)
            yield panorama

    def step(
        self,
        memory: Memory,
        scan: Scan,
        pose: np.ndarray | None = None,
        timer: Timer | None = None,
        labels: np.ndarray | None = None,
        cameras: Sequence[Camera] = (),
    ) -> tuple[Memory, Panorama]:
        """Paint one scan of a stream; returns the memory for the next scan, and the panorama.

        pose  as of `remember`;  labels: as of `measure`;  cameras: as of a call.
        """
        timer = timer or Timer(self.device)
        measurement = self.measure(scan, timer, labels)
        scene = self.predict(measurement, timer)
        memory, scene = self.remember(memory, scene, pose, timer)
        first = memory.frames == 0
        memory, panorama = self.paint(memory, scene, timer)
        if cameras:
            with timer("cameras"):
                kept, doubts = sound_cameras(cameras, scan, edges=first)
                panorama = compose(panorama, kept) if kept else panorama
                panorama = replace(panorama, doubts=doubts)
        return memory, panorama

    def translate(self, scan: Scan, timer: Timer, labels: np.ndarray | None = None) -> Scene:
        """Return the belief about a single scan: `measure`, then `predict`."""
        return self.predict(self.measure(scan, timer, labels), timer)

    @torch.inference_mode()
    def measure(self, scan: Scan, timer: Timer, labels: np.ndarray | None = None) -> Measurement:
        """Project a scan and label its points.

        labels  (N,) int64 ids of SEMANTIC_KITTI of its points, where they are known better than by the segmenter.
        Points nearer than OWN_VEHICLE_M are not used. Raises InputError when no point of the scan can be used, or none
        is in view.
        """
        with timer("project"):
            scan = scan.beyond()
            image = self._checked(scan, self.segmenter.project(scan, self.device))
            returns_m = nearest_ranges(scan, self.view.scaled(2), device=self.device)
            dense, image, source = self._densified(scan, image)
            channels = self._checked(dense, project(dense, self.view, device=self.device))
            translator_image = self._translator_image(dense, channels)
        if labels is None:
            ids = self.segmenter.label(image, timer)
        else:
            ids = torch.from_numpy(labels[source.cpu().numpy()]).to(self.device)
        points = ScanPoints(
            name=scan.name,
            labels=ids[: len(scan)],
            returns_m=returns_m,
            gaps_deg=scan.gaps_deg,
            dropped=image.dropped,
            beyond_rows=int((image.usable & ~image.inside).sum()),
            points_between=len(dense) - len(scan),
        )
        condition = one_hot_layers(translator_image.spread(ids)[None], CONDITIONS)
        return Measurement(points, channels.channels[None], translator_image.channels[None], condition)

    @torch.inference_mode()
    def predict(self, measurement: Measurement, timer: Timer) -> Scene:
        """Predict classes and depths all around; depths keep to the measurement."""
        with timer("translate"):
            probabilities, guessed_m = self._translated(measurement)
            ids, channels = likeliest(probabilities), measurement.channels
            viewpoint_m = viewpoint_height(channels[:, 0], ids == ROAD, self.view)
            return Scene(
                view=self.view,
                channels=channels,
                probabilities=probabilities,
                depth_m=measured_depth(guessed_m, channels, ids, viewpoint_m, self.view),
                viewpoint_m=viewpoint_m,
                points=measurement.points,
            )

    @torch.inference_mode()
    def remember(self, memory: Memory, scene: Scene, pose: np.ndarray | None, timer: Timer) -> tuple[Memory, Scene]:
        """Fuse a scene with those of the previous scans; returns the memory with it, and the fused scene.

        pose  (4, 4) float64 `T_world_sensor`, metres. If it is always given, classes and depths are averaged over time
              (memory.fused), and so is the image (memory.smoothed). Without it the stream begins again.
        """
        if pose is None:
            return replace(memory, around=None, previous=None), scene
        with timer("fuse"):
            return remember(memory, replace(scene, T_world_sensor=pose))

    @torch.inference_mode()
    def paint(self, memory: Memory, scene: Scene, timer: Timer) -> tuple[Memory, Panorama]:
        """Paint a scene that `remember` returned; returns the memory for the next scan, and the panorama."""
        with timer("paint"), fast_arithmetic(self.device):
            painted, image = self.painter.paint(memory.painted, scene, self.look)
        if memory.around is not None:
            with timer("steady"):
                memory, image = steady(memory, image, self.view)
        with timer("finish"):
            panorama = finished(scene, image, memory.frames, timer)
        return replace(memory, frames=memory.frames + 1, painted=painted), panorama

    def _densified(self, scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
        """Return the scan and its image with points between the beams; and the scan's point of each."""
        return denser(scan, image)

    def _translator_image(self, scan: Scan, image: RangeImage) -> RangeImage:  # noqa: ARG002 the paper's needs it
        """Return the range image that the translator reads; image: on the scene's raster."""
        return image

    def _translated(self, measurement: Measurement) -> tuple[Tensor, Tensor]:
        """Return the translator's probabilities (1, 16, H, W) and depths (1, H, W), float32."""
        channels = measurement.translator_channels.contiguous(memory_format=torch.channels_last)
        with fast_arithmetic(self.device):
            logits, depth_m = self.translator(channels, measurement.condition)
        return logits.float().contiguous().softmax(1), depth_m.float()

    @staticmethod
    def _checked(scan: Scan, image: RangeImage) -> RangeImage:
        if not bool(image.usable.any()):
            raise InputError(
                f"{scan.name}: none of its {len(scan)} points can be used (NaN, Inf or nearer than"
                f" {OWN_VEHICLE_M:g} m, which is the vehicle itself); check how the scan was written"
            )
        if not bool(image.valid.any()):
            raise InputError(f"{scan.name}: no point is in view (x must point forward, z up, in metres); turn the scan")
        return image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperPipeline(Pipeline):
    """The paper's pipeline: a range view in, front-view networks all around; scan and predictions stay as they are.

    input_view  the raster of the scan that the translator reads.
    """

    input_view: View

    @classmethod
    def of(cls, pipeline: Pipeline, input_view: View) -> Self:
        """Return a pipeline's parts as the paper's."""
        return cls(**{part.name: getattr(pipeline, part.name) for part in fields(Pipeline)}, input_view=input_view)

    @torch.inference_mode()
    def predict(self, measurement: Measurement, timer: Timer) -> Scene:
        """Predict classes and depths all around."""
        with timer("translate"):
            probabilities, depth_m = self._translated(measurement)
            return Scene.predicted(self.view, measurement.channels, probabilities, depth_m, points=measurement.points)

    def _densified(self, scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
        return scan, image, torch.arange(len(scan), device=image.index.device)

    def _translator_image(self, scan: Scan, image: RangeImage) -> RangeImage:  # noqa: ARG002
        return self._checked(scan, project(scan, self.input_view, device=self.device))


def finished(scene: Scene, image: Tensor, frame: int, timer: Timer) -> Panorama:
    """Return the panorama of a scene and its painted image (1, 3, 2H, 2W) in [-1, 1].

    Classes, depth and confidence are the scene's, enlarged; a pixel with a point has its distance. The sky has no other
    depth, and outside the sensor's field of view nothing is claimed.
    """
    points, view = scene.points, scene.view.scaled(2)
    assert points is not None, "scenes of scans have them"
    colour = image[0].float().add(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8).movedim(0, 2)
    segments = upsample_classes(scene.probabilities, 2, least=TINY)
    measured = points.returns_m > 0
    depth_m = upsample_azimuth(scene.depth_m[None], 2)[0, 0].masked_fill_(segments == SKY, 0)
    depth_m = torch.where(measured, points.returns_m, depth_m)
    confidence = upsample_azimuth(scene.probabilities.amax(1, keepdim=True), 2)[0, 0]
    for left, right in points.gaps_deg:
        columns = columns_between(view, left, right)
        for layer in (segments, depth_m, confidence, measured):
            layer[:, columns] = 0
    layers = (colour, segments, depth_m, confidence, measured, points.labels)
    colour, segments, depth_m, confidence, measured, labels = (part.contiguous().cpu().numpy() for part in layers)
    return Panorama(
        name=points.name,
        frame=frame,
        view=view,
        colour=colour,
        segments=segments,
        depth_m=depth_m,
        confidence=confidence,
        measured=measured,
        labels=labels,
        dropped=points.dropped,
        beyond_rows=points.beyond_rows,
        points_between=points.points_between,
        milliseconds=timer.milliseconds,
    )
