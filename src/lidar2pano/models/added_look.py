"""A look that a scene painter learns afterwards, without a change to those that it knows."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.scene_painter import ScenePainter


def with_look(painter: ScenePainter, settings: dict[str, Any], look: str) -> tuple[ScenePainter, dict[str, Any]]:
    """The painter with one look more, which begins as its own look and is its own from now on; and its settings.

    The codes of looks become one number longer: 1 for the new look, 0 for all others. So the weights that this number
    has in the layers tuned by codes, a factor and a shift of every channel, are the new look's alone.
    settings  that the painter was built with. Raises InputError for a look that it has, or a name that none can have.
    """
    if not look or "+" in look or look != look.strip():
        raise InputError(f"options.look={look!r}: a look needs a name, without + and spaces around it")
    if look in painter.looks:
        raise InputError(f"the painter has a look {look!r} already; choose another name")
    code = painter.codes.embedding_dim
    settings = {**settings, "looks": [*painter.looks, look], "look": look, "code": code + 1}
    state = painter.state_dict()
    codes = torch.cat([state["codes.weight"], row_of(painter, painter.codes, painter.look)[None]])
    state["codes.weight"] = torch.cat([codes, torch.eye(len(codes))[:, -1:].to(codes)], 1)
    for name, table in (("class_colours", painter.class_colours), ("glass", painter.glass)):
        if table is not None:
            own = row_of(painter, table, painter.look)
            state[f"{name}.weight"] = torch.cat([state[f"{name}.weight"], own[None]])
    for name in (f"tuned.{number}.weight" for number in range(len(painter.tuned))):
        weight = state[name]
        state[name] = torch.cat([weight[:, :code], torch.zeros_like(weight[:, :1]), weight[:, code:]], 1)
    wider = cast(ScenePainter, build("scene-painter", **settings))
    wider.load_state_dict(state)
    return wider, settings


def row_of(painter: ScenePainter, table: nn.Embedding, look: str) -> Tensor:
    """What a painter's table has for a look, or the mean of several ("A+B"); InputError for an unknown look."""
    weights = table.weight.detach()
    return torch.tensor(painter.look_shares(look)).to(weights) @ weights


def train_last_look(painter: ScenePainter) -> None:
    """Let nothing of a painter of `with_look` be trained but what is the new look's alone."""
    painter.requires_grad_(False)
    column = painter.codes.embedding_dim - 1
    for layer in painter.tuned:
        weight = cast(nn.Linear, layer).weight.requires_grad_()
        own = torch.zeros_like(weight)
        own[:, column] = 1
        weight.register_hook(lambda gradient, own=own: gradient * own.to(gradient))
