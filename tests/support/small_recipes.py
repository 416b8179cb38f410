"""Recipes of baselines and ablations small enough for tests; also a program: small_recipes.py NAME ROOT OUT DEVICES.

As a program it trains one step without chance, so that two processes can be compared with one.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor

from lidar2pano.train.colour import CameraColourOptions
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.views import VIEWS

SIZE = (24, 80)  # rows, columns of the pictures
FRONT = replace(VIEWS["titan-front"], rows=32, columns=128)  # the view that small recipes have
VIEW = {"titan-front-small": FRONT}
PLAIN = [
    "view=titan-front-small",
    "training.steps=1",
    "training.batch=2",
    "training.workers=0",
    "training.precision=32-true",
]
_UNET = {"width": 4, "size": SIZE, "depth": 3}
_TITAN = {"size": (68, 100)}
SMALL: dict[str, dict[str, dict[str, object]]] = {
    "pix2pix-segments-mini": {"translator": _UNET, "critic": {"width": 4}},
    "pix2pix-rgb-mini": {"renderer": _UNET, "critic": {"width": 4}},
    "scunet-mini": {"renderer": {"widths": (4, 8, 8)}},
    "titan-mini": {"translator": _TITAN, "critic": {"width": 4}},
    "titan-no-lovasz-mini": {"translator": _TITAN, "critic": {"width": 4}},
    "titan-no-range-mini": {"translator": _TITAN, "critic": {"width": 4}},
    "titan-no-segments-mini": {"renderer": _TITAN, "critic": {"width": 4}},
    "titan-next-mini": {"translator": {**_TITAN, "width": 4}, "critic": {"width": 4}},
}


def small(name: str, *further: str) -> Recipe:
    """A recipe with networks and a view small enough for a test; one step of two samples. VIEW must be in VIEWS."""
    recipe = recipe_named(name)
    networks = {
        role: replace(network, settings={**network.settings, **SMALL[name][role]})
        for role, network in recipe.networks.items()
    }
    recipe = replace(recipe, networks=networks)
    if isinstance(recipe.options, CameraColourOptions):
        recipe = replace(recipe, options=replace(recipe.options, size=SIZE))
    for assignment in [*PLAIN, *further]:
        recipe = override(recipe, assignment)
    return recipe


def alike(name: str, *further: str) -> Recipe:
    """A small recipe whose networks treat every sample by itself, so that it does not matter who sees which."""
    recipe = small(name, *further)
    networks = dict(recipe.networks)
    for role, network in networks.items():
        if network.model.startswith("pix2pix"):
            settings = {name: value for name, value in network.settings.items() if name != "batch_statistics"}
            networks[role] = replace(network, settings={**settings, "norm": "instance"})
    return replace(recipe, networks=networks)


@contextmanager
def without_chance() -> Iterator[None]:
    """Inside, nothing is dropped out and gradient penalties look half-way."""
    from lidar2pano.losses.adversarial import gradient_penalty

    def kept(x: Tensor, *_: object, **__: object) -> Tensor:
        return x

    with (
        mock.patch.object(torch.nn.functional, "dropout", kept),
        mock.patch.object(torch.nn.functional, "dropout2d", kept),
        mock.patch("lidar2pano.losses.adversarial.gradient_penalty", functools.partial(_half_way, gradient_penalty)),
    ):
        yield


def _half_way(
    penalty: Callable[..., Tensor], critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, **_: object
) -> Tensor:
    return penalty(critic, real, fake, epsilon=0.5)


if __name__ == "__main__":
    from lidar2pano.train.engine import train

    name, root, out, devices = sys.argv[1:]
    VIEWS.update(VIEW)
    with without_chance():
        train(alike(name), Path(root), Path(out), device="cpu", devices=int(devices))
