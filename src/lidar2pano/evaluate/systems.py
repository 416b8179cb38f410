"""Systems for the camera's image (front-view translators, renderers, the oracle), and systems by names of weights.

Roles of weight files are those of `models.families.role`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.errors import InputError
from lidar2pano.evaluate.panorama_system import NoPainter, PanoramaSystem, Prediction, System, SystemInfo, SystemInput
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.geometry.projection import Normalisation, one_hot_layers, project
from lidar2pano.geometry.rasters import as_image
from lidar2pano.hardware import Timer, fast_arithmetic, pick_device
from lidar2pano.labels import SEMANTIC_KITTI, TABLES
from lidar2pano.models import families
from lidar2pano.models.card import Card, load, read_card
from lidar2pano.models.vid2vid import Vid2Vid, Vid2VidSingle
from lidar2pano.models.vid2vid_painter import Past, Vid2VidPainter
from lidar2pano.pipeline import Segmenter, assemble, card_view, load_painter, load_segmenter, load_translator
from lidar2pano.scene.depth import depth_code
from lidar2pano.views import VIEWS, View, elevation_range, sensor_view

STEADY = "steady"  # last part of a chain: panoramas are smoothed over time by the sensor's poses
ORACLE = "oracle"  # first part of a chain: ground-truth camera labels
ROLES = ("segmenter", "translator", "renderer", "painter", "first-frame painter")
CARD_ENTRIES = ("network", "recipe", "data", "steps", "hours", "commit", "sha256")  # of each network, in results


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPainter:
    """vid2vid: paints label maps of the camera, each frame after the previous one.

    scale  of the painted image to the camera's: objects are as large as in training.
    """

    painter: Vid2VidPainter
    scale: float
    device: torch.device

    @classmethod
    def from_files(cls, file: Path, first: Path | None, device: torch.device) -> Self:
        """Return the painter of a weight file, and of that of vid2vid's network for first frames, if there is one.

        Raises InputError for another network than vid2vid: its inputs (depth, remission, a panorama) do not exist
        behind a translator of the paper's kind.
        """
        if (network := read_card(file).network) != "vid2vid":
            raise InputError(f"{file}: a {network!r} paints panoramas only; only 'vid2vid' paints a camera's labels")
        generator, card = load(file, device, expect="vid2vid")
        single = load(first, device, expect="vid2vid-single")[0] if first is not None else None
        try:
            painter = Vid2VidPainter(cast("Vid2Vid", generator), cast("Vid2VidSingle | None", single), closed=False)
        except InputError as error:
            raise InputError(f"{file}: {error}") from None
        return cls(painter=painter.eval(), scale=training_scale(card), device=device)

    def paint(self, past: Past | None, ids: Tensor) -> tuple[Past, np.ndarray]:
        """Paint ids (h, w) of COMMON15 after earlier ones: the memory for the next frame, (h, w, 3) uint8 RGB."""
        size = (int(ids.shape[0]), int(ids.shape[1]))
        scaled = (round(size[0] * self.scale), round(size[1] * self.scale))
        ids = interpolate(ids.to(self.device)[None, None].to(torch.uint8), size=scaled, mode="nearest-exact")[0, 0]
        with fast_arithmetic(self.device):
            past, colour = self.painter.follow(past, ids)
        return past, to_image(colour, size)


def training_scale(card: Card) -> float:
    """Return the size of a painter's training images, relative to KITTI's: by the raster of its panorama."""
    raster = card.views.get("panorama")
    return raster["columns"] / VIEWS["panorama"].columns if raster else 1.0


def to_image(colour: Tensor, size: tuple[int, int]) -> np.ndarray:
    """Resize colours (3, H, W) in [-1, 1] to `size` (rows, columns): (rows, columns, 3) uint8."""
    colour = colour.float()
    if colour.shape[1:] != size:
        colour = interpolate(colour[None], size=size, mode="bilinear", align_corners=False, antialias=True)[0]
    return as_image(colour)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraTranslator:
    """TITAN-Net, its ablations, TITAN-Next and Pix2Pix: front view and point labels in, the camera's labels out.

    translator  (lidar (1, 5, H, W), condition (1, 20, H, W)) -> logits (1, 15, h, w) of COMMON14, or those and depth.
    painter     paints them; None: only labels are predicted.
    Networks run in float32: instance norms amplify bfloat16's rounding errors.
    """

    info: SystemInfo
    segmenter: Segmenter
    translator: nn.Module
    view: View
    normalise: Normalisation
    device: torch.device
    painter: CameraPainter | None = None
    uses_ground_truth: bool = False

    @torch.inference_mode()
    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """As System; scores are resized bilinearly to the camera's image before the argmax."""
        if inputs.calibration is None:
            range_image = self.segmenter.project(inputs.scan, self.device)
            ids = self.segmenter.label(range_image, Timer(self.device))
            return memory, Prediction(point_labels=ids.cpu().numpy())
        timer = Timer(self.device)
        with timer("project"):
            range_image = self.segmenter.project(inputs.scan, self.device)
            front = project(inputs.scan, self.view, device=self.device)
        point_labels = self.segmenter.label(range_image, timer)
        with timer("translate"):
            condition = one_hot_layers(front.spread(point_labels)[None], len(SEMANTIC_KITTI))
            output = self.translator(self.normalise(front)[None], condition)
            logits, depth_m = output if isinstance(output, tuple) else (output, None)
        with timer("camera"):
            width, height = inputs.calibration.size
            table = torch.from_numpy(TABLES["common-14", "common-15"]).to(self.device)
            ids = table[_resized(logits, (height, width))[0].max(0).indices]
            if depth_m is not None:
                depth_m = _resized(depth_m[None], (height, width))[0, 0].cpu().numpy()
        image = None
        if self.painter is not None and inputs.colours:
            with timer("paint"):
                memory, image = self.painter.paint(memory, ids)
        return memory, Prediction(
            point_labels=point_labels.cpu().numpy(),
            camera_labels=ids.cpu().numpy(),
            image=image,
            depth_m=depth_m,
            milliseconds=timer.milliseconds,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraRenderer:
    """SC-UNET, and Pix2Pix and TITAN-Net without labels: the scan in, the camera's colours out.

    renderer  input (1, C, H, W) -> (1, 3, h, w) in [-1, 1].
    view      of its input, a range image; None: its input is the scan projected into the camera.
    size      rows and columns of that projection; None: those of the camera's image.
    channels  of that projection: 1, remission; 2, remission and range.
    """

    info: SystemInfo
    renderer: nn.Module
    view: View | None
    normalise: Normalisation
    device: torch.device
    size: tuple[int, int] | None = None
    channels: int = 1
    uses_ground_truth: bool = False

    @torch.inference_mode()
    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """As System: only the camera's image."""
        if inputs.calibration is None or not inputs.colours:
            return memory, Prediction()
        timer = Timer(self.device)
        with timer("project"):
            x = self._network_input(inputs)
        with timer("render"):
            colour = self.renderer(x)[0]
        with timer("camera"):
            width, height = inputs.calibration.size
            image = to_image(colour, (height, width))
        return memory, Prediction(image=image, milliseconds=timer.milliseconds)

    def _network_input(self, inputs: SystemInput) -> Tensor:
        assert inputs.calibration is not None
        if self.view is not None:
            return self.normalise(project(inputs.scan, self.view, device=self.device))[None]
        width, height = inputs.calibration.size
        lidar = project_to_camera(inputs.scan, inputs.calibration, self.size or (height, width)).to(self.device)
        return torch.stack([lidar[0], depth_code(lidar[1])])[None, : self.channels]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Oracle:
    """The ground-truth camera labels, painted: an upper bound for a painter behind a translator."""

    info: SystemInfo
    painter: CameraPainter
    uses_ground_truth: bool = True

    @torch.inference_mode()
    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """As System: an image if labels are known."""
        if inputs.camera_labels is None or not inputs.colours:
            return memory, Prediction()
        timer = Timer(self.painter.device)
        with timer("paint"):
            ids = torch.from_numpy(np.ascontiguousarray(inputs.camera_labels))
            memory, image = self.painter.paint(memory, ids)
        return memory, Prediction(image=image, milliseconds=timer.milliseconds)


def _resized(layers: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize (1, C, H, W) to (1, C, *size) float32."""
    return interpolate(layers.float(), size=size, mode="bilinear", align_corners=False)


def system(
    weights: str | Path,
    device: str = "auto",
    sensor: str = "",
    engine: str = "torch",
    elevation: str = "",
) -> System:
    """A system, ready to predict.

    weights  a family, a run, a folder of weight files or a file; several joined by "+" are one system, in which later
             ones take the places of earlier ones. By the cards: titan-pano (`PanoramaSystem`); titan, titan-next or
             pix2pix for classes (`CameraTranslator`); scunet, or titan or pix2pix for colours (`CameraRenderer`).
             "oracle": `Oracle`, with a painter. Behind a `CameraTranslator` or "oracle" only vid2vid paints.
             Segmenters without a name, and titan-pano's painter, are the default family's.
             "+steady" behind a titan-pano: temporal smoothing by the sensor's poses.
    device   "auto" (CUDA if there is one), "cpu" or "cuda";  sensor: as for Pipeline.for_sensor, "" for the weights'.
    engine   what computes the networks of a pipeline, as for pipeline.load; others run in torch.
    elevation  as for Pipeline.reaching, "" for the usual rows.
    Raises InputError when something is missing, damaged, or does not belong together.
    """
    parts = families.chained(weights)
    if not elevation:
        return _system(parts, device, sensor, engine)
    elevation_range(elevation)
    usual = _system(parts, device, sensor, engine)
    if not isinstance(usual, PanoramaSystem):
        raise InputError(
            f"{usual.info.name}: elevation {elevation!r} is of panoramas; these predict a camera's image,"
            " so leave it out"
        )
    return replace(usual, pipeline=usual.pipeline.reaching(elevation))


def _system(parts: list[str], device: str, sensor: str, engine: str) -> System:
    name, picked = "+".join(parts), pick_device(device)
    if STEADY in parts[1:]:
        return _steady(name, _system([part for part in parts if part != STEADY], device, sensor, engine))
    view = sensor_view(sensor) if sensor else None
    if parts[0] == ORACLE:
        return _oracle(name, _merged(parts[1:]), picked)
    named = _merged(parts)
    if "renderer" in named:
        return _renderer(name, named, picked)
    default = families.weight_files(families.BEST) if families.families() else {}
    files = default | named
    if missing := [role for role in ("segmenter", "translator") if role not in files]:
        raise InputError(f"{name}: no weights for the {' and the '.join(missing)}; name a family that has them")
    segmenter, _ = load_segmenter(files["segmenter"], picked, engine)
    if view is not None:
        segmenter = segmenter.at(view)
    if read_card(files["translator"]).network in families.FRONT_VIEW:
        used = {role: files[role] for role in ("segmenter", "translator")}
        used |= {role: named[role] for role in ("painter", "first-frame painter") if role in named}
        return _translator(name, used, segmenter, picked)
    return _panorama(name, _own_painter(files, named), segmenter, picked, engine)


def _steady(name: str, plain: System) -> System:
    if not isinstance(plain, PanoramaSystem) or not plain.paints:
        raise InputError(f"{name}: only painted panoramas can be smoothed over time; leave +{STEADY} out")
    return replace(plain, info=replace(plain.info, name=name), steady=True)


def _merged(parts: list[str]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for part in parts:
        files |= families.weight_files(part, fill=False)
    return files


def _own_painter(files: dict[str, Path], named: dict[str, Path]) -> dict[str, Path]:
    """The files, without the default family's first-frame painter where a painter was named without one."""
    if "painter" in named and "first-frame painter" not in named:
        return {role: file for role, file in files.items() if role != "first-frame painter"}
    return files


def _info(name: str, files: Mapping[str, Path]) -> SystemInfo:
    files = {role: files[role] for role in ROLES if role in files}
    cards = {role: read_card(file) for role, file in files.items()}
    networks = {
        role: {name: getattr(card, name) for name in CARD_ENTRIES} | {"split": card.score.get("split", "")}
        for role, card in cards.items()
    }
    return SystemInfo(name=name, files=files, networks=networks)


def _panorama(
    name: str, files: dict[str, Path], segmenter: Segmenter, device: torch.device, engine: str
) -> PanoramaSystem:
    translator, _, view = load_translator(files["translator"], device, engine)
    first = files.get("first-frame painter")
    painter = load_painter(files["painter"], first, view, device, engine)[0] if "painter" in files else NoPainter()
    return PanoramaSystem(
        info=_info(name, files),
        pipeline=assemble(translator, segmenter=segmenter, painter=painter, view=view, device=device),
        paints="painter" in files,
    )


def _translator(name: str, files: dict[str, Path], segmenter: Segmenter, device: torch.device) -> CameraTranslator:
    translator, card = load(files["translator"], device)
    return CameraTranslator(
        info=_info(name, files),
        segmenter=segmenter,
        translator=translator,
        view=card_view(files["translator"], card, "input"),
        normalise=_normalise(card),
        device=device,
        painter=_camera_painter(files, device),
    )


def _renderer(name: str, files: dict[str, Path], device: torch.device) -> CameraRenderer:
    if extra := sorted(files.keys() - {"renderer"}):
        raise InputError(f"{name}: a renderer predicts colours by itself, so the {extra[0]} has no place; leave it out")
    renderer, card = load(files["renderer"], device)
    camera: dict[str, Any] = card.views.get("camera", {})
    return CameraRenderer(
        info=_info(name, files),
        renderer=renderer,
        view=card_view(files["renderer"], card, "input") if card.network != "scunet" else None,
        normalise=_normalise(card),
        device=device,
        size=(int(camera["rows"]), int(camera["columns"])) if camera else None,
        channels=int(card.settings.get("inputs", 1)),
    )


def _oracle(name: str, files: dict[str, Path], device: torch.device) -> Oracle:
    painter = _camera_painter(files, device)
    if painter is None:
        raise InputError(f"{name}: the ground-truth labels have to be painted; add +PAINTER, weights of a vid2vid")
    used = {role: file for role, file in files.items() if role in ("painter", "first-frame painter")}
    return Oracle(info=_info(name, used), painter=painter)


def _camera_painter(files: Mapping[str, Path], device: torch.device) -> CameraPainter | None:
    if "painter" not in files:
        return None
    return CameraPainter.from_files(files["painter"], files.get("first-frame painter"), device)


def _normalise(card: Card) -> Normalisation:
    return validated(Normalisation, card.normalisation, "the card's normalisation")
