"""The pipeline in the paper's order (its figure 2): measure, predict, remember, paint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, Unpack

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.projection import (
    RangeImage,
    measured_elevation,
    nearest_ranges,
    one_hot_layers,
    project,
)
from lidar2pano.geometry.rasters import likeliest
from lidar2pano.geometry.stitching import Camera
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import Memory, remember, steady
from lidar2pano.models.card import Card
from lidar2pano.models.families import BEST, weight_files
from lidar2pano.models.hub import Upload, hub_folder, push_family, write_family
from lidar2pano.models.latent_painter import LatentPainter
from lidar2pano.models.stream_painter import StreamPainter, check_variant
from lidar2pano.models.titan_pano import STRIDE, FrontAllAround, with_rows
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline.assembly import load_parts
from lidar2pano.pipeline.belief import believed
from lidar2pano.pipeline.composition import compose, photographed, sound_cameras
from lidar2pano.pipeline.segmenter import Segmenter
from lidar2pano.recordings.recorded_scans import read
from lidar2pano.scan import OWN_VEHICLE_M, Scan
from lidar2pano.scene.depth import denser, measured_depth
from lidar2pano.scene.record import ScanPoints, Scene
from lidar2pano.scene.surfaces import viewpoint_height
from lidar2pano.views import View, elevation_range, sensor_view

MARGIN_DEG, MOST_DEG = 10.0, (-35.0, 45.0)  # what "auto" adds to a sensor's elevations, and how far it goes
ROAD, CONDITIONS = COMMON15.id_of("road"), len(SEMANTIC_KITTI)

ValueT = TypeVar("ValueT")


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
    fits        whether rows are added to it as far as a stream's first scan asks for (`reaching`).
    cards       of the weight files, by role.
    look        one of the painter's looks: "A", "A+B" for the mean of two, "" for its own.
    engine      the engine that computes the networks: of ENGINES, but not "auto".
    files       the weight files, by role.
    """

    segmenter: Segmenter
    translator: nn.Module
    painter: StreamPainter
    view: View
    device: torch.device
    cards: Mapping[str, Card] = field(default_factory=dict)
    fits: bool = False
    look: str = ""
    engine: str = "torch"
    files: Mapping[str, Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return networks, raster, device and engine, without the layers."""
        networks = [card.network for card in self.cards.values()] or ["networks without cards"]
        raster = f"{self.view.rows} x {self.view.columns}"
        return f"{type(self).__name__}({' -> '.join(networks)}, {raster}, {self.device.type}, {self.engine})"

    @classmethod
    def from_pretrained(
        cls,
        pretrained_model_name_or_path: str | Path,
        *,
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
        device: str | torch.device = "auto",
        engine: str = "auto",
    ) -> Pipeline:
        """Return the pipeline of a folder, an installed family, or a repository "owner/name" of the hub.

        Like huggingface_hub's mixin; device and engine are those of `load`. All parts must come from there: nothing is
        filled in. Only safetensors, LICENSE and README.md are fetched, and nothing is executed.
        Raises InputError as `load` and `models.hub.hub_folder`.
        """
        name = pretrained_model_name_or_path
        folder = hub_folder(name, revision, cache_dir, force_download, token, local_files_only)
        return assemble(**load_parts(weight_files(folder, fill=False), device, engine, name))

    def save_pretrained(
        self,
        save_directory: str | Path,
        *,
        repo_id: str | None = None,
        push_to_hub: bool = False,
        **push_to_hub_kwargs: Unpack[Upload],
    ) -> str | None:
        """Write the weight files, their LICENSE and a model card (README.md) into a folder; one that is there stays.

        Weights are written as they were loaded; look, viewpoint, quality and seed are not. With push_to_hub also
        uploads them to `repo_id` (the folder's name) and returns the address of the commit.
        Raises InputError where the weights changed since, or the folder holds others.
        """
        write_family(Path(save_directory), self.files, self.cards)
        if not push_to_hub:
            return None
        return self.push_to_hub(repo_id or Path(save_directory).name, **push_to_hub_kwargs)

    def push_to_hub(self, repo_id: str, **upload: Unpack[Upload]) -> str:
        """Upload the files of `save_pretrained` to a repository of the hub; returns the address of the commit.

        upload  commit_message, private, token, branch, create_pr, allow_patterns, ignore_patterns, delete_patterns, as
                of huggingface_hub's mixin.
        Raises InputError without huggingface_hub or a network, and where the hub refuses.
        """
        return push_family(repo_id, self.files, self.cards, upload)

    def at(self, calibration: Calibration | LensCalibration) -> Pipeline:
        """Return the pipeline with its viewpoint moved to a camera's optical centre."""
        return replace(self, view=at_camera(self.view, calibration))

    def for_sensor(self, name: str) -> Pipeline:
        """Return the pipeline with the segmenter's view that fits a sensor of VIEWS; InputError where there is none."""
        return replace(self, segmenter=self.segmenter.at(sensor_view(name)))

    def reaching(self, elevation: str | tuple[float, float]) -> Pipeline:
        """Return the pipeline of panoramas from LOW to HIGH degrees, or, "auto", of what each sensor sees and more.

        Rows are added or left out, STRIDE at a time; all others are as before. "auto" adds MARGIN_DEG to the elevations
        of a scan, of a stream's first one, up to MOST_DEG, and leaves nothing out.
        Raises InputError for another elevation, and where the weights have a fixed view.
        """
        ends = elevation_range(elevation)
        return replace(self, fits=True) if ends is None else replace(self, view=self._with_rows(*ends), fits=False)

    def _with_rows(self, low: float, high: float) -> View:
        up, down = (math.tan(math.radians(degrees)) for degrees in (high, low))
        return self.view.between(up, down, STRIDE)

    def fitted(self, scan: Scan, memory: Memory) -> Pipeline:
        """Return the pipeline with the rows that a stream's first scan asked for, or this one (`reaching` "auto")."""
        if not self.fits:
            return self
        if (view := memory.view) is None:
            low, high = measured_elevation(scan.beyond()) or (0.0, 0.0)
            least, most = (math.degrees(math.atan(end)) for end in (self.view.down, self.view.up))
            low, high = max(low - MARGIN_DEG, MOST_DEG[0]), min(high + MARGIN_DEG, MOST_DEG[1])
            view = self._with_rows(min(low, least), max(high, most))
        return replace(self, view=replace(view, origin=self.view.origin))

    def in_look(self, look: str) -> Pipeline:
        """Return the pipeline that paints a look, "A" or "A+B"; InputError where the painter lacks it."""
        if not isinstance(self.painter, LatentPainter):
            raise InputError(
                f"no look {look!r}: these weights paint one look only; choose a latent painter's, or name a painter's"
                f" file {look}.safetensors"
            )
        self.painter.look_shares(look)
        return replace(self, look=look)

    def in_variant(self, quality: str = "fast", seed: int = 0) -> Pipeline:
        """Return the pipeline that paints in a quality of QUALITIES, and the plausible picture of a seed.

        Raises InputError as `check_variant`, and where the painter has one quality and one picture only.
        """
        check_variant(quality, seed)
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
        poses: Iterable[np.ndarray | None] | None = None,
        cameras: Iterable[Sequence[Camera]] | None = None,
    ) -> Iterator[Panorama]:
        """Yield panoramas of consecutive scans; with a pose for each (see `remember`), temporally smoothed.

        poses    one for each scan, None where it is unknown;  cameras: of each scan, as for a single one.
        The stream ends with the scans: poses and cameras may be endless, or of later scans too.
        Raises InputError for a scan that has none left.
        """
        memory = Memory()
        pose_of_each = iter(itertools.repeat(None) if poses is None else poses)
        cameras_of_each = iter(itertools.repeat(()) if cameras is None else cameras)
        for number, scan in enumerate(scans):
            pose = _next_of(pose_of_each, "pose", number, scan)
            own_cameras = _next_of(cameras_of_each, "list of cameras", number, scan)
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
        own = self.fitted(scan, memory)
        measurement = own.measure(scan, timer, labels)
        scene = own.predict(measurement, timer)
        memory, scene = own.remember(memory, scene, pose, timer)
        kept, doubts = cameras, ()
        if cameras:
            with timer("cameras"):
                kept, doubts = sound_cameras(cameras, scan, edges=memory.frames == 0)
        memory, panorama = own.paint(memory, scene, timer, kept)
        return memory, replace(panorama, doubts=doubts)

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
            channels = project(dense, self.view, device=self.device)
            if not bool(channels.valid.any()):
                low, high = (math.degrees(math.atan(end)) for end in (self.view.down, self.view.up))
                raise InputError(
                    f"{scan.name}: no point lies between {low:.1f} and {high:.1f} degrees; widen --elevation, or turn"
                    " the scan (x must point forward, z up)"
                )
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
            scene = Scene(
                view=self.view,
                channels=channels,
                probabilities=probabilities,
                depth_m=measured_depth(guessed_m, channels, ids, viewpoint_m, self.view),
                viewpoint_m=viewpoint_m,
                points=measurement.points,
            )
            vars(scene)["ids"] = ids  # computed already
            return scene

    @torch.inference_mode()
    def remember(self, memory: Memory, scene: Scene, pose: np.ndarray | None, timer: Timer) -> tuple[Memory, Scene]:
        """Fuse a scene with those of the previous scans; returns the memory with it, and the fused scene.

        pose  (4, 4) float64 `T_world_sensor`, metres. If it is always given, classes are averaged over time
              (memory.fused), and so is the image (memory.smoothed). Without it the stream begins again.
        """
        memory = replace(memory, view=self.view if self.fits else None)
        if pose is None:
            return replace(memory, around=None, previous=None), scene
        with timer("fuse"):
            return remember(memory, replace(scene, T_world_sensor=pose))

    @torch.inference_mode()
    def paint(
        self, memory: Memory, scene: Scene, timer: Timer, cameras: Sequence[Camera] = ()
    ) -> tuple[Memory, Panorama]:
        """Paint a scene that `remember` returned; returns the memory for the next scan, and the panorama.

        cameras  sound ones: where they see, the panorama is theirs, and a painter that can goes on from it.
        """
        panorama, real = None, None
        if cameras:
            with timer("cameras"):
                panorama = believed(scene, memory.frames)
                real = photographed(panorama, cameras)
                scene = replace(scene, photographed=real.signed(self.device))
        with timer("paint"), fast_arithmetic(self.device):
            painted, image = self.painter.paint(memory.painted, scene, self.look)
        if memory.around is not None:
            with timer("steady"):
                memory, image = steady(memory, image, self.view)
        with timer("finish"):
            panorama = panorama or believed(scene, memory.frames)
            colour = image[0].float().add(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8).movedim(0, 2)
            panorama = replace(panorama, colour=colour.contiguous().cpu().numpy(), milliseconds=timer.milliseconds)
        if real:
            with timer("cameras"):
                panorama = compose(panorama, real)
        return replace(memory, frames=memory.frames + 1, painted=painted), panorama

    def _densified(self, scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
        """Return the scan and its image with points between the beams; and the scan's point of each."""
        return denser(scan, image)

    def _translator_image(self, scan: Scan, image: RangeImage) -> RangeImage:  # noqa: ARG002 the paper's needs it
        """Return the range image that the translator reads; image: on the scene's raster."""
        return image

    def _translated(self, measurement: Measurement) -> tuple[Tensor, Tensor]:
        """Return the translator's probabilities (1, 16, H, W) and depths (1, H, W), float32."""
        channels = with_rows(measurement.translator_channels, self.view)
        channels = channels.contiguous(memory_format=torch.channels_last)
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
    """The paper's pipeline: a range view in, front-view networks all around; scan and predictions stay as they are."""

    translator: FrontAllAround

    def reaching(self, elevation: str | tuple[float, float]) -> Pipeline:
        """Refuse another elevation (InputError): the networks predict a camera's rows."""
        raise InputError(
            f"elevation {elevation!r}: these weights paint the rows of one camera; name others, or leave it"
        )

    @torch.inference_mode()
    def predict(self, measurement: Measurement, timer: Timer) -> Scene:
        """Predict classes and depths all around."""
        with timer("translate"):
            probabilities, depth_m = self._translated(measurement)
            return Scene(
                view=self.view,
                channels=measurement.channels,
                probabilities=probabilities,
                depth_m=depth_m,
                viewpoint_m=viewpoint_height(depth_m, likeliest(probabilities) == ROAD, self.view),
                points=measurement.points,
            )

    def _densified(self, scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
        return scan, image, torch.arange(len(scan), device=image.index.device)

    def _translator_image(self, scan: Scan, image: RangeImage) -> RangeImage:  # noqa: ARG002
        return self._checked(scan, project(scan, self.translator.input_view, device=self.device))


def _next_of(values: Iterator[ValueT], kind: str, number: int, scan: Scan) -> ValueT:
    """Return the next value, of a scan of a stream; InputError where none is left."""
    for value in values:
        return value
    unknown = "None where it is unknown" if kind == "pose" else "() where there is none"
    raise InputError(
        f"no {kind} is left for scan {number} of the stream ({scan.name}); give one for each scan, {unknown}"
    )


def load(
    weights: str | Path | Mapping[str, Path] = BEST, device: str | torch.device = "auto", engine: str = "auto"
) -> Pipeline:
    """A pipeline from a family, a folder or run of weight files, or one file (the rest: best family).

    weights  a name; "best": the best installed family, which the logger "lidar2pano" names; or what
             `models.families.weight_files` made of a name.
    device   "auto" (CUDA if there is one), "cpu" or "cuda".
    engine   "auto" (OpenVINO for what engine="openvino" compiled before, on a CPU that multiplies bfloat16; else
             torch), "torch", "compile" (torch.compile), "onnx" or "openvino". The last three compile each network
             when it is first called.
    Raises InputError when weights, device or engine cannot be had.
    """
    files = weights if isinstance(weights, Mapping) else weight_files(weights)
    source = weights if isinstance(weights, str | Path) else ", ".join(map(str, files.values()))
    return assemble(**load_parts(files, device, engine, source))


def assemble(translator: nn.Module, **parts: Any) -> Pipeline:  # noqa: ANN401 fields of a Pipeline
    """Build the pipeline that fits a translator: ours, or the paper's for a FrontAllAround."""
    if isinstance(translator, FrontAllAround):
        return PaperPipeline(translator=translator, **parts)
    return Pipeline(translator=translator, **parts)
