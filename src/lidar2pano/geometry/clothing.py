"""Colours of what a scan shows as a silhouette only: people's clothes by height above the ground, and traffic signs.

A painter that is not given them paints each such thing in its mean colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

LEGS_M, HEAD_M, HAIR_M = 0.85, 1.45, 1.66  # where legs, trunk and face end
# Red, green and blue in [-1, 1], less those of the mean person; outfits beside each other are blended.
TOPS = (
    (-0.25, -0.25, -0.2),
    (0.1, -0.15, -0.15),
    (0.5, 0.5, 0.48),
    (0.05, 0.1, 0.3),
    (0.2, 0.2, 0.2),
    (-0.1, 0.0, -0.12),
)
TROUSERS = (
    (-0.15, -0.08, 0.1),
    (-0.3, -0.3, -0.3),
    (-0.12, -0.06, 0.12),
    (0.08, 0.03, -0.06),
    (-0.3, -0.3, -0.28),
    (-0.15, -0.08, 0.08),
)
# Likewise, less the mean sign: the back, which is grey, yellow, white, blue, and grey again. (Red ones were lollipops.)
SIGNS = ((0.1, 0.1, 0.05), (0.6, 0.45, -0.2), (0.6, 0.6, 0.55), (-0.25, -0.05, 0.4), (0.1, 0.1, 0.05))
SKIN, HAIR = (0.4, 0.22, 0.12), (-0.3, -0.32, -0.34)


def clothing(height_m: Tensor, noise: Tensor) -> Tensor:
    """How much brighter than the mean person people are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    height_m  (N,): above the road, metres;  noise: (N,) in [-1, 1], about the same all over a person: the outfit.
    """
    tops, trousers = (_blended(colours, noise) for colours in (TOPS, TROUSERS))
    height_m = height_m[:, None]
    head = torch.where(height_m < HAIR_M, noise.new_tensor(SKIN), noise.new_tensor(HAIR))
    return torch.where(height_m < LEGS_M, trousers, torch.where(height_m < HEAD_M, tops, head))


def sign_colours(noise: Tensor) -> Tensor:
    """How much brighter than the mean sign signs are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    noise  (N,) in [-1, 1], about the same all over a sign.
    """
    return _blended(SIGNS, noise)


def _blended(colours: Sequence[tuple[float, ...]], noise: Tensor) -> Tensor:
    """Of colours from -1 to 1 at even distances those at N places, (N, 3): each is the mean of the two beside it."""
    at = (noise + 1) / 2 * (len(colours) - 1)
    low = at.long().clamp(0, len(colours) - 2)
    table = noise.new_tensor(colours)
    return torch.lerp(table[low], table[low + 1], (at - low)[:, None])
