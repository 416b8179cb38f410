"""Recipes by name: one function each."""

from __future__ import annotations

from collections.abc import Callable

from lidar2pano.errors import InputError, closest
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.recipes.ablations import (
    titan_no_lovasz,
    titan_no_lovasz_mini,
    titan_no_range,
    titan_no_range_mini,
    titan_no_segments,
    titan_no_segments_mini,
)
from lidar2pano.train.recipes.baselines import (
    pix2pix_rgb,
    pix2pix_rgb_mini,
    pix2pix_segments,
    pix2pix_segments_mini,
    scunet,
    scunet_mini,
)
from lidar2pano.train.recipes.camera import sdnet, sdnet_mini
from lidar2pano.train.recipes.panorama import (
    painter,
    painter_mini,
    scene_painter,
    scene_painter_mini,
    titan_pano,
    titan_pano_mini,
)
from lidar2pano.train.recipes.release import (
    release_colours,
    release_colours_mini,
    release_painter,
    release_painter_mini,
    release_segmenter,
    release_segmenter_mini,
    release_translator,
    release_translator_mini,
)
from lidar2pano.train.recipes.segmenter import salsanext, salsanext_mini
from lidar2pano.train.recipes.titan import titan, titan_mini, titan_next, titan_next_mini
from lidar2pano.train.recipes.video import vid2vid, vid2vid_mini

RECIPES: dict[str, Callable[[], Recipe]] = {
    "salsanext": salsanext,
    "salsanext-mini": salsanext_mini,
    "release-segmenter": release_segmenter,
    "release-segmenter-mini": release_segmenter_mini,
    "release-translator": release_translator,
    "release-translator-mini": release_translator_mini,
    "release-colours": release_colours,
    "release-colours-mini": release_colours_mini,
    "release-painter": release_painter,
    "release-painter-mini": release_painter_mini,
    "titan": titan,
    "titan-mini": titan_mini,
    "titan-no-lovasz": titan_no_lovasz,
    "titan-no-lovasz-mini": titan_no_lovasz_mini,
    "titan-no-segments": titan_no_segments,
    "titan-no-segments-mini": titan_no_segments_mini,
    "titan-no-range": titan_no_range,
    "titan-no-range-mini": titan_no_range_mini,
    "titan-next": titan_next,
    "titan-next-mini": titan_next_mini,
    "titan-pano": titan_pano,
    "titan-pano-mini": titan_pano_mini,
    "painter": painter,
    "painter-mini": painter_mini,
    "scene-painter": scene_painter,
    "scene-painter-mini": scene_painter_mini,
    "pix2pix-segments": pix2pix_segments,
    "pix2pix-segments-mini": pix2pix_segments_mini,
    "pix2pix-rgb": pix2pix_rgb,
    "pix2pix-rgb-mini": pix2pix_rgb_mini,
    "scunet": scunet,
    "scunet-mini": scunet_mini,
    "sdnet": sdnet,
    "sdnet-mini": sdnet_mini,
    "vid2vid": vid2vid,
    "vid2vid-mini": vid2vid_mini,
}


def recipe_named(name: str) -> Recipe:
    """The recipe of RECIPES; an unknown name raises InputError."""
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}{closest(name, RECIPES)}")
    return RECIPES[name]()
