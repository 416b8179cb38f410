"""Recipes of the paper's ablations (section 4.5 and the supplement): TITAN-Net without one of its parts.

Rows of its tables: "TITAN-Net (w/o L_ls)" is titan-no-lovasz, "TITAN-Net - w/o SegMap" is titan-no-segments,
"TITAN-Net - w/o Rangeview -> Vid2Vid" is titan-no-range. All else is as in `titan` and `titan-mini`.
"""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Recipe
from lidar2pano.train.recipes.titan import GUIDE, titan, titan_mini


def titan_no_lovasz() -> Recipe:
    """TITAN-Net against its critic alone."""
    return _without_lovasz(titan())


def titan_no_lovasz_mini() -> Recipe:
    """`titan-mini` against its critic alone."""
    return _without_lovasz(titan_mini())


def titan_no_range() -> Recipe:
    """TITAN-Net that sees the segments only."""
    return _without_range(titan())


def titan_no_range_mini() -> Recipe:
    """`titan-mini` that sees the segments only."""
    return _without_range(titan_mini())


def titan_no_segments() -> Recipe:
    """TITAN-Net from the range view straight to colours, with the squared error as its guide."""
    return _without_segments(titan())


def titan_no_segments_mini() -> Recipe:
    """`titan-mini` from the range view straight to colours; the squared error teaches ten times less than Lovasz."""
    recipe = _without_segments(titan_mini())
    return replace(recipe, options={**recipe.options, "mse": 10 * GUIDE})


def _named(recipe: Recipe, less: str) -> str:
    """titan, titan-mini -> titan-no-<less>, titan-no-<less>-mini."""
    return recipe.name.replace("titan", f"titan-no-{less}", 1)


def _without_lovasz(recipe: Recipe) -> Recipe:
    return replace(recipe, name=_named(recipe, "lovasz"), options={**recipe.options, "lovasz": 0.0})


def _without_range(recipe: Recipe) -> Recipe:
    translator = recipe.networks["translator"]
    blind = replace(translator, settings={**translator.settings, "channels": 0})
    return replace(recipe, name=_named(recipe, "range"), networks={**recipe.networks, "translator": blind})


def _without_segments(recipe: Recipe) -> Recipe:
    """The critic is conditioned on the range view, since there are no segments to condition it on."""
    translator, critic = recipe.networks["translator"], recipe.networks["critic"]
    colours = {**translator.settings, "classes": 3, "conditions": 0, "picture": True}
    judging = {**critic.settings, "image_channels": 3, "conditions": 5}
    return replace(
        recipe,
        name=_named(recipe, "segments"),
        task="direct",
        networks={
            "renderer": replace(translator, settings=colours),
            "critic": replace(critic, settings=judging),
        },
        options={"evidence": "front", "mse": 1.0, "penalty": recipe.options["penalty"]},
    )
