"""The thing itself: a scan in, a panorama out. Projection, segments, translation, paint; the paper's figure 2."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.images import RangeImage, one_hot_layers
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import Memory, Shown, steadied
from lidar2pano.models.card import Card, read_card
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.circular import fold_norms, grow_circular, grown_classes
from lidar2pano.models.families import DEFAULT, weight_files
from lidar2pano.models.painter import Scene, StreamPainter
from lidar2pano.models.precision import fast_arithmetic, pick_device
from lidar2pano.models.segmenter import Segmenter
from lidar2pano.models.vid2vid_painter import Vid2VidPainter
from lidar2pano.panorama import Panorama
from lidar2pano.scan import OWN_VEHICLE_M, Scan
from lidar2pano.sensors import VIEWS, View


class Translated(NamedTuple):
    """A scan on its way to a panorama, before it is painted, on the translator's raster H x W.

    labels    (N,) int64 ids of SEMANTIC_KITTI of the scan's points; dropped: how many of them could not be used.
    channels  (1, 5, H, W) float32: the scan's RangeImage.
    logits    (1, 16, H, W) of COMMON15;  depth_m (1, H, W) float32, metres.
    """

    labels: Tensor
    dropped: int
    channels: Tensor
    logits: Tensor
    depth_m: Tensor


@dataclass(slots=True)
class Stopwatch:
    """Milliseconds per stage, in order."""

    device: torch.device
    milliseconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what happens inside; on CUDA, until it is done."""
        begin = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.milliseconds[stage] = (time.perf_counter() - begin) * 1e3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pipeline:
    """Three networks and the raster they meet on.

    segmenter   scan -> a class of SEMANTIC_KITTI per point.
    translator  (image (1, 5, H, W), condition (1, 20, H, W)) -> logits (1, 16, H, W) of COMMON15, depth (1, H, W) m.
    painter     (what it remembers, Scene) -> (that, (1, 3, 2H, 2W)).
    view        the translator's raster, H x W, around the camera that the picture is taken from.
    look        which of the painter's looks is painted: "A", "A+B" for the mean of two, "" for its own.
    """

    segmenter: Segmenter
    translator: nn.Module
    painter: StreamPainter
    view: View
    device: torch.device
    look: str = ""

    def at(self, calibration: Calibration) -> Pipeline:
        """The pipeline with its viewpoint moved to a camera's optical centre."""
        return replace(self, view=at_camera(self.view, calibration))

    def for_sensor(self, name: str) -> Pipeline:
        """The pipeline with the segmenter's view that fits a sensor of VIEWS; InputError where there is none."""
        return replace(self, segmenter=replace(self.segmenter, view=sensor_view(name)))

    def __call__(self, scan: Scan) -> Panorama:
        """The panorama of a single scan."""
        return next(self.stream([scan]))

    def stream(self, scans: Iterable[Scan], poses: Iterable[np.ndarray] | None = None) -> Iterator[Panorama]:
        """Panoramas of scans that follow each other; with a pose for each (see `step`), steadied."""
        memory = Memory()
        for scan, pose in zip(scans, itertools.repeat(None) if poses is None else poses, strict=False):
            memory, panorama = self.step(memory, scan, pose)
            yield panorama

    @torch.inference_mode()
    def step(self, memory: Memory, scan: Scan, pose: np.ndarray | None = None) -> tuple[Memory, Panorama]:
        """One scan: (what the stream carries on, its panorama).

        pose  (4, 4) float64: the sensor's coordinates -> coordinates that stand still, metres. Told with every scan,
              the picture is steadied by those before (memory.steadied).
        Raises InputError when no point of the scan can be used, or none is in view. Points nearer than OWN_VEHICLE_M
        are not used.
        """
        watch = Stopwatch(self.device)
        seen = self.translated(scan, watch)
        with watch("paint"), fast_arithmetic(self.device):
            segments = seen.logits.softmax(1)
            scene = Scene(
                segments=segments,
                depth_m=seen.depth_m,
                image=seen.channels,
                view=self.view,
                T_world_sensor=pose,
                look=self.look,
            )
            painted, picture = self.painter.paint(memory.painted, scene)
        shown = None
        if pose is not None:
            with watch("steady"):
                shown = self._steadied(memory.shown, seen, picture, pose)
                picture = shown.picture
        with watch("finish"):
            colour = picture[0].float().add(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8).movedim(0, 2)
            segments, depth_m = self._finished(seen.logits, seen.depth_m)
            colour, segments, depth_m = (part.contiguous().cpu().numpy() for part in (colour, segments, depth_m))
        panorama = Panorama(
            name=scan.name,
            frame=memory.frames,
            view=self.view.scaled(2),
            colour=colour,
            segments=segments,
            depth_m=depth_m,
            labels=seen.labels.cpu().numpy(),
            dropped=seen.dropped,
            milliseconds=watch.milliseconds,
        )
        return Memory(frames=memory.frames + 1, painted=painted, shown=shown), panorama

    def _steadied(self, before: Shown | None, seen: Translated, picture: Tensor, pose: np.ndarray) -> Shown:
        ids = seen.logits[0].max(0).indices.to(torch.uint8)
        distance_m = torch.where(ids == COMMON15.id_of("sky"), torch.inf, seen.depth_m[0].float())
        here = torch.from_numpy(np.asarray(pose, dtype=np.float64)).to(ids.device)
        count = torch.ones_like(distance_m)
        now = Shown(picture=picture.float(), ids=ids, distance_m=distance_m, count=count, pose=here)
        return now if before is None else steadied(now, before, self.view)

    @torch.inference_mode()
    def translated(self, scan: Scan, watch: Stopwatch) -> Translated:
        """What a camera would see of the scan, as class scores and depths; raises like `step`."""
        with watch("project"):
            scan = scan.beyond()
            image = self._seen(scan, project(scan, self.segmenter.view, device=self.device))
            around = self._seen(scan, project(scan, self.view, device=self.device))
        with watch("segment"):
            ids = self.segmenter.raster(image)
        with watch("clean_up"):
            labels = clean_up(image, ids)
        with watch("translate"), fast_arithmetic(self.device):
            channels = around.channels[None].contiguous(memory_format=torch.channels_last)
            condition = one_hot_layers(around.spread(labels)[None], len(SEMANTIC_KITTI))
            logits, depth_m = self.translator(channels, condition)
        return Translated(labels=labels, dropped=image.dropped, channels=channels, logits=logits, depth_m=depth_m)

    @staticmethod
    def _seen(scan: Scan, image: RangeImage) -> RangeImage:
        if not bool(image.usable.any()):
            raise InputError(
                f"{scan.name}: none of its {len(scan)} points can be used (NaN, Inf or nearer than"
                f" {OWN_VEHICLE_M:g} m, which is the vehicle itself); check how the scan was written"
            )
        if not bool(image.valid.any()):
            raise InputError(f"{scan.name}: no point is in view (x must point forward, z up, in metres); turn the scan")
        return image

    @staticmethod
    def _finished(logits: Tensor, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Class ids and depth at the picture's raster; the sky has no depth."""
        segments = grown_classes(logits, 2)
        depth_m = grow_circular(depth_m[None], 2)[0, 0]
        return segments, torch.where(segments == COMMON15.id_of("sky"), 0.0, depth_m)


def load(weights: str | Path = DEFAULT, device: str = "auto") -> Pipeline:
    """A pipeline from a released family, a folder or run of weight files, or one file (the rest: default family).

    device  "auto" (CUDA if there is one), "cpu" or "cuda".
    Raises InputError when weights or device cannot be had.
    """
    picked = pick_device(device)
    files = weight_files(weights)
    if missing := [role for role in ("segmenter", "translator", "painter") if role not in files]:
        raise InputError(f"{weights}: no weights for the {' and the '.join(missing)}; name a family that has them")
    translator, card = load_part(files["translator"], picked, expect="titan-pano")
    view = card_view(files["translator"], card, "panorama")
    return Pipeline(
        segmenter=load_segmenter(files["segmenter"], picked),
        translator=translator,
        painter=load_painter(files["painter"], files.get("first-frame painter"), view, picked),
        view=view,
        device=picked,
    )


def load_segmenter(file: Path, device: torch.device) -> Segmenter:
    """The segmenter of a weight file, ready for inference; InputError where the file holds something else."""
    network, card = load_part(file, device, expect="salsanext")
    card_view(file, card, "input")
    return Segmenter.from_card(network, card)


def load_painter(file: Path, first: Path | None, view: View, device: torch.device) -> StreamPainter:
    """The painter of a weight file, ready for inference; InputError where the file holds something else.

    first  weights of vid2vid's network for first frames; view: raster of the segments that are painted.
    A vid2vid paints on the raster "panorama" of its card, if it has one; otherwise on the finished panorama's.
    """
    if read_card(file).network != "vid2vid":
        if first is not None:
            raise InputError(f"{first}: paints the first frames for a 'vid2vid', which {file} is not; name both")
        painter, card = load_part(file, device)
        if card.network not in ("painter", "scene-painter"):
            raise InputError(f"{file} has weights of another network: {card.network!r} instead of a painter")
        return painter  # pyright: ignore[reportReturnType] a painter, since that was expected
    generator, card = load_part(file, device)
    single = load_part(first, device, expect="vid2vid-single")[0] if first is not None else None
    raster = card_view(file, card, "panorama") if "panorama" in card.views else view.scaled(2)
    try:
        return Vid2VidPainter.all_around(generator, single, raster.columns, view.columns)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def load_part(file: Path, device: torch.device, expect: str | None = None) -> tuple[nn.Module, Card]:
    """A network of the pipeline in the form that is fastest to run, and its card; InputError as `models.card.load`."""
    network, card = load_weights(file, device, expect=expect)
    return made_fast(network), card


def made_fast(network: nn.Module) -> nn.Module:
    """The network, changed in place to the form that is fastest to run: norms folded, channels last."""
    return fold_norms(network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def card_view(file: Path, card: Card, role: str) -> View:
    """The raster that a card gives for `role`; InputError where it gives none that makes sense."""
    try:
        return View(**card.views[role])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{file}: its card has no view {role!r} that makes sense; fetch or make it anew") from None


def sensor_view(name: str) -> View:
    """The raster of a sensor's rows in VIEWS (spheres only: the panorama is no sensor); InputError for another name."""
    sensors = {sensor: view for sensor, view in VIEWS.items() if view.kind == "sphere"}
    if name not in sensors:
        raise InputError(f"no sensor {name!r}{closest(name, sensors)}")
    return sensors[name]
