"""Augmentation that a critic sees of real and painted pictures alike, so that few real ones last longer.

Zhao et al. 2020 (DiffAugment, arXiv:2006.10738, section 3.3): colours, moves and holes, each differentiable. The draws
are shared by the real and the painted picture of a sample: feature matching compares the two place by place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

BRIGHTER, CONTRAST = 0.5, 0.5  # of colours in [-1, 1]: added, either way; factor 1 +- this
REACH = 1 / 8  # of a picture's rows and columns: how far it moves at most
HOLE = 1 / 2  # of its rows and columns: what a hole covers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Changes:
    """What happens to each of B pictures; a row of numbers each, (B,).

    brighter  added to colours;  saturation, contrast: factors about the pixel's mean and the seen picture's.
    down, right  moves in shares of the picture, in [-1/8, 1/8]; what comes in is zero.
    hole_down, hole_right  middle of the hole in shares of the picture; NaN for no hole.
    """

    brighter: Tensor
    saturation: Tensor
    contrast: Tensor
    down: Tensor
    right: Tensor
    hole_down: Tensor
    hole_right: Tensor

    @classmethod
    def drawn(cls, pictures: int, chance: float) -> Self:
        """Draw, each of the three kinds (colours, move, hole) with probability `chance` per picture."""

        def happens() -> Tensor:
            return torch.rand(pictures) < chance

        def either_way(happens: Tensor, reach: float) -> Tensor:
            return (torch.rand(pictures) * 2 - 1) * reach * happens

        coloured, moved, holed = happens(), happens(), happens()
        nowhere = torch.full((pictures,), torch.nan)
        return cls(
            brighter=either_way(coloured, BRIGHTER),
            saturation=1 + either_way(coloured, 1.0),
            contrast=1 + either_way(coloured, CONTRAST),
            down=either_way(moved, REACH),
            right=either_way(moved, REACH),
            hole_down=torch.where(holed, torch.rand(pictures), nowhere),
            hole_right=torch.where(holed, torch.rand(pictures), nowhere),
        )

    def of(self, colours: Tensor, seen: Tensor, told: Tensor) -> Tensor:
        """What a critic is shown: (B, 3 + C, H, W).

        colours  (B, 3, H, W) in [-1, 1];  seen: (B, 1, H, W) 0 or 1, where colours count: zero elsewhere.
        told     (B, C, H, W), what the colours were painted from: it moves with them and has the same holes.
        """
        shown = torch.cat([self._coloured(colours, seen) * seen, told], 1)
        return torch.stack([self._moved(one, number) for number, one in enumerate(shown)]) * self._kept(shown)

    def _coloured(self, colours: Tensor, seen: Tensor) -> Tensor:
        brighter, saturation, contrast = (
            factor.to(colours)[:, None, None, None] for factor in (self.brighter, self.saturation, self.contrast)
        )
        colours = colours + brighter
        grey = colours.mean(1, keepdim=True)
        colours = grey + (colours - grey) * saturation
        mean = (grey * seen).sum((1, 2, 3), keepdim=True) / seen.sum((1, 2, 3), keepdim=True).clamp(min=1)
        return mean + (colours - mean) * contrast

    def _moved(self, picture: Tensor, number: int) -> Tensor:
        """One picture (C, H, W)."""
        rows, columns = picture.shape[-2:]
        down, right = round(float(self.down[number]) * rows), round(float(self.right[number]) * columns)
        return pad(picture, (right, -right, down, -down))

    def _kept(self, shown: Tensor) -> Tensor:
        """(B, 1, H, W), 0 in holes."""
        inside = [
            (torch.linspace(0, 1, pixels)[None] - middle[:, None]).abs() <= HOLE / 2  # NaN is never inside
            for pixels, middle in ((shown.shape[2], self.hole_down), (shown.shape[3], self.hole_right))
        ]
        return (~(inside[0][:, None, :, None] & inside[1][:, None, None, :])).to(shown)
