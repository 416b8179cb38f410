"""Painter: from camera segments, depth and remission on the panorama raster to a colour picture.

The first member of the RGB family (the paper's place for Vid2Vid): one encoder-decoder, circular in azimuth, that sees
the segments again at every scale (after SPADE: normalisation washes them out, Park et al. 2019) and paints
at twice the raster it reads.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from lidar2pano.errors import InputError
from lidar2pano.models.circular import CircularConv, CircularResidual, conv_norm_act
from lidar2pano.models.scene_painter import STRIDE, Scene, spread_out
from lidar2pano.models.titan_pano import depth_code


class Painter(nn.Module):
    """RGB from segments and geometry.

    classes  of the segments (common-15: 16 with unlabeled).
    widths   channels at 1/1, 1/2, 1/4 of the input raster.
    blocks   residual blocks at 1/4.
    filled   whether remission is spread over the gaps between the beams, so that the image does not show them.
    sharp    power that class probabilities are raised to before they sum to 1 again: above 1, what is likeliest stands
             out, and edges between classes are drawn where the translator hesitates.
    grain    whether a noise channel is added, for texture: drawn for each batch in training, afterwards always the same
             and fixed to the raster, so that videos do not flicker.
    """

    def __init__(
        self,
        classes: int = 16,
        widths: tuple[int, int, int] = (32, 80, 144),
        blocks: int = 5,
        *,
        filled: bool = False,
        sharp: float = 1.0,
        grain: bool = False,
    ) -> None:
        super().__init__()
        self.classes, self.filled, self.sharp, self.grain = classes, filled, sharp, grain
        inputs = classes + 4 + grain
        fine, middle, coarse = widths
        self.stem = conv_norm_act(inputs, fine)
        self.down1 = nn.Sequential(conv_norm_act(fine, middle, stride=2), CircularResidual(middle))
        self.down2 = conv_norm_act(middle, coarse, stride=2)
        self.trunk = nn.ModuleList([CircularResidual(coarse, dilation=(1, 2, 4)[i % 3]) for i in range(blocks)])
        self.up1 = nn.Sequential(conv_norm_act(coarse + inputs, 4 * middle, 1), nn.PixelShuffle(2))
        self.mix1 = nn.Sequential(conv_norm_act(2 * middle + inputs, middle), CircularResidual(middle))
        self.up0 = nn.Sequential(conv_norm_act(middle, 4 * fine, 1), nn.PixelShuffle(2))
        self.mix0 = nn.Sequential(conv_norm_act(2 * fine + inputs, fine), conv_norm_act(fine, fine))
        self.colour = nn.Sequential(CircularConv(fine, 12), nn.PixelShuffle(2))

    def forward(self, segments: Tensor, depth_m: Tensor, image: Tensor) -> Tensor:
        """Paint.

        segments  (B, classes, H, W): probabilities or one-hot.
        depth_m   (B, H, W): metres, everywhere.
        image     (B, 5, H, W): a RangeImage's channels, of which remission and validity are used.
        Returns (B, 3, 2H, 2W) in [-1, 1]. Raises InputError unless H and W are multiples of 4.
        """
        if segments.shape[-2] % STRIDE or segments.shape[-1] % STRIDE:
            raise InputError(f"segments of {tuple(segments.shape[-2:])} pixels: rows, columns must divide by {STRIDE}")
        inputs = self._inputs(segments, depth_m, image)
        fine = self.stem(inputs)
        inputs = inputs.to(fine.dtype)  # under autocast: one float32 part would make every joined tensor float32
        inputs2, inputs4 = self._coarser(inputs, 2), self._coarser(inputs, 4)
        middle = self.down1(fine)
        x = self.down2(middle)
        for block in self.trunk:
            x = block(x)
        x = self.mix1(torch.cat([_channels_last(self.up1(torch.cat([x, inputs4], 1))), middle, inputs2], 1))
        x = self.mix0(torch.cat([_channels_last(self.up0(x)), fine, inputs], 1))
        return torch.tanh(self.colour(x))

    def paint(self, past: object, scene: Scene) -> tuple[None, Tensor]:  # noqa: ARG002
        """Paint every scan for itself; arguments and answer as of StreamPainter."""
        return None, self(scene.segments, scene.depth_m, scene.channels)

    def _inputs(self, segments: Tensor, depth_m: Tensor, image: Tensor) -> Tensor:
        if self.sharp != 1:
            raised = segments.float().pow(self.sharp)
            segments = (raised / raised.sum(1, keepdim=True)).to(segments.dtype)
        remission, valid = image[:, 4].to(segments.dtype), (image[:, 0] > 0).to(segments.dtype)
        if self.filled:
            remission, valid = spread_out(remission, valid)
        row = torch.linspace(1, -1, segments.shape[2], device=segments.device, dtype=segments.dtype)
        extra = [depth_code(depth_m).to(segments.dtype), remission, valid, row[None, :, None].expand_as(valid)]
        if self.grain:
            extra.append(
                torch.randn_like(valid) if self.training else fixed_grain(*valid.shape[1:]).to(valid).expand_as(valid)
            )
        return torch.cat([segments, torch.stack(extra, 1)], 1)

    def _coarser(self, inputs: Tensor, pixels: int) -> Tensor:
        """Means over squares of so many pixels; of the grain, that is last, as strong as before."""
        means = avg_pool2d(inputs, pixels)
        return torch.cat([means[:, :-1], means[:, -1:] * pixels], 1) if self.grain else means


def fixed_grain(rows: int, columns: int) -> Tensor:
    """(rows, columns) float32 normal noise, always the same; a constant where a network is recorded as a graph."""
    return torch.from_numpy(_noise_array(rows, columns))


@lru_cache(maxsize=4)
def _noise_array(rows: int, columns: int) -> np.ndarray:
    """The numbers of `fixed_grain`, in numpy: a tensor that is made while a network is recorded has none."""
    return torch.randn(rows, columns, generator=torch.Generator().manual_seed(0)).numpy()


def _channels_last(x: Tensor) -> Tensor:
    """What is joined takes its first part's layout, and pixel shuffles give the slow one."""
    return x.contiguous(memory_format=torch.channels_last)
