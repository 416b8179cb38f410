"""From names to systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lidar2pano.errors import InputError
from lidar2pano.evaluate.around import Around, Blank
from lidar2pano.evaluate.films import CameraPainter
from lidar2pano.evaluate.front import Ceiling, Direct, Front
from lidar2pano.evaluate.questions import Origin, System
from lidar2pano.evaluate.weights import FRONT, ROLES, STEADY, TRUTH, default_files, links, named_files
from lidar2pano.geometry.images import Normalisation
from lidar2pano.hardware import pick_device
from lidar2pano.models.card import Card, load, read_card
from lidar2pano.pipeline import Pipeline, Segmenter, card_view, load_painter, load_part, load_segmenter
from lidar2pano.views import sensor_view

TOLD = ("network", "recipe", "data", "steps", "hours", "commit", "sha256")  # of a card, in results


def system(weights: str | Path, painter: str | Path | None = None, device: str = "auto", sensor: str = "") -> System:
    """A system, ready to be asked.

    weights  a family, a run, a folder of weight files or a file; several joined by "+" are one system, in which later
             ones take the places of earlier ones. By the cards: titan-pano (`Around`); titan, titan-next or pix2pix for
             classes (`Front`); scunet, or titan or pix2pix for colours (`Direct`). "truth": `Ceiling`, with a painter.
             Segmenters that are not named, and titan-pano's painter, are the default family's. "+steady" behind a
             titan-pano: its pictures are steadied by the sensor's poses (memory.steadied).
    painter  the same as "WEIGHTS+PAINTER". Behind a `Front` or the truth only vid2vid paints.
    device   "auto" (CUDA if there is one), "cpu" or "cuda";  sensor: as for Pipeline.for_sensor, "" for the weights'.
    Raises InputError when something is missing, damaged, or does not belong together.
    """
    parts = links(weights) + ([] if painter is None else [str(painter)])
    name, picked = "+".join(parts), pick_device(device)
    if STEADY in parts[1:]:
        return _steady(name, system("+".join(part for part in parts if part != STEADY), None, device, sensor))
    view = sensor_view(sensor) if sensor else None
    if parts[0] == TRUTH:
        return _ceiling(name, _merged(parts[1:]), picked)
    mine = _merged(parts)
    if "renderer" in mine:
        return _direct(name, mine, picked)
    files = default_files() | mine
    if missing := [role for role in ("segmenter", "translator") if role not in files]:
        raise InputError(f"{name}: no weights for the {' and the '.join(missing)}; name a family that has them")
    segmenter = load_segmenter(files["segmenter"], picked)
    if view is not None:
        segmenter = replace(segmenter, view=view)
    if read_card(files["translator"]).network in FRONT:
        used = {role: files[role] for role in ("segmenter", "translator")}
        used |= {role: mine[role] for role in ("painter", "first-frame painter") if role in mine}
        return _front(name, used, segmenter, picked)
    return _around(name, _own_painter(files, mine), segmenter, picked)


def _steady(name: str, plain: System) -> System:
    if not isinstance(plain, Around) or not plain.paints:
        raise InputError(f"{name}: only panoramas that are painted can be steadied; leave +{STEADY} out")
    return replace(plain, origin=replace(plain.origin, name=name), steady=True)


def _merged(parts: list[str]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for part in parts:
        files |= named_files(part)
    return files


def _own_painter(files: dict[str, Path], mine: dict[str, Path]) -> dict[str, Path]:
    """The files, less the default family's first-frame painter where a painter was named without one."""
    if "painter" in mine and "first-frame painter" not in mine:
        return {role: file for role, file in files.items() if role != "first-frame painter"}
    return files


def _origin(name: str, files: Mapping[str, Path]) -> Origin:
    files = {role: files[role] for role in ROLES if role in files}
    cards = {role: read_card(file) for role, file in files.items()}
    networks = {role: {name: getattr(card, name) for name in TOLD} for role, card in cards.items()}
    return Origin(name=name, files=files, networks=networks)


def _around(name: str, files: dict[str, Path], segmenter: Segmenter, device: torch.device) -> Around:
    translator, card = load_part(files["translator"], device, expect="titan-pano")
    view = card_view(files["translator"], card, "panorama")
    first = files.get("first-frame painter")
    painter = load_painter(files["painter"], first, view, device) if "painter" in files else Blank()
    return Around(
        origin=_origin(name, files),
        pipeline=Pipeline(segmenter=segmenter, translator=translator, painter=painter, view=view, device=device),
        paints="painter" in files,
    )


def _front(name: str, files: dict[str, Path], segmenter: Segmenter, device: torch.device) -> Front:
    translator, card = load(files["translator"], device)
    return Front(
        origin=_origin(name, files),
        segmenter=segmenter,
        translator=translator,
        view=card_view(files["translator"], card, "input"),
        normalise=_normalise(card),
        device=device,
        painter=_camera_painter(files, device),
    )


def _direct(name: str, files: dict[str, Path], device: torch.device) -> Direct:
    if others := sorted(files.keys() - {"renderer"}):
        raise InputError(f"{name}: a renderer makes colours by itself, so the {others[0]} has no place; leave it out")
    renderer, card = load(files["renderer"], device)
    seen: dict[str, Any] = card.views.get("camera", {})
    return Direct(
        origin=_origin(name, files),
        renderer=renderer,
        view=card_view(files["renderer"], card, "input") if card.network != "scunet" else None,
        normalise=_normalise(card),
        device=device,
        size=(int(seen["rows"]), int(seen["columns"])) if seen else None,
        inputs=int(card.settings.get("inputs", 1)),
    )


def _ceiling(name: str, files: dict[str, Path], device: torch.device) -> Ceiling:
    painter = _camera_painter(files, device)
    if painter is None:
        raise InputError(f"{name}: the true classes have to be painted; add +PAINTER, weights of a vid2vid")
    used = {role: file for role, file in files.items() if role in ("painter", "first-frame painter")}
    return Ceiling(origin=_origin(name, used), painter=painter)


def _camera_painter(files: Mapping[str, Path], device: torch.device) -> CameraPainter | None:
    if "painter" not in files:
        return None
    return CameraPainter.from_files(files["painter"], files.get("first-frame painter"), device)


def _normalise(card: Card) -> Normalisation:
    return Normalisation(**{name: tuple(values) for name, values in card.normalisation.items()})
