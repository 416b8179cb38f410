"""DiffAugment: the same random changes of real and generated images before the discriminator, for small data sets.

Zhao et al. 2020 (arXiv:2006.10738, section 3.3): colour, translation and cutout, each differentiable. A real and a
generated image of one sample share their parameters, since feature matching compares them pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

BRIGHTNESS, CONTRAST = 0.5, 0.5  # of colours in [-1, 1]: largest offset, either way; factor 1 +- this
TRANSLATION = 1 / 8  # largest, as a share of an image's rows and columns
CUTOUT = 1 / 2  # share of its rows and columns that is set to zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiffAugment:
    """Parameters of the augmentation of B images, (B,) each.

    brightness            added to colours;  saturation, contrast: factors about the pixel's mean and the image's.
    down, right           translation as a share of the image, in [-1/8, 1/8]; what comes in is zero.
    cut_row, cut_column   middle of the cutout as a share of the image; NaN for none.
    """

    brightness: Tensor
    saturation: Tensor
    contrast: Tensor
    down: Tensor
    right: Tensor
    cut_row: Tensor
    cut_column: Tensor

    @classmethod
    def drawn(cls, images: int, probability: float) -> Self:
        """Draw; each of the three kinds (colour, translation, cutout) applies with `probability` per image."""

        def applies() -> Tensor:
            return torch.rand(images) < probability

        def symmetric(applies: Tensor, largest: float) -> Tensor:
            return (torch.rand(images) * 2 - 1) * largest * applies

        colour, translation, cutout = applies(), applies(), applies()
        none = torch.full((images,), torch.nan)
        return cls(
            brightness=symmetric(colour, BRIGHTNESS),
            saturation=1 + symmetric(colour, 1.0),
            contrast=1 + symmetric(colour, CONTRAST),
            down=symmetric(translation, TRANSLATION),
            right=symmetric(translation, TRANSLATION),
            cut_row=torch.where(cutout, torch.rand(images), none),
            cut_column=torch.where(cutout, torch.rand(images), none),
        )

    def apply(self, colour: Tensor, valid: Tensor, condition: Tensor) -> Tensor:
        """The discriminator's input (B, 3 + C, H, W): augmented colours and their condition.

        colour     (B, 3, H, W) in [-1, 1];  valid: (B, 1, H, W) 0 or 1; invalid colours become zero.
        condition  (B, C, H, W), what the colours were painted from: translated and cut out alike.
        """
        joined = torch.cat([self._recoloured(colour, valid) * valid, condition], 1)
        return torch.stack([self._translated(one, number) for number, one in enumerate(joined)]) * self._kept(joined)

    def _recoloured(self, colour: Tensor, valid: Tensor) -> Tensor:
        brightness, saturation, contrast = (
            factor.to(colour)[:, None, None, None] for factor in (self.brightness, self.saturation, self.contrast)
        )
        colour = colour + brightness
        grey = colour.mean(1, keepdim=True)
        colour = grey + (colour - grey) * saturation
        mean = (grey * valid).sum((1, 2, 3), keepdim=True) / valid.sum((1, 2, 3), keepdim=True).clamp(min=1)
        return mean + (colour - mean) * contrast

    def _translated(self, image: Tensor, number: int) -> Tensor:
        """One image (C, H, W)."""
        rows, columns = image.shape[-2:]
        down, right = round(float(self.down[number]) * rows), round(float(self.right[number]) * columns)
        return pad(image, (right, -right, down, -down))

    def _kept(self, images: Tensor) -> Tensor:
        """(B, 1, H, W), 0 in cutouts."""
        inside = [
            (torch.linspace(0, 1, pixels)[None] - middle[:, None]).abs() <= CUTOUT / 2  # NaN is never inside
            for pixels, middle in ((images.shape[2], self.cut_row), (images.shape[3], self.cut_column))
        ]
        return (~(inside[0][:, None, :, None] & inside[1][:, None, None, :])).to(images)
