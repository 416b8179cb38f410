"""The first network of a pipeline: a scan's points get their classes on a range view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import Normalisation, RangeImage, fitted_view, project
from lidar2pano.geometry.rasters import likeliest
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.models.card import Card
from lidar2pano.models.salsanext import STRIDE
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import denser
from lidar2pano.views import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmenter:
    """A range-view network with the view and normalisation it was trained on.

    network   (1, 5, H, W) -> (1, classes, H, W) logits.
    tallest   how far rows are added to the view for sensors that see more (fitted_view); None: none are.
    """

    network: nn.Module
    view: View
    normalise: Normalisation
    tallest: View | None = None

    @classmethod
    def from_card(cls, network: nn.Module, card: Card) -> Segmenter:
        """The segmenter that a weight file holds: `network, card = load(path)`."""
        normalise = validated(Normalisation, card.normalisation, "the card's normalisation")
        views = {role: validated(View, view, "the card's view") for role, view in card.views.items()}
        for view in views.values():
            if view.rows % STRIDE or view.columns < STRIDE:
                raise InputError(
                    f"the card's view of {view.rows} x {view.columns} pixels is no segmenter's: its rows must divide by"
                    f" {STRIDE}, and it has as many columns at least; fetch or make the file again"
                )
        return cls(network=network, view=views["input"], normalise=normalise, tallest=views.get("tallest input"))

    def at(self, view: View) -> Segmenter:
        """The segmenter on another view, whatever the scan."""
        return replace(self, view=view, tallest=None)

    def project(self, scan: Scan, device: str | torch.device = "cpu") -> RangeImage:
        """The range image that the network labels."""
        return project(scan, fitted_view(scan, self.view, self.tallest), device=device)

    @torch.inference_mode()
    def raster(self, image: RangeImage) -> Tensor:
        """Class ids (H, W) uint8 of a range image; raises InputError unless its rows divide by STRIDE."""
        x = self.normalise(image)[None]
        columns = x.shape[3]
        if spare := -columns % STRIDE:  # Pandar64's 1800 columns do not divide: go on beyond the seam, or empty
            beyond = x[..., :spare] if image.view.circular else x.new_zeros(*x.shape[:3], spare)
            x = torch.cat([x, beyond], dim=3)
        with fast_arithmetic(x.device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last))
        return likeliest(logits[..., :columns])[0]

    def label(self, image: RangeImage, timer: Timer) -> Tensor:
        """Class ids (N,) int64 of the points of a range image on `view`: the network, then the KNN clean-up."""
        with timer("segment"):
            ids = self.raster(image)
        with timer("clean_up"):
            return clean_up(image, ids)

    def points(self, scan: Scan, device: str | torch.device = "cpu") -> Tensor:
        """Class ids (N,) int64 of a scan's points."""
        _, image, _ = denser(scan, self.project(scan, device))
        return self.label(image, Timer(torch.device(device)))[: len(scan)]
