"""Recipes by name. No torch is imported before a recipe is made.

A new recipe is one file of this folder: its options, its task, and a table RECIPES. It is named here and in `tasks`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

from lidar2pano.errors import InputError, closest
from lidar2pano.train.recipe import Recipe

# Names of recipes by their module; "-mini": minutes on two CPU cores.
MODULES: dict[str, tuple[str, ...]] = {
    "segmentation": (
        "salsanext",
        "salsanext-mini",
        "salsanext-published",
        "release-segmenter",
        "release-segmenter-mini",
        "fast-segmenter",
        "fast-segmenter-mini",
    ),
    "panorama": (
        "titan-pano",
        "titan-pano-mini",
        "release-translator",
        "release-translator-mini",
        "fast-translator",
        "fast-translator-mini",
    ),
    "autoencoding": ("autoencoder", "autoencoder-mini"),
    "latent_painting": ("latent-painter", "latent-painter-mini"),
    "latent_texture": ("latent-texture", "latent-texture-mini"),
    "front": (
        "titan",
        "titan-mini",
        "titan-no-lovasz",
        "titan-no-lovasz-mini",
        "titan-no-range",
        "titan-no-range-mini",
        "titan-next",
        "titan-next-mini",
        "pix2pix-segments",
        "pix2pix-segments-mini",
    ),
    "colour": (
        "titan-no-segments",
        "titan-no-segments-mini",
        "pix2pix-rgb",
        "pix2pix-rgb-mini",
        "scunet",
        "scunet-mini",
    ),
    "camera_segmentation": ("sdnet", "sdnet-mini"),
    "video": ("vid2vid", "vid2vid-mini"),
}


def _maker(module: str, name: str) -> Callable[[], Recipe]:
    def make() -> Recipe:
        return makers(module)[name]()

    return make


def makers(module: str) -> dict[str, Callable[[], Recipe]]:
    """Functions of a module that make its recipes, by the recipes' names."""
    return import_module(f"lidar2pano.train.{module}").RECIPES


RECIPES: dict[str, Callable[[], Recipe]] = {
    name: _maker(module, name) for module, names in MODULES.items() for name in names
}


def recipe_named(name: str) -> Recipe:
    """The recipe of RECIPES; an unknown name raises InputError."""
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}{closest(name, RECIPES)}")
    return replace(RECIPES[name](), name=name)
