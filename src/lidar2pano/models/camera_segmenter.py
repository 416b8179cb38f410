"""From a camera picture to the probability of every class at every pixel: what camera teachers have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import CITYSCAPES
from lidar2pano.models.card import Card


class CameraTeacher(Protocol):
    """A network that labels camera images."""

    def probabilities(self, image: np.ndarray) -> Tensor:
        """Probabilities (19, h, w) float32 of the Cityscapes train ids, summing to 1, of a picture.

        image  (h, w, 3) uint8 RGB.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNormalisation:
    """Means and deviations of the channels of RGB pictures in [0, 1]; the defaults are those of ImageNet."""

    mean: tuple[float, ...] = (0.485, 0.456, 0.406)
    deviation: tuple[float, ...] = (0.229, 0.224, 0.225)

    def __post_init__(self) -> None:
        """Refuse other than three numbers each, and deviations that are not positive (ValueError)."""
        if len(self.mean) != 3 or len(self.deviation) != 3 or min(self.deviation) <= 0:
            raise ValueError("normalisation needs a mean and a positive deviation for each of 3 channels")

    def __call__(self, images: Tensor) -> Tensor:
        """(..., 3, h, w) uint8 RGB -> float32, normalised."""
        mean = torch.tensor(self.mean, device=images.device)[:, None, None]
        deviation = torch.tensor(self.deviation, device=images.device)[:, None, None]
        return (images.float() / 255 - mean) / deviation

    def as_dict(self) -> dict[str, list[float]]:
        """What a card says under `normalisation`."""
        return {"mean": list(self.mean), "deviation": list(self.deviation)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSegmenter:
    """A camera network with the scales to look at and the normalisation it was trained on; a CameraTeacher.

    network    SdNet: (1, 3, h, w) and the scales -> (1, 19, h, w) logits.
    normalise  of its pictures.
    scales     sizes of the picture that are looked at, as factors with 1.0 among them (published scripts: 0.5, 1, 2);
               None: those that the network was made with.
    """

    network: nn.Module
    normalise: ImageNormalisation
    scales: tuple[float, ...] | None = None

    @classmethod
    def from_card(cls, network: nn.Module, card: Card, scales: tuple[float, ...] | None = None) -> CameraSegmenter:
        """The segmenter that a weight file holds: `network, card = load(path, expect="sdnet")`.

        scales  as above.
        A card of another label set raises InputError.
        """
        if card.labels != CITYSCAPES.name:
            raise InputError(
                f"weights of network {card.network!r} speak {card.labels!r}, not {CITYSCAPES.name!r}: "
                "they cannot label cameras; name others"
            )
        normalise = validated(ImageNormalisation, card.normalisation, "the card's normalisation")
        return cls(network=network, normalise=normalise, scales=scales)

    @torch.inference_mode()
    def probabilities(self, image: np.ndarray) -> Tensor:
        """Probabilities (19, h, w) float32 on the network's device, of a picture (h, w, 3) uint8 RGB of any size.

        The whole picture is looked at at once, since OCR gathers every class over all of it: at scales 0.5, 1 and 2
        the published network takes 3 GiB for KITTI's 376 x 1241 pixels in float32, 2 GiB in bfloat16.
        Another kind of array raises ValueError.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"a picture is (h, w, 3) uint8 RGB, got {image.shape} {image.dtype}")
        device = next(self.network.parameters()).device
        pixels = torch.from_numpy(np.array(image, order="C")).to(device)  # a copy: pictures may be read-only
        x = self.normalise(pixels.movedim(2, 0))[None]
        with fast_arithmetic(device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last), self.scales)[0]
        return logits.float().softmax(0)
