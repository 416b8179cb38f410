"""Recipes by name. No torch is imported here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lidar2pano.errors import InputError, closest
from lidar2pano.train.recipe import Recipe, on_two_cores
from lidar2pano.train.recipes import chain, published, titan

# "-mini": minutes on two CPU cores
RECIPES: dict[str, Callable[[], Recipe]] = {
    "salsanext": chain.salsanext,
    "salsanext-mini": chain.salsanext_mini,
    "salsanext-published": published.salsanext,
    "titan-pano": chain.titan_pano,
    "titan-pano-mini": lambda: on_two_cores(chain.titan_pano(), minutes=24, batch=4),
    "scene-painter": chain.scene_painter,
    "scene-painter-mini": lambda: on_two_cores(chain.scene_painter(), minutes=40, batch=2, ema=0.99),
    "release-segmenter": chain.release_segmenter,
    "release-segmenter-mini": lambda: on_two_cores(chain.release_segmenter(), minutes=40, batch=2, ema=0.997),
    "release-translator": chain.release_translator,
    "release-translator-mini": lambda: on_two_cores(chain.release_translator(), minutes=30, batch=4, ema=0.995),
    "fast-segmenter": chain.fast_segmenter,
    "fast-segmenter-mini": lambda: on_two_cores(chain.fast_segmenter(), minutes=26, batch=2, ema=0.99),
    "fast-translator": chain.fast_translator,
    "fast-translator-mini": lambda: on_two_cores(chain.fast_translator(), minutes=26, batch=4, ema=0.99),
    "fast-painter": chain.fast_painter,
    "fast-painter-mini": lambda: on_two_cores(chain.fast_painter(), minutes=30, batch=1, ema=0.99),
    "titan": titan.titan,
    "titan-mini": titan.titan_mini,
    "titan-no-lovasz": lambda: titan.without_lovasz(titan.titan()),
    "titan-no-lovasz-mini": lambda: titan.without_lovasz(titan.titan_mini()),
    "titan-no-segments": lambda: titan.without_segments(titan.titan()),
    "titan-no-segments-mini": lambda: titan.without_segments(titan.titan_mini(), mse=10 * titan.AUXILIARY),
    "titan-no-range": lambda: titan.without_range(titan.titan()),
    "titan-no-range-mini": lambda: titan.without_range(titan.titan_mini()),
    "titan-next": titan.titan_next,
    "titan-next-mini": titan.titan_next_mini,
    "pix2pix-segments": titan.papers_protocol(published.pix2pix_segments),
    "pix2pix-segments-mini": lambda: published.pix2pix_mini(published.pix2pix_segments()),
    "pix2pix-rgb": titan.papers_protocol(published.pix2pix_rgb),
    "pix2pix-rgb-mini": lambda: published.pix2pix_mini(published.pix2pix_rgb()),
    "scunet": titan.papers_protocol(published.scunet),
    "scunet-mini": published.scunet_mini,
    "sdnet": published.sdnet,
    "sdnet-mini": published.sdnet_mini,
    "vid2vid": published.vid2vid,
    "vid2vid-mini": published.vid2vid_mini,
}


def recipe_named(name: str) -> Recipe:
    """The recipe of RECIPES; an unknown name raises InputError."""
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}{closest(name, RECIPES)}")
    return replace(RECIPES[name](), name=name)
