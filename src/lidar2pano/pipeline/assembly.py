"""The networks of a pipeline from weight files, in the form that is fastest to run."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn

from lidar2pano.engines import accelerated, pick_engine
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.hardware import pick_device
from lidar2pano.models.blocks import fold_norms
from lidar2pano.models.card import Card, read_card
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.families import FRONT_VIEW, role
from lidar2pano.models.latent_painter import LatentPainter
from lidar2pano.models.stream_painter import StreamPainter
from lidar2pano.models.titan_pano import PANORAMA, STRIDE, FrontAllAround
from lidar2pano.models.vid2vid import Vid2Vid
from lidar2pano.models.vid2vid_painter import Vid2VidPainter
from lidar2pano.pipeline.segmenter import Segmenter
from lidar2pano.views import View

log = logging.getLogger("lidar2pano")


def load_parts(files: Mapping[str, Path], device: str | torch.device, engine: str, source: object) -> dict[str, Any]:
    """The fields of a Pipeline from weight files by role (`models.families.weight_files`).

    device, engine  as of `load`;  source: the name that a user gave.
    Raises InputError when a part is missing, and as `load`.
    """
    picked = pick_device(device)
    runs_on = pick_engine(engine, picked)
    log.info("networks run on %s by %s", picked.type, runs_on)
    if "renderer" in files:
        raise InputError(f"{files['renderer']}: paints without classes, which `evaluate` can do only; name a family")
    if missing := [part for part in ("segmenter", "translator", "painter") if part not in files]:
        raise InputError(f"{source}: no weights for the {' and the '.join(missing)}; name a family that has them")
    segmenter, segmenter_card = load_segmenter(files["segmenter"], picked, engine)
    translator, card, view = load_translator(files["translator"], picked, engine)
    painter, painter_card = load_painter(files["painter"], files.get("first-frame painter"), view, picked, engine)
    cards = {"segmenter": segmenter_card, "translator": card, "painter": painter_card}
    networks = {"segmenter": segmenter, "translator": translator, "painter": painter}
    return {**networks, "view": view, "device": picked, "cards": cards, "engine": runs_on, "files": files}


def load_translator(file: Path, device: torch.device, engine: str = "torch") -> tuple[nn.Module, Card, View]:
    """The translator of a weight file, ready for inference, its card, and the raster that it predicts.

    The panorama's rows are enough by default: the raster of one that learned more is not taller.
    One of the paper's kind (FRONT_VIEW) runs all around, in torch. InputError where the file holds something else.
    """
    if read_card(file).network not in FRONT_VIEW:
        translator, card = load_part(file, device, expect="titan-pano", engine=engine)
        learned = card_view(file, card, "panorama")
        up, down = min(learned.up, PANORAMA.up), max(learned.down, PANORAMA.down)
        return translator, card, learned.between(up, down, STRIDE)
    network, card = load_weights(file, device)
    normalise = validated(Normalisation, card.normalisation, f"{file}: the card's normalisation")
    panoramic = FrontAllAround(network, card_view(file, card, "input"), normalise)
    return panoramic, card, panoramic.view


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
    network = made_fast(network)
    for model, part in engine_parts(network, card.network).items():
        accelerated(part, model, card.sha256, engine, device)
    return network, card


def engine_parts(network: nn.Module, model: str) -> dict[str, nn.Module]:
    """Return what engines compute of a network (its name in models.MODELS): itself, or its parts, by their names."""
    return network.parts() if isinstance(network, LatentPainter) else {model: network}


def made_fast(network: nn.Module) -> nn.Module:
    """The network, changed in place to the form that is fastest to run: norms folded, channels last."""
    return fold_norms(network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def card_view(file: Path, card: Card, role: str) -> View:
    """The raster that a card gives for `role`; InputError where it gives none that makes sense."""
    mend = "fetch it or make it again"
    if role not in card.views:
        raise InputError(f"{file}: its card has no view {role!r} that makes sense; {mend}")
    return validated(View, card.views[role], f"{file}: its card has no view {role!r} that makes sense", mend)
