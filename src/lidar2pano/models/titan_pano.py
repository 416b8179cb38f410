"""TITAN-pano: from a scan on the panorama raster to a camera's classes and depth all around.

TITAN-Net (Cortinhal et al. 2021) on a cylinder around the camera, in place of the front view. Deviations from
`titan`, each with its reason: nothing is squeezed to one channel before fusion (the published generator loses 24 of 25
channels there); every convolution pads circularly in azimuth (no seam behind the vehicle, every direction alike);
a feature pyramid joins the scales and a head predicts depth, as its follow-up TITAN-Next has (Cortinhal et al. 2023);
positions enter as range and height only, since x and y would tell directions apart; each pixel reads the nearest point
of its column, too, since walls and trees go on above a sensor's beams, however high these reach.

TITAN-Net, TITAN-Next and Pix2Pix themselves go over the whole turn for the paper's panoramas (section 3.3): in training
the range view is cut to the camera's field of view; "the full range view image will be only used during the inference
to create the panoramic images". The published projection clamps every other point into the border columns and cannot do
it. Here the front view, as fine as it was in training, goes on around the sensor and beyond its own ends, so that no
column has a border beside it. A network trained on the camera's picture of 90 degrees then writes four times as many
columns; its rows are taken for the camera's, as those of VIEWS["panorama"] are. Perspective, which widens the picture
towards its sides, means nothing all around: columns are taken for azimuth.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.geometry.projection import Normalisation
from lidar2pano.geometry.rasters import nearest_row, pad_azimuth, upsample_azimuth
from lidar2pano.labels import COMMON15
from lidar2pano.models.blocks import CircularConv, CircularResidual, check_size, conv_norm_act
from lidar2pano.models.salsanext import IMAGE_SIZE
from lidar2pano.scene.depth import FAR_M, LOG_FAR, complete_depth
from lidar2pano.views import FULL_TURN, VIEWS, View

CHANNELS = 5  # of a RangeImage, and of `evidence`
VALID = 3  # of `evidence`: whether a point is there
STRIDE = 16  # input pixels per pixel of the coarsest level
PANORAMA = VIEWS["panorama"].scaled(0.5)  # 192 x 2304, the raster of the classes
OVERLAP = 8  # part of the front view's columns that the turn goes on beyond each of its ends
NEVER = -1e4  # logit of the sky, which the paper's classes do not have


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
        self.stem = conv_norm_act(2 * (CHANNELS + conditions), stem)
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

        image      (B, 5, H, W): a RangeImage's channels (range, x, y, z in metres, remission; zero where empty); on
                   other elevations than the panorama's `with_rows`, (B, 6, H, W).
        condition  (B, conditions, H, W): one-hot LiDAR segments; all zero or unlabeled where empty.
        Returns logits (B, classes, H, W) and depth (B, H, W), metres along the ray, float32.
        Raises InputError unless H and W are multiples of 16.
        """
        check_size(image, STRIDE, "a panorama")
        fine = self.stem(continued(evidence(image), condition.to(image.dtype)))
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


def continued(channels: Tensor, condition: Tensor) -> Tensor:
    """Join `evidence` (B, 5, H, W) and classes (B, C, H, W) with those of each pixel's nearest point of its column.

    Beams end below a camera's picture, and lie apart: surfaces go on between and above them. Returns (B, 2 (5 + C), H,
    W): all as they are, then those of the nearest point, in place of its channel of points nearness: 1 / (1 + rows to
    it). In columns without points the lowest pixel stands for it, with nearness 0.
    """
    count, _, rows, columns = channels.shape
    source, row = nearest_row(channels[:, VALID] > 0), torch.arange(rows, device=channels.device)[:, None]
    pixels = torch.cat([channels.movedim(1, 3), condition.movedim(1, 3)], 3)  # rows of memory: copied in no time
    first = torch.arange(count, device=channels.device)[:, None, None] * rows
    place = (first + source) * columns + torch.arange(columns, device=channels.device)
    copied = pixels.flatten(0, 2).index_select(0, place.flatten()).view_as(pixels)
    copied[..., VALID] /= 1 + (row - source).abs()
    return torch.cat([pixels, copied], 3).movedim(3, 1)


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

    log range, height z / 4 m, remission, whether a point is there, and the row (as a number in [-1, 1]): a sixth
    channel's, if there is one.
    """
    range_m, z, remission = image[:, 0], image[:, 3], image[:, 4]
    valid = (range_m > 0).to(image.dtype)
    if image.shape[1] == CHANNELS:
        row = torch.linspace(1, -1, image.shape[2], device=image.device, dtype=image.dtype)
        row = row[None, :, None].expand_as(range_m)
    else:
        row = image[:, CHANNELS]
    return torch.stack([torch.log1p(range_m) / LOG_FAR, z / 4, remission, valid, row], 1)


def with_rows(channels: Tensor, view: View) -> Tensor:
    """Return channels (B, 5, H, W) on a cylinder with a sixth, the row: of one elevation the same on every raster.

    It goes from 1 to -1 between the panorama's borders and on beyond them. On the panorama's own elevations the
    channels stay as they are: the network numbers these rows itself.
    """
    if math.isclose(view.up, PANORAMA.up) and math.isclose(view.down, PANORAMA.down):
        return channels
    pitch = (view.up - view.down) / view.rows
    rows = (PANORAMA.up - PANORAMA.down) / pitch
    number = torch.arange(view.rows, dtype=torch.float64) + (PANORAMA.up - view.up) / pitch
    row = (1 - 2 * number / (rows - 1)).to(channels)
    return torch.cat([channels, row[:, None].expand_as(channels[:, :1])], 1)


class FrontAllAround(nn.Module):
    """A front-view translator as one of panoramas.

    network    (1, 5, H, W) normalised, (1, 20, H, W) one-hot -> logits (1, 15, *size) of COMMON14, or those and depth.
    front      the view that it was trained on;  normalise: of its input.
    view       raster of the panorama.
    input_view  the front view all around: the raster that `forward` reads.
    """

    def __init__(self, network: nn.Module, front: View, normalise: Normalisation, view: View = PANORAMA) -> None:
        super().__init__()
        turn = FULL_TURN / (front.left - front.right)
        self.network, self.normalise, self.view = network, normalise, view
        self.input_view = replace(front, columns=round(front.columns * turn), left=180.0, right=-180.0)
        self.overlap = max(front.columns // OVERLAP // 16, 1) * 16
        rows, columns = getattr(network, "size", None) or IMAGE_SIZE
        wide = self.input_view.columns + 2 * self.overlap
        size = (int(rows), round(wide * int(columns) / front.columns))
        vars(network)["size"] = size  # how large an image it predicts

    def forward(self, channels: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Translate.

        channels   (1, 5, h, w) float32 of a RangeImage on `input_view`;  condition (1, 20, h, w) one-hot classes.
        Returns logits (1, 16, H, W) of COMMON15, never the sky, and depth (1, H, W) float32, metres: the network's or,
        where it predicts none, completed from the points. Float32: instance norms amplify bfloat16's rounding errors.
        """
        with torch.autocast(channels.device.type, enabled=False):
            output = self.network(
                *(pad_azimuth(part.float(), self.overlap) for part in (self._normalised(channels), condition))
            )
        logits, depth_m = output if isinstance(output, tuple) else (output, None)
        sky = logits.new_full((1, len(COMMON15) - logits.shape[1], *logits.shape[2:]), NEVER)
        logits = self._on_view(torch.cat([logits, sky], 1))
        if depth_m is not None:
            return logits, self._on_view(depth_m[None])[0]
        xyz = channels[0, 1:4].flatten(1).T[channels[0, 0].flatten() > 0]
        return logits, complete_depth(xyz.cpu(), self.view).clamp(max=FAR_M)[None].to(logits.device)

    def _normalised(self, channels: Tensor) -> Tensor:
        mean, deviation = (
            channels.new_tensor(part)[:, None, None] for part in (self.normalise.mean, self.normalise.deviation)
        )
        return (channels - mean) / deviation * (channels[:, :1] > 0)

    def _on_view(self, image: Tensor) -> Tensor:
        """(1, C, rows, columns) of the turn and its overlaps -> (1, C, H, W)."""
        spare = round(self.overlap * self.view.columns / self.input_view.columns)
        size = (self.view.rows, self.view.columns + 2 * spare)
        resized = interpolate(image.float(), size, mode="bilinear", align_corners=False, antialias=True)
        return resized[..., spare : spare + self.view.columns].contiguous()
