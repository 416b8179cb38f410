"""Recipes by name. No torch is imported before a recipe is made.

A new recipe is one file of this folder: its options, its task, and a table RECIPES. It is named here and in `tasks`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module

from lidar2pano.errors import InputError, closest
from lidar2pano.train.recipe import Recipe

# Names of recipes by their module; of all but NO_MINI there is a form "-mini", minutes on two CPU cores.
FULL: dict[str, tuple[str, ...]] = {
    "segmentation": ("salsanext", "salsanext-published", "release-segmenter", "fast-segmenter"),
    "panorama": ("titan-pano", "release-translator", "fast-translator"),
    "autoencoding": ("autoencoder",),
    "latent_painting": ("latent-painter",),
    "latent_texture": ("latent-texture",),
    "encoding": ("latent-encoder",),
    "front": ("titan", "titan-no-lovasz", "titan-no-range", "titan-next", "pix2pix-segments"),
    "colour": ("titan-no-segments", "pix2pix-rgb", "scunet"),
    "camera_segmentation": ("sdnet",),
    "video": ("vid2vid",),
}
NO_MINI = "salsanext-published"
MODULES: dict[str, tuple[str, ...]] = {
    module: tuple(form for name in names for form in (name, f"{name}-mini")[: 1 + (name != NO_MINI)])
    for module, names in FULL.items()
}


def makers(module: str) -> dict[str, Callable[[], Recipe]]:
    """Functions of a module that make its recipes, by the recipes' names."""
    return import_module(f"lidar2pano.train.{module}").RECIPES


def _make(module: str, name: str) -> Recipe:
    return makers(module)[name]()


RECIPES: dict[str, Callable[[], Recipe]] = {
    name: partial(_make, module, name) for module, names in MODULES.items() for name in names
}


def recipe_named(name: str) -> Recipe:
    """The recipe of RECIPES; an unknown name raises InputError."""
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}{closest(name, RECIPES)}")
    return replace(RECIPES[name](), name=name)
