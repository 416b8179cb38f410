"""Lines along the rows of a picture, where a surface is even: streaks on a road, slats in a pane."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

LENGTH_PX = 17  # of the row that a pixel is the mean of: texture is gone from it, streaks are longer
STEP_PX = 2  # rows between those that are compared
NEARBY_PX = 9  # rows and columns in which an image may have a line that is painted
EVEN = 0.03  # difference of means in [-1, 1] that texture leaves


def streaks(painted: Tensor, image: Tensor, where: Tensor) -> Tensor:
    """By how much means along rows differ from those STEP_PX above, beyond what they do nearby in an image, and EVEN.

    painted, image  (B, 3, H, W) in [-1, 1], of which the mean over colours is compared.
    where           (B, H, W) in [0, 1]: how much each pixel counts. Returns the mean, 0 where nothing counts.
    """
    made, expected = (_changes(part) for part in (painted, image))
    nearby = max_pool2d(expected, NEARBY_PX, 1, NEARBY_PX // 2)
    excess = (made - nearby - EVEN).clamp(min=0)[:, 0]
    weight = where[:, STEP_PX:]
    return (excess * weight).sum() / weight.sum().clamp(min=1)


def inside(share: Tensor, pixels: int) -> Tensor:
    """(B, H, W) 1 where all pixels up to so many rows and columns beside one have a share of more than a half, else 0.

    share  (B, H, W) in [0, 1]; beyond the edge of the picture nothing is known, and nothing said against.
    """
    outside = (share <= 0.5).to(torch.float32)[:, None]
    return 1 - max_pool2d(outside, 2 * pixels + 1, 1, pixels)[:, 0]


def _changes(image: Tensor) -> Tensor:
    """(B, 1, H - STEP_PX, W): how far the mean along each row is from that of the row STEP_PX above."""
    rows = avg_pool2d(image.mean(1, keepdim=True), (1, LENGTH_PX), 1, (0, LENGTH_PX // 2), count_include_pad=False)
    return (rows[:, :, STEP_PX:] - rows[:, :, :-STEP_PX]).abs()
