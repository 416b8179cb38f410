"""What people wear, by height above the ground: a painter that sees only a silhouette paints it in one colour."""

from __future__ import annotations

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
SKIN, HAIR = (0.4, 0.22, 0.12), (-0.3, -0.32, -0.34)


def clothing(height_m: Tensor, noise: Tensor) -> Tensor:
    """How much brighter than the mean person people are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    height_m  (N,): above the road, metres;  noise: (N,) in [-1, 1], about the same all over a person: the outfit.
    """
    at = (noise + 1) / 2 * (len(TOPS) - 1)
    low = at.long().clamp(0, len(TOPS) - 2)
    share = (at - low)[:, None]
    tops, trousers = (
        torch.lerp(colours[low], colours[low + 1], share)
        for colours in (noise.new_tensor(TOPS), noise.new_tensor(TROUSERS))
    )
    height_m = height_m[:, None]
    head = torch.where(height_m < HAIR_M, noise.new_tensor(SKIN), noise.new_tensor(HAIR))
    return torch.where(height_m < LEGS_M, trousers, torch.where(height_m < HEAD_M, tops, head))
