"""TITAN-pano: from a scan on the panorama raster to a camera's classes and depth all around.

TITAN-Net (Cortinhal et al. 2021) on a cylinder around the camera, in place of the front view. Deviations from
`titan`, each with its reason: nothing is squeezed to one channel before fusion (the published generator loses 24 of 25
channels there); every convolution pads circularly in azimuth (no seam behind the vehicle, every direction alike);
a feature pyramid joins the scales and a head predicts depth, as its follow-up TITAN-Next has (Cortinhal et al. 2023);
positions enter as range and height only, since x and y would tell directions apart.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import upsample_azimuth
from lidar2pano.models.blocks import CircularConv, CircularResidual, conv_norm_act
from lidar2pano.scene.depth import LOG_FAR

STRIDE = 16  # input pixels per pixel of the coarsest level


class TitanPano(nn.Module):
    """Class scores and depth on the panorama raster.

    classes     of the output (common-15: 16 with unlabeled).
    conditions  classes of the LiDAR's segments (SemanticKITTI: 20).
    widths      channels at 1/1, 1/2, 1/4, 1/8, 1/16 of the input raster.
    pyramid     channels of the feature pyramid.
    dropout     share of channels zeroed inside the deeper residual blocks, in training.
    """

    def __init__(
        self,
        classes: int = 16,
        conditions: int = 20,
        widths: tuple[int, int, int, int, int] = (32, 64, 112, 160, 224),
        pyramid: int = 80,
        dropout: float = 0.2,
    ) -> None:
        super().__init__()
        self.conditions = conditions
        stem, *deeper = widths
        self.stem = conv_norm_act(5 + conditions, stem)
        levels, inputs = [], stem
        for depth, width in enumerate(deeper):
            blocks = [conv_norm_act(inputs, width, stride=2), CircularResidual(width, 1, dropout * (depth > 0))]
            blocks += [CircularResidual(width, 2 if depth > 1 else 1, dropout * (depth > 0))]
            levels.append(nn.Sequential(*blocks))
            inputs = width
        self.levels = nn.ModuleList(levels)
        self.surround = GlobalContext(inputs)
        self.laterals = nn.ModuleList([CircularConv(width, pyramid, 1) for width in deeper])
        self.smooth = nn.ModuleList([conv_norm_act(pyramid, pyramid) for _ in deeper])
        self.fuse = conv_norm_act(pyramid, 4 * stem)
        self.shuffle = nn.PixelShuffle(2)
        self.head = conv_norm_act(2 * stem, 2 * stem)
        self.classes = CircularConv(2 * stem, classes, 1)
        self.depth = CircularConv(2 * stem, 1, 1)

    def forward(self, image: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Predict classes and depth everywhere, also without a point.

        image      (B, 5, H, W): a RangeImage's channels (range, x, y, z in metres, remission; zero where empty).
        condition  (B, conditions, H, W): one-hot LiDAR segments; all zero or unlabeled where empty.
        Returns logits (B, classes, H, W) and depth (B, H, W), metres along the ray, float32.
        Raises InputError unless H and W are multiples of 16.
        """
        if image.shape[-2] % STRIDE or image.shape[-1] % STRIDE:
            raise InputError(f"a panorama of {tuple(image.shape[-2:])} pixels: rows, columns must divide by {STRIDE}")
        fine = self.stem(torch.cat([evidence(image), condition.to(image.dtype)], 1))
        features, x = [], fine
        for level in self.levels:
            x = level(x)
            features.append(x)
        features[-1] = self.surround(features[-1])
        x = self.smooth[-1](self.laterals[-1](features[-1]))
        for depth in (2, 1, 0):
            x = self.smooth[depth](self.laterals[depth](features[depth]) + upsample_azimuth(x, 2))
        x = self.head(torch.cat([self.shuffle(self.fuse(x)), fine], 1))
        depth_m = torch.expm1(self.depth(x)[:, 0].float().sigmoid() * LOG_FAR)
        return self.classes(x), depth_m


class GlobalContext(nn.Module):
    """Adds context of the whole picture: means over the azimuth per row, and over everything."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.row = nn.Conv1d(channels, channels, 3, padding=1)
        self.all = nn.Linear(channels, channels)
        self.join = conv_norm_act(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> the same shape."""
        context = self.row(x.mean(3))[..., None] + self.all(x.mean((2, 3)))[..., None, None]
        return x + self.join(x + context)


def evidence(image: Tensor) -> Tensor:
    """Make the network's channels of a range image (B, 5, H, W): five of order one, the same in every direction.

    log range, height z / 4 m, remission, whether a point is there, and the row (as a number in [-1, 1]).
    """
    range_m, z, remission = image[:, 0], image[:, 3], image[:, 4]
    valid = (range_m > 0).to(image.dtype)
    row = torch.linspace(1, -1, image.shape[2], device=image.device, dtype=image.dtype)
    row = row[None, :, None].expand_as(range_m)
    return torch.stack([torch.log1p(range_m) / LOG_FAR, z / 4, remission, valid, row], 1)
