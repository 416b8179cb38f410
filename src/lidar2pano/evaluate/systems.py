"""From names of weights to systems; roles of weight files are those of `models.families.role`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lidar2pano.errors import InputError
from lidar2pano.evaluate.camera_systems import CameraPainter, CameraRenderer, CameraTranslator, Oracle
from lidar2pano.evaluate.interface import System, SystemInfo
from lidar2pano.evaluate.panorama_system import NoPainter, PanoramaSystem
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.hardware import pick_device
from lidar2pano.models import families
from lidar2pano.models.card import Card, load, read_card
from lidar2pano.pipeline import Segmenter, assemble, card_view, load_painter, load_part, load_segmenter
from lidar2pano.views import sensor_view

STEADY = "steady"  # last part of a chain: panoramas are smoothed over time by the sensor's poses
ORACLE = ("oracle", "truth")  # first part of a chain: ground-truth camera labels; "truth" is its former name
ROLES = ("segmenter", "translator", "renderer", "painter", "first-frame painter")
CARD_ENTRIES = ("network", "recipe", "data", "steps", "hours", "commit", "sha256")  # of each network, in results


def system(
    weights: str | Path,
    painter: str | Path | None = None,
    device: str = "auto",
    sensor: str = "",
    engine: str = "torch",
) -> System:
    """A system, ready to predict.

    weights  a family, a run, a folder of weight files or a file; several joined by "+" are one system, in which later
             ones take the places of earlier ones. By the cards: titan-pano (`PanoramaSystem`); titan, titan-next or
             pix2pix for classes (`CameraTranslator`); scunet, or titan or pix2pix for colours (`CameraRenderer`).
             "oracle": `Oracle`, with a painter. Segmenters that are not named, and titan-pano's painter, are the
             default family's. "+steady" behind a titan-pano: temporal smoothing by the sensor's poses.
    painter  the same as "WEIGHTS+PAINTER". Behind a `CameraTranslator` or "oracle" only vid2vid paints.
    device   "auto" (CUDA if there is one), "cpu" or "cuda";  sensor: as for Pipeline.for_sensor, "" for the weights'.
    engine   what computes the networks of a pipeline, as for pipeline.load; others run in torch.
    Raises InputError when something is missing, damaged, or does not belong together.
    """
    parts = families.chained(weights) + ([] if painter is None else [str(painter)])
    name, picked = "+".join(parts), pick_device(device)
    if STEADY in parts[1:]:
        return _steady(name, system("+".join(part for part in parts if part != STEADY), None, device, sensor, engine))
    view = sensor_view(sensor) if sensor else None
    if parts[0] in ORACLE:
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
    translator, card = load_part(files["translator"], device, expect="titan-pano", engine=engine)
    view = card_view(files["translator"], card, "panorama")
    first = files.get("first-frame painter")
    painter = load_painter(files["painter"], first, view, device, engine)[0] if "painter" in files else NoPainter()
    return PanoramaSystem(
        info=_info(name, files),
        pipeline=assemble(segmenter, translator, painter, view, device),
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
