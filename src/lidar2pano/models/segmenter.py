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
from lidar2pano.models.salsanext import STRIDE
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
        """Class ids (H, W) uint8 of a range image; raises InputError unless its rows divide by STRIDE."""
        x = self.normalise(image)[None]
        columns = x.shape[3]
        if spare := -columns % STRIDE:  # Pandar64's 1800 columns do not divide: go on beyond the seam, or empty
            beyond = x[..., :spare] if image.view.circular else x.new_zeros(*x.shape[:3], spare)
            x = torch.cat([x, beyond], dim=3)
        with fast_arithmetic(x.device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last))[0]
        return logits[..., :columns].max(0).indices.to(torch.uint8)  # several times as fast as argmax

    def points(self, scan: Scan, device: str | torch.device = "cpu") -> Tensor:
        """Class ids (N,) int64 of a scan's points."""
        image = project(scan, self.view, device=device)
        return clean_up(image, self.raster(image))
