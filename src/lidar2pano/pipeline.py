"""A scan in, a panorama out: projection, segmentation, KNN clean-up, translation, painting; the paper's figure 2."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.calibration import Calibration
from lidar2pano.corrections import corrected
from lidar2pano.engines import accelerated, pick_engine
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.between_beams import denser
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.car_body import Boxes
from lidar2pano.geometry.columns import rows_beside
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.odds import likeliest
from lidar2pano.geometry.projection import Normalisation, RangeImage, fitted_view, one_hot_layers, project
from lidar2pano.geometry.whole_cars import WholeCars
from lidar2pano.hardware import Timer, fast_arithmetic, pick_device
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import Memory, PreviousFrame, Surroundings, fused, smoothed
from lidar2pano.models.blocks import fold_norms, grow_circular, grown_classes
from lidar2pano.models.card import Card, read_card
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.families import DEFAULT, FRONT_VIEW, role, weight_files
from lidar2pano.models.front_all_around import FrontAllAround
from lidar2pano.models.salsanext import STRIDE
from lidar2pano.models.scene_painter import Scene, ScenePainter, StreamPainter, with_cars
from lidar2pano.models.vid2vid import Vid2Vid
from lidar2pano.models.vid2vid_painter import Vid2VidPainter
from lidar2pano.panorama import Panorama
from lidar2pano.recordings.recorded_scans import read
from lidar2pano.scan import OWN_VEHICLE_M, Scan
from lidar2pano.views import View, columns_between, sensor_view

TINY = 1e-20  # least probability whose logarithm is taken
SKY, CONDITIONS = COMMON15.id_of("sky"), len(SEMANTIC_KITTI)


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


class Translated(NamedTuple):
    """A scan that is translated but not yet painted, on the translator's raster H x W.

    name      of the scan.
    labels    (N,) int64 ids of SEMANTIC_KITTI of the scan's points; dropped: how many of them could not be used.
    channels  (1, 5, H, W) float32: the scan's RangeImage.
    logits    (1, 16, H, W) of COMMON15;  depth_m (1, H, W) float32, metres.
    gaps_deg  sectors (left, right) of azimuth out of the sensor's field of view.
    beyond_rows  number of points that could be used, but lie above or below the segmenter's rows.
    points_between  number of points that were put between the beams of a sparse sensor.
    """

    name: str
    labels: Tensor
    dropped: int
    channels: Tensor
    logits: Tensor
    depth_m: Tensor
    gaps_deg: tuple[tuple[float, float], ...] = ()
    beyond_rows: int = 0
    points_between: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pipeline:
    """Three networks and the raster that they share.

    segmenter   scan -> a class of SEMANTIC_KITTI per point.
    translator  (channels (1, 5, H, W), condition (1, 20, H, W)) -> logits (1, 16, H, W) of COMMON15, depth (1, H, W) m.
    painter     (its memory, Scene) -> (its memory, (1, 3, 2H, 2W)).
    view        the translator's raster, H x W, around the optical centre of the camera that the panorama stands for.
    input_view  the raster of the scan that the translator reads; None: `view`, too.
    cards       of the weight files, by role.
    look        which of the painter's looks is painted: "A", "A+B" for the mean of two, "" for its own.
    engine      what computes the networks: of ENGINES, but not "auto".
    """

    segmenter: Segmenter
    translator: nn.Module
    painter: StreamPainter
    view: View
    device: torch.device
    cards: Mapping[str, Card] = field(default_factory=dict)
    look: str = ""
    engine: str = "torch"
    input_view: View | None = None

    def at(self, calibration: Calibration) -> Pipeline:
        """The pipeline with its viewpoint moved to a camera's optical centre."""
        return replace(self, view=at_camera(self.view, calibration))

    def for_sensor(self, name: str) -> Pipeline:
        """The pipeline with the segmenter's view that fits a sensor of VIEWS; InputError where there is none."""
        return replace(self, segmenter=self.segmenter.at(sensor_view(name)))

    def in_look(self, look: str) -> Pipeline:
        """The pipeline that paints a look, "A" or "A+B" for the mean of two; InputError where the painter lacks it."""
        if not isinstance(self.painter, ScenePainter):
            raise InputError(
                f"no look {look!r}: these weights paint one look only; choose a scene painter's, or name a painter's"
                f" file {look}.safetensors"
            )
        self.painter.look_shares(look)
        return replace(self, look=look)

    def __call__(self, scan: Scan | str | Path) -> Panorama:
        """The panorama of a single scan, or of a scan file."""
        return next(self.stream([read(scan) if isinstance(scan, str | Path) else scan]))

    def stream(self, scans: Iterable[Scan], poses: Iterable[np.ndarray] | None = None) -> Iterator[Panorama]:
        """Panoramas of consecutive scans; with a pose for each (see `paint`), temporally smoothed."""
        memory = Memory()
        for scan, pose in zip(scans, itertools.repeat(None) if poses is None else poses, strict=False):
            memory, panorama = self.step(memory, scan, pose)
            yield panorama

    def step(
        self,
        memory: Memory,
        scan: Scan,
        pose: np.ndarray | None = None,
        timer: Timer | None = None,
        labels: np.ndarray | None = None,
    ) -> tuple[Memory, Panorama]:
        """Translate and paint one scan of a stream; return the memory for the next scan, and the panorama.

        labels  (N,) int64 ids of SEMANTIC_KITTI of its points, where they are known better than by the segmenter.
        """
        timer = timer or Timer(self.device)
        return self.paint(self.translate(scan, timer, labels), memory, pose, timer)

    @torch.inference_mode()
    def translate(self, scan: Scan, timer: Timer, labels: np.ndarray | None = None) -> Translated:
        """Class scores and depths that a camera would see of the scan.

        labels  (N,) int64 ids of SEMANTIC_KITTI of its points, where they are known better than by the segmenter.
        Points nearer than OWN_VEHICLE_M are not used. Raises InputError when no point of the scan can be used, or none
        is in view.
        """
        with timer("project"):
            scan, points = scan.beyond(), len(scan)
            image = self._checked(scan, self.segmenter.project(scan, self.device))
            if self.input_view is None:  # what the paper's networks are given stays as it is
                scan, image, beside = denser(scan, image)
                labels = None if labels is None else labels[beside.cpu().numpy()]
            around = self._checked(scan, project(scan, self.view, device=self.device))
            read = around
            if self.input_view is not None:
                read = self._checked(scan, project(scan, self.input_view, device=self.device))
        ids = self.segmenter.label(image, timer) if labels is None else torch.from_numpy(labels).to(self.device)
        with timer("translate"):
            channels = around.channels[None]
            given = (channels if read is around else read.channels[None]).contiguous(memory_format=torch.channels_last)
            condition = one_hot_layers(read.spread(ids)[None], CONDITIONS)
            with fast_arithmetic(self.device):
                logits, depth_m = self.translator(given, condition)
            if self.input_view is None:  # what the paper's networks predict stays as it is
                logits, depth_m = corrected(logits, depth_m, channels, self.view)
        beyond_rows = int((image.usable & ~image.inside).sum())
        return Translated(
            name=scan.name,
            labels=ids[:points],
            dropped=image.dropped,
            channels=channels,
            logits=logits,
            depth_m=depth_m,
            gaps_deg=scan.gaps_deg,
            beyond_rows=beyond_rows,
            points_between=len(scan) - points,
        )

    @torch.inference_mode()
    def paint(
        self, translated: Translated, memory: Memory, pose: np.ndarray | None, timer: Timer
    ) -> tuple[Memory, Panorama]:
        """The panorama of a translated scan that follows those in `memory`, and the memory for the next one.

        pose  (4, 4) float64 `T_world_sensor`, metres. If it is always given, classes and depths are averaged over time
              before they are painted (memory.fused), and so is the image (memory.smoothed).
        """
        around = None
        if pose is not None:
            with timer("fuse"):
                around = self._around(translated, memory.around, pose)
                translated = translated._replace(logits=around.segments.clamp(min=TINY).log(), depth_m=around.depth_m)
        with timer("cars"):
            segments, depth_m, tones, cars = self.completed(translated, pose, memory.cars)
        with timer("paint"), fast_arithmetic(self.device):
            scene = Scene(
                segments=segments,
                depth_m=depth_m if around is None else depth_m / around.surface_share,
                channels=translated.channels,
                view=self.view,
                T_world_sensor=pose,
                look=self.look,
                tones=tones,
            )
            painted, image = self.painter.paint(memory.painted, scene)
        previous = None
        if around is not None:
            with timer("steady"):
                previous = self._smoothed(memory.previous, around, image)
                image = previous.image
        with timer("finish"):
            colour = image[0].float().add(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8).movedim(0, 2)
            segments, depth_m = self._finished(segments, depth_m)
            confidence = grow_circular(scene.segments.amax(1, keepdim=True), 2)[0, 0]
            for left, right in translated.gaps_deg:  # nothing is claimed there
                columns = columns_between(self.view.scaled(2), left, right)
                segments[:, columns], depth_m[:, columns], confidence[:, columns] = 0, 0.0, 0.0
            parts = (colour, segments, depth_m, confidence)
            colour, segments, depth_m, confidence = (part.contiguous().cpu().numpy() for part in parts)
        panorama = Panorama(
            name=translated.name,
            frame=memory.frames,
            view=self.view.scaled(2),
            colour=colour,
            segments=segments,
            depth_m=depth_m,
            confidence=confidence,
            labels=translated.labels.cpu().numpy(),
            dropped=translated.dropped,
            beyond_rows=translated.beyond_rows,
            points_between=translated.points_between,
            milliseconds=timer.milliseconds,
        )
        return Memory(frames=memory.frames + 1, painted=painted, cars=cars, around=around, previous=previous), panorama

    def completed(
        self, translated: Translated, pose: np.ndarray | None = None, earlier: Boxes | None = None
    ) -> WholeCars:
        """Probabilities and depths with whole cars; what the paper's networks predict stays as it is, without tones.

        earlier  `boxes` of the scan before. They hang in the world: without a pose they are neither used nor returned.
        """
        segments, depth_m = translated.logits.float().softmax(1), translated.depth_m
        if self.input_view is not None:
            return WholeCars(segments, depth_m, segments.new_full((1, 3, *depth_m.shape[1:]), torch.nan))
        if pose is None:
            return with_cars(segments, depth_m, self.view)._replace(boxes=None)
        return with_cars(segments, depth_m, self.view, pose, earlier)

    def _around(self, translated: Translated, before: Surroundings | None, pose: np.ndarray) -> Surroundings:
        """The scan's classes and depths, averaged with those before."""
        above, _ = rows_beside(translated.channels[:, 0] > 0)
        now = Surroundings(
            segments=translated.logits.float().softmax(1),
            depth_m=translated.depth_m.float(),
            count=torch.ones_like(translated.depth_m[0].float()),
            measured=above[0] >= 0,
            T_world_sensor=torch.from_numpy(np.asarray(pose, dtype=np.float64)).to(translated.depth_m.device),
        )
        return now if before is None else fused(now, before, self.view)

    def _smoothed(self, previous: PreviousFrame | None, around: Surroundings, image: Tensor) -> PreviousFrame:
        """The image, averaged with those before."""
        now = PreviousFrame(
            image=image.float(),
            ids=around.ids,
            distance_m=around.distance_m,
            count=torch.ones_like(around.count),
            T_world_sensor=around.T_world_sensor,
        )
        return now if previous is None else smoothed(now, previous, self.view)

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

    @staticmethod
    def _finished(probabilities: Tensor, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Class ids and depth on the panorama's raster; the sky has no depth."""
        segments = grown_classes(probabilities, 2, least=TINY)
        depth_m = grow_circular(depth_m[None], 2)[0, 0]
        return segments, depth_m.mul_(as_float(segments != SKY))


def load(
    weights: str | Path | Mapping[str, Path] = DEFAULT, device: str | torch.device = "auto", engine: str = "auto"
) -> Pipeline:
    """A pipeline from a released family, a folder or run of weight files, or one file (the rest: default family).

    weights  or what `models.families.weight_files` made of such a name.
    device   "auto" (CUDA if there is one), "cpu" or "cuda".
    engine   "auto" (OpenVINO for what engine="openvino" compiled before, on a CPU that multiplies bfloat16; else
             torch), "torch", "compile" (torch.compile), "onnx" or "openvino". The last three compile each network
             when it is first called.
    Raises InputError when weights, device or engine cannot be had.
    """
    picked = pick_device(device)
    runs_on = pick_engine(engine, picked)
    files = weights if isinstance(weights, Mapping) else weight_files(weights)
    if "renderer" in files:
        raise InputError(f"{files['renderer']}: paints without classes, which `evaluate` can do only; name a family")
    if missing := [part for part in ("segmenter", "translator", "painter") if part not in files]:
        given = weights if isinstance(weights, str | Path) else ", ".join(map(str, files.values()))
        raise InputError(f"{given}: no weights for the {' and the '.join(missing)}; name a family that has them")
    segmenter, segmenter_card = load_segmenter(files["segmenter"], picked, engine)
    translator, card, view = load_translator(files["translator"], picked, engine)
    painter, painter_card = load_painter(files["painter"], files.get("first-frame painter"), view, picked, engine)
    return Pipeline(
        segmenter=segmenter,
        translator=translator,
        painter=painter,
        view=view,
        device=picked,
        cards={"segmenter": segmenter_card, "translator": card, "painter": painter_card},
        engine=runs_on,
        input_view=translator.input_view if isinstance(translator, FrontAllAround) else None,
    )


def load_translator(file: Path, device: torch.device, engine: str = "torch") -> tuple[nn.Module, Card, View]:
    """The translator of a weight file, ready for inference, its card, and the raster that it predicts.

    One of the paper's kind (FRONT_VIEW) runs all around, in torch. InputError where the file holds something else.
    """
    if read_card(file).network not in FRONT_VIEW:
        translator, card = load_part(file, device, expect="titan-pano", engine=engine)
        return translator, card, card_view(file, card, "panorama")
    network, card = load_weights(file, device)
    normalise = validated(Normalisation, card.normalisation, f"{file}: the card's normalisation")
    around = FrontAllAround(network, card_view(file, card, "input"), normalise)
    return around, card, around.view


def load_segmenter(file: Path, device: torch.device, engine: str = "torch") -> tuple[Segmenter, Card]:
    """The segmenter of a weight file, ready for inference; InputError where the file holds something else."""
    network, card = load_part(file, device, expect="salsanext", engine=engine)
    card_view(file, card, "input")
    try:
        return Segmenter.from_card(network, card), card
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def load_painter(
    file: Path, first: Path | None, view: View, device: torch.device, engine: str = "torch"
) -> tuple[StreamPainter, Card]:
    """The painter of a weight file, ready for inference; InputError where the file holds something else.

    first  weights of vid2vid's network for first frames; view: raster of the segments that are painted.
    A vid2vid paints on the raster "panorama" of its card, if it has one; otherwise on the finished panorama's.
    """
    network, card = load_part(file, device, engine=engine)
    if role(card) != "painter":
        raise InputError(f"{file} has weights of another network: {card.network!r} instead of a painter")
    if not isinstance(network, Vid2Vid):
        if first is not None:
            raise InputError(f"{first}: paints the first frames for a 'vid2vid', which {file} is not; name both")
        return cast("StreamPainter", network), card
    single = load_part(first, device, expect="vid2vid-single")[0] if first is not None else None
    raster = card_view(file, card, "panorama") if "panorama" in card.views else view.scaled(2)
    try:
        return Vid2VidPainter.all_around(network, single, raster.columns, view.columns), card
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def load_part(
    file: Path, device: torch.device, expect: str | None = None, engine: str = "torch"
) -> tuple[nn.Module, Card]:
    """A network of the pipeline in the form that is fastest to run, and its card.

    Raises InputError as `models.card.load` and `engines.accelerated`.
    """
    network, card = load_weights(file, device, expect=expect)
    return accelerated(made_fast(network), card.network, card.sha256, engine, device), card


def made_fast(network: nn.Module) -> nn.Module:
    """The network, changed in place to the form that is fastest to run: norms folded, channels last."""
    return fold_norms(network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def card_view(file: Path, card: Card, role: str) -> View:
    """The raster that a card gives for `role`; InputError where it gives none that makes sense."""
    mend = "fetch it or make it again"
    if role not in card.views:
        raise InputError(f"{file}: its card has no view {role!r} that makes sense; {mend}")
    return validated(View, card.views[role], f"{file}: its card has no view {role!r} that makes sense", mend)
