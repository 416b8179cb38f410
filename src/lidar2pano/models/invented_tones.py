"""How much brighter than the mean of their classes things are, where nothing says so: no scan shows their colours.

Trees in the sun, houses of several paints, people's clothes, signs. All of it hangs on the world.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.geometry.clothing import clothing, sign_colours
from lidar2pano.labels import COMMON15

NAMES = ("building", "person", "traffic-sign", "vegetation")
BUILDING, PERSON, SIGN, VEGETATION = map(COMMON15.id_of, NAMES)
# Half of the deviations from image to image of how bright a class is in KITTI, colours in [-1, 1]: all of them, and
# what noise has beyond its deviation, burn things out.
VARIED = dict.fromkeys(("car", "truck", "other-vehicle", "fence"), 0.15) | {"pole": 0.1}
# How much brighter than the mean trees are in the sun of a painter that has one: up to LIT_M, and none at twice that,
# for there painters paint them darker than photographs are; those that it shines on as one sees them, which are on the
# world's left, and by as much less those before it. With or without it some are, by noise, at most.
LIT, LIT_M, SUNNY_SIDE, SUNLIT = 0.22, 15.0, 0.15, 0.2
LEAVES = (1.0, 1.03, 0.78)  # of red, green and blue in a brighter tree of KITTI's images
LIKELY = 0.05  # probability of people and of signs from which on they are given colours
HOUSES_VARIED = 0.5  # how much brighter or darker than the mean a house is, at most


def invented_tones(
    segments: Tensor,
    height_m: Tensor,
    radius_m: Tensor,
    noise: Tensor,
    house: Tensor,
    openings: Tensor,
    left: Tensor | None = None,
) -> Tensor:
    """How much brighter than the mean of its class each pixel is, in red, green and blue in [-1, 1]: (B, 3, H, W).

    segments   (B, classes, H, W): probabilities;  height_m, radius_m: (B, H, W) above the road, and from the axis.
    noise      (B, H, W) in [-1, 1], about the same all over a thing.
    house, openings  of `facades`;  left: (W,) of unit vectors to what columns show, how far to the world's left; None:
               there is no sun.
    """
    varied = segments.new_tensor([VARIED.get(name, 0.0) for name in COMMON15.classes], dtype=torch.float32)
    brighter = torch.einsum("bchw,c->bhw", segments.float(), varied) * noise
    trees = segments[:, VEGETATION].float() * _sunlight(noise, radius_m, left)
    tones = brighter[:, None] + trees[:, None] * noise.new_tensor(LEAVES)[:, None, None]
    tones = tones + segments[:, BUILDING, None] * _house_tones(house, openings)
    _add_colours(tones, segments, height_m, noise)
    return tones


def _add_colours(tones: Tensor, segments: Tensor, height_m: Tensor, noise: Tensor) -> None:
    """Add to tones (B, 3, H, W) those of people and signs, which are few pixels."""
    people, signs = ((segments[:, each] > LIKELY).nonzero(as_tuple=True) for each in (PERSON, SIGN))
    dressed, lettered = clothing(height_m[people], noise[people]), sign_colours(noise[signs])
    for each, at, colours in ((PERSON, people, dressed), (SIGN, signs, lettered)):
        tones.movedim(1, 3)[at] += segments[:, each][at].float()[:, None] * colours


def _sunlight(noise: Tensor, radius_m: Tensor, left: Tensor | None) -> Tensor:
    """How much brighter than the mean trees are (B, H, W), by noise (B, H, W) and where they stand: see LIT."""
    bright = noise.clamp(min=0).mul_(SUNLIT)
    if left is not None:
        bright.add_((2 - radius_m / LIT_M).clamp_(0, 1), alpha=LIT).add_(SUNNY_SIDE * left)
    return bright


def _house_tones(house: Tensor, openings: Tensor) -> Tensor:
    """How much brighter than the mean (B, 3, H, W) houses are, of `facades`: the windows of bright ones are not.

    (Panes as bright as the plaster around them were hardly seen.)
    """
    tones = (HOUSES_VARIED * house)[:, :, None]
    return tones - openings[:, None] * tones.clamp(min=0)
