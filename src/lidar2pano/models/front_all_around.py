"""TITAN-Net, TITAN-Next and Pix2Pix over the whole turn: the paper's panoramas.

Paper section 3.3: in training the range view is cut to the camera's field of view; "the full range view image will be
only used during the inference to create the panoramic images". The published projection clamps every other point into
the border columns and cannot do it. Here the front view, as fine as it was in training, goes on around the sensor and
beyond its own ends, so that no column has a border beside it. A network that was trained on the camera's picture of
90 degrees then writes four times as many columns; its rows are taken for the camera's, which those of VIEWS["panorama"]
are. Perspective, which widens the picture towards its sides, means nothing all around: columns are taken for azimuth.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.geometry.projection import Normalisation
from lidar2pano.geometry.rasters import pad_azimuth
from lidar2pano.labels import COMMON15
from lidar2pano.models.salsanext import IMAGE_SIZE
from lidar2pano.scene.depth import FAR_M, complete_depth
from lidar2pano.views import FULL_TURN, VIEWS, View

PANORAMA = VIEWS["panorama"].scaled(0.5)  # 192 x 2304, the raster of the classes
OVERLAP = 8  # part of the front view's columns that the turn goes on beyond each of its ends
NEVER = -1e4  # logit of the sky, which the paper's classes do not have


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
