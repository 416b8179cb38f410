"""From a scan to a class per point: projection, network, KNN clean-up."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lidar2pano.geometry.images import Normalisation, RangeImage
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import project
from lidar2pano.models.card import Card
from lidar2pano.models.precision import fast_arithmetic
from lidar2pano.scan import Scan
from lidar2pano.sensors import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmenter:
    """A range-view network with the view and normalisation it was trained on.

    network   (1, 5, H, W) -> (1, classes, H, W) logits.
    """

    network: nn.Module
    view: View
    normalise: Normalisation

    @classmethod
    def from_card(cls, network: nn.Module, card: Card) -> Segmenter:
        """The segmenter that a weight file holds: `network, card = load(path)`."""
        normalise = Normalisation(**{name: tuple(values) for name, values in card.normalisation.items()})
        return cls(network=network, view=View(**card.views["input"]), normalise=normalise)

    @torch.inference_mode()
    def raster(self, image: RangeImage) -> Tensor:
        """Class ids (H, W) uint8 of a range image on the network's view."""
        x = self.normalise(image)[None].contiguous(memory_format=torch.channels_last)
        with fast_arithmetic(x.device):
            return self.network(x)[0].argmax(0).to(torch.uint8)

    def points(self, scan: Scan, device: str | torch.device = "cpu") -> Tensor:
        """Class ids (N,) int64 of a scan's points."""
        image = project(scan, self.view, device=device)
        return clean_up(image, self.raster(image))
