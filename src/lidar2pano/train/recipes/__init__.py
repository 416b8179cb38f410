"""Recipes by name: one function each."""

from __future__ import annotations

from collections.abc import Callable

from lidar2pano.errors import InputError, closest
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.recipes.panorama import painter, painter_mini, titan_pano, titan_pano_mini
from lidar2pano.train.recipes.segmenter import salsanext, salsanext_mini
from lidar2pano.train.recipes.titan import titan, titan_mini

RECIPES: dict[str, Callable[[], Recipe]] = {
    "salsanext": salsanext,
    "salsanext-mini": salsanext_mini,
    "titan": titan,
    "titan-mini": titan_mini,
    "titan-pano": titan_pano,
    "titan-pano-mini": titan_pano_mini,
    "painter": painter,
    "painter-mini": painter_mini,
}


def recipe_named(name: str) -> Recipe:
    """The recipe of RECIPES; an unknown name raises InputError."""
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}{closest(name, RECIPES)}")
    return RECIPES[name]()
