"""Tasks: Pix2Pix in TITAN-Net's place, from segments to segments, and from the range view to colours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, l1_loss, mse_loss

from lidar2pano.data.camera_projection import CameraProjectionSample
from lidar2pano.data.front_view import FrontViewSample
from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.images import one_hot_layers
from lidar2pano.labels import COMMON14
from lidar2pano.train.direct import DirectColour
from lidar2pano.train.front import FrontTranslation, called, conditions
from lidar2pano.train.patchgan import pix2pix_updates

GUIDES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"l1": l1_loss, "mse": mse_loss}


class Pix2PixSegments(FrontTranslation):
    """Trains Pix2Pix from range view and segments to the camera's segments, one-hot in [-1, 1].

    Every pixel counts, those of class 0 too: Pix2Pix knows no class that does not. Options: rule, of the critic
    ("vanilla" or "lsgan"); guide ("l1" or "mse") and its weight; segmenter as in FrontTranslation.
    """

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition = conditions(batch.segments)
        network, critic = self.networks["translator"], self.networks["critic"]
        real = 2 * one_hot_layers(batch.camera_labels, len(COMMON14)) - 1
        updates = pix2pix_updates(
            lambda: network(batch.lidar, condition).float(),
            critic,
            real,
            on_image(torch.cat([batch.lidar, condition], 1), real),
            weighted_guide(self.option, real),
            rule=str(self.option["rule"]),
            logs=self.logs,
        )
        yield from called(updates, "translator")


class Pix2PixColours(DirectColour):
    """Trains Pix2Pix from the range view to the camera's picture; options as in Pix2PixSegments."""

    def updates(self, batch: FrontViewSample | CameraProjectionSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the renderer."""
        seen, network, critic = self.seen(batch), self.networks["renderer"], self.networks["critic"]
        updates = pix2pix_updates(
            lambda: network(seen).float(),
            critic,
            batch.image,
            on_image(seen, batch.image),
            weighted_guide(self.option, batch.image),
            rule=str(self.option["rule"]),
            logs=self.logs,
        )
        yield from called(updates, "renderer")


def on_image(seen: Tensor, image: Tensor) -> Tensor:
    """What the generator sees, stretched to the image that the critic judges beside it, as Pix2Pix stretches it."""
    return interpolate(seen, size=image.shape[-2:], mode="area")


def weighted_guide(option: Mapping[str, Any], real: Tensor) -> Callable[[Tensor], Tensor]:
    """The distance to `real` that the options `guide` and `weight` name; an unknown one raises InputError."""
    name, weight = str(option["guide"]), float(option["weight"])
    if name not in GUIDES:
        raise InputError(f"options.guide cannot be {name!r}{closest(name, GUIDES)}")
    return lambda fake: weight * GUIDES[name](fake, real)
