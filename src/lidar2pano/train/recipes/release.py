"""Recipes of the released families (runs/release.sh): our chain on real and simulated frames together.

The street world's towns join with `--set data.train=train,WORLD:all`: they show rare classes and all directions, real
frames how things look. A split named twice counts twice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from lidar2pano.train.recipe import Recipe, on_two_cores
from lidar2pano.train.recipes.panorama import painter, titan_pano
from lidar2pano.train.recipes.segmenter import salsanext

PAINTER = {"filled": True, "sharp": 4.0, "grain": True}


def release_segmenter() -> Recipe:
    """SalsaNext without dropout, which costs more than it gives in short runs, on scans of fewer beams now and then."""
    vary = {"turn_deg": 20.0, "chance": 0.3, "rings": 0.3, "remission": 0.1, "rarity": 0.3, "dropout": False}
    return _release(salsanext(), "segmenter", "segmenter", 2e-3, vary)


def release_segmenter_mini() -> Recipe:
    """`release-segmenter` for two CPU cores."""
    return _mini(release_segmenter, minutes=40.0, batch=2, ema=0.997)


def release_translator() -> Recipe:
    """TITAN-pano, where Lovasz-Softmax weighs half as much again."""
    return _release(titan_pano(), "translator", "translator", 2e-3, {"lovasz": 1.5})


def release_translator_mini() -> Recipe:
    """`release-translator` for two CPU cores."""
    return _mini(release_translator, minutes=30.0, batch=4, ema=0.995)


def release_colours() -> Recipe:
    """The painter's first stage: colours alone, no critic."""
    losses = {"adversarial": 0.0, "features": 0.0, "pixels": 10.0}
    return _release(painter(), "colours", "painter", 2e-3, losses, betas=(0.9, 0.99))


def release_colours_mini() -> Recipe:
    """`release-colours` for two CPU cores."""
    return _mini(release_colours, minutes=12.0, batch=2, ema=0.99)


def release_painter() -> Recipe:
    """The painter's second stage: against its critic, from the first stage's weights.

    Broad colours hold it half as fast as they hold `painter`, which lets it make leaves and gravel of its grain.
    """
    return _release(painter(), "painter", "painter", 6e-4, {"broad": 10.0, "augment": 0.5})


def release_painter_mini() -> Recipe:
    """`release-painter` for two CPU cores."""
    return _mini(release_painter, minutes=50.0, batch=2, ema=0.995)


def _release(
    recipe: Recipe,
    stage: str,
    role: str,
    rate: float,
    options: Mapping[str, Any],
    betas: tuple[float, float] | None = None,
) -> Recipe:
    """`recipe` as release-<stage>: other options, and another rate for the network `role`."""
    network = recipe.networks[role]
    settings = {**network.settings, **PAINTER} if role == "painter" else network.settings
    optimizer = replace(network.optimizer, rate=rate, betas=betas or network.optimizer.betas)
    return replace(
        recipe,
        name=f"release-{stage}",
        networks={**recipe.networks, role: replace(network, settings=settings, optimizer=optimizer)},
        options={**recipe.options, **options},
        training=replace(recipe.training, batch=16, workers=12),
    )


def _mini(full: Callable[[], Recipe], *, minutes: float, batch: int, ema: float) -> Recipe:
    recipe = full()
    training = on_two_cores(recipe.training, minutes=minutes, batch=batch, ema=ema)
    return replace(recipe, name=f"{recipe.name}-mini", training=training)
