"""vid2vid behind a translator of the paper's kind: pictures in the camera, each painted after the one before."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.errors import InputError
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.models.card import Card, load, read_card
from lidar2pano.models.vid2vid import Vid2Vid, Vid2VidSingle
from lidar2pano.models.vid2vid_painter import Past, Vid2VidPainter
from lidar2pano.views import VIEWS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPainter:
    """Paints the camera's classes.

    scale   the camera's image is painted this many times as wide and high, as large as things were in training, and
            then stretched back.
    """

    painter: Vid2VidPainter
    scale: float
    device: torch.device

    @classmethod
    def from_files(cls, file: Path, first: Path | None, device: torch.device) -> Self:
        """The painter of a weight file, and of that of vid2vid's network for first frames, if there is one.

        Raises InputError for another network than vid2vid: what it reads (depth, remission, all around) is not there
        behind a translator of the paper's kind.
        """
        if (network := read_card(file).network) != "vid2vid":
            raise InputError(
                f"{file}: a {network!r} paints panoramas only; what paints a camera's classes is 'vid2vid'"
            )
        generator, card = load(file, device, expect="vid2vid")
        single = load(first, device, expect="vid2vid-single")[0] if first is not None else None
        try:
            painter = Vid2VidPainter(cast("Vid2Vid", generator), cast("Vid2VidSingle | None", single), closed=False)
        except InputError as error:
            raise InputError(f"{file}: {error}") from None
        return cls(painter=painter.eval(), scale=learnt_scale(card), device=device)

    def paint(self, past: Past | None, ids: Tensor) -> tuple[Past, np.ndarray]:
        """Paint ids (h, w) of COMMON15 that follow others: what the next frame wants, and (h, w, 3) uint8 RGB."""
        size = (int(ids.shape[0]), int(ids.shape[1]))
        worked = (round(size[0] * self.scale), round(size[1] * self.scale))
        with fast_arithmetic(self.device):
            past, colour = self.painter.follow(past, _nearest(ids.to(self.device), worked))
        return past, picture(colour, size)


def learnt_scale(card: Card) -> float:
    """How many times KITTI's size were the pictures that a painter learnt from: its panorama's raster tells."""
    raster = card.views.get("panorama")
    return raster["columns"] / VIEWS["panorama"].columns if raster else 1.0


def picture(colour: Tensor, size: tuple[int, int]) -> np.ndarray:
    """Colours (3, H, W) in [-1, 1], stretched to `size` (rows, columns): (rows, columns, 3) uint8."""
    colour = colour.float()
    if colour.shape[1:] != size:
        colour = interpolate(colour[None], size=size, mode="bilinear", align_corners=False, antialias=True)[0]
    return ((colour.movedim(0, 2) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).cpu().numpy()


def _nearest(ids: Tensor, size: tuple[int, int]) -> Tensor:
    return interpolate(ids[None, None].to(torch.uint8), size=size, mode="nearest-exact")[0, 0]
