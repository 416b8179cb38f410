"""Autoencoder of street pictures: RGB at eight times the raster of its latents, and back.

Plain residual convolutions, circular in azimuth; nothing is normalised over the raster, so that a sector has the
latents that it has within a panorama. Features are enlarged by repetition: pixel shuffles leave a weave of lines two
and four pixels apart (Odena et al. 2016).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from lidar2pano.models.blocks import CircularConv, check_size

FACTOR = 8  # pixels of the picture per pixel of its latents, in rows and in columns
RANGE = 3.0  # latents are about of unit scale; the decoder reads them within +-RANGE, softly


def encode_columns(encoder: nn.Module, picture: Tensor, selection: Tensor) -> Tensor:
    """Return an encoder's latents (B, latents, h, w) of a picture (B, 3, FACTOR h, FACTOR w) in some of their columns.

    selection  (w,) bool: the columns, others are of no use. Only they and what the encoder sees beside them are read.
    """
    columns, margin = len(selection), math.ceil(reach_px(encoder) / FACTOR)
    steps = torch.arange(-margin, margin + 1, device=selection.device)
    mask = selection[(torch.arange(columns, device=selection.device)[:, None] + steps) % columns].any(1)
    starts = (mask & ~mask.roll(1)).nonzero()[:, 0].tolist()
    if not starts:
        return encoder(picture)
    windows = [
        torch.arange(start, start + int((~mask.roll(-start)).nonzero()[0]), device=selection.device) % columns
        for start in starts
    ]
    pixels = torch.arange(FACTOR, device=selection.device)
    parts = [encoder(picture.index_select(3, (window[:, None] * FACTOR + pixels).flatten())) for window in windows]
    latents = parts[0].new_zeros(*parts[0].shape[:3], columns)
    latents.index_copy_(3, torch.cat(windows), torch.cat(parts, 3))
    return latents


def reach_px(encoder: nn.Module) -> int:
    """Return how many pixels to either side of a latent's own an encoder sees."""
    reach, scale = 0, 1
    for part in encoder.modules():
        if isinstance(part, CircularConv):
            reach += part.reach * scale
            scale *= part.stride[0]
    return reach


class PlainResidual(nn.Module):
    """Two convolutions behind SiLU beside an identity: (B, C, H, W) -> the same shape."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = CircularConv(width, width), CircularConv(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Add the residual."""
        return x + self.second(silu(self.first(silu(x))))


class Autoencoder(nn.Module):
    """Encoder and decoder.

    latents  channels of the latents.
    encoder  channels at 1/2, 1/4 and 1/8 of the picture's raster;  decoder: those at 1/1, 1/2, 1/4 and 1/8.
    """

    def __init__(
        self,
        latents: int = 32,
        encoder: Sequence[int] = (32, 64, 128),
        decoder: Sequence[int] = (16, 32, 64, 128),
    ) -> None:
        super().__init__()
        fine, middle, coarse = encoder
        self.encoder = nn.Sequential(
            CircularConv(3, fine, stride=2),
            PlainResidual(fine),
            CircularConv(fine, middle, stride=2),
            PlainResidual(middle),
            PlainResidual(middle),
            CircularConv(middle, coarse, stride=2),
            PlainResidual(coarse),
            PlainResidual(coarse),
            nn.SiLU(),
            CircularConv(coarse, latents),
        )
        last, fine, middle, coarse = decoder
        self.decoder = nn.Sequential(
            CircularConv(latents, coarse),
            PlainResidual(coarse),
            PlainResidual(coarse),
            CircularConv(coarse, middle, 1),
            nn.Upsample(scale_factor=2),
            PlainResidual(middle),
            PlainResidual(middle),
            CircularConv(middle, fine, 1),
            nn.Upsample(scale_factor=2),
            PlainResidual(fine),
            nn.SiLU(),
            CircularConv(fine, last),
            nn.Upsample(scale_factor=2),
            nn.SiLU(),
            CircularConv(last, 3),
        )

    def encode(self, picture: Tensor) -> Tensor:
        """Return the latents (B, latents, H/8, W/8) of a picture (B, 3, H, W) in [-1, 1].

        Raises InputError unless H and W are multiples of FACTOR.
        """
        check_size(picture, FACTOR, "a picture")
        return self.encoder(picture)

    def decode(self, latents: Tensor) -> Tensor:
        """Return the picture (B, 3, 8h, 8w), about in [-1, 1], of latents (B, latents, h, w)."""
        return self.decoded(self.decoder, latents)

    @staticmethod
    def decoded(decoder: nn.Module, latents: Tensor) -> Tensor:
        """Return `decode` of latents by a decoder alone."""
        return decoder(torch.tanh(latents / RANGE) * RANGE)

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Encode and decode: return the picture again (B, 3, H, W) and its latents."""
        latents = self.encode(picture)
        return self.decode(latents), latents
