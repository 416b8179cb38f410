"""Task: SalsaNext on labelled scans. Cross-entropy weighted by rarity, plus Lovasz-Softmax."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from lidar2pano.data.ranges import RangeSample, RangeSamples, Variation
from lidar2pano.geometry.images import Normalisation
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.pipeline import Segmenter
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS


class Segmentation:
    """Trains a range-view segmenter; scores it per point on the validation split, KNN clean-up included.

    Options: columns, the width of the azimuth crop (0: the whole turn); turn_deg, chance, remission and rings, how
    scans are augmented (data.ranges.Variation); lovasz, the weight of Lovasz-Softmax; rarity, the power of a class's
    rarity that weighs it in the cross-entropy; dropout, whether the network's dropout is on.
    """

    released = ("segmenter",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.view = VIEWS[recipe.view]
        option = recipe.options
        vary = Variation(**{name: float(option[name]) for name in ("turn_deg", "chance", "remission", "rings")})
        self.dataset = RangeSamples(root, recipe.data.train, self.view, int(option["columns"]), vary)
        self.validation = RangeSamples(root, recipe.data.val, self.view)
        self.networks = build_networks(recipe)
        if not option["dropout"]:
            for module in self.networks["segmenter"].modules():
                if isinstance(module, nn.Dropout2d):
                    module.p = 0.0
        self.lovasz = float(option["lovasz"])
        self.weights = rarity(self.dataset, float(option["rarity"]))
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: RangeSample) -> Iterator[tuple[str, Tensor]]:
        """One update: cross-entropy over labelled pixels + Lovasz-Softmax over the classes present."""
        logits = self.networks["segmenter"](batch.lidar).float()
        entropy = cross_entropy(logits, batch.labels, weight=self.weights.to(logits.device), ignore_index=0)
        lovasz = lovasz_softmax(logits.softmax(1), batch.labels, ignore=0)
        self.logs = {"cross_entropy": entropy.detach(), "lovasz": lovasz.detach()}
        yield "segmenter", entropy + self.lovasz * lovasz

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.networks["segmenter"].parameters()).device

    def segmenter(self) -> Segmenter:
        """The network as it stands, ready for scans."""
        return Segmenter(network=self.networks["segmenter"], view=self.view, normalise=Normalisation())

    def validate(self) -> dict[str, float]:
        """MIoU and accuracy per point over the validation split; unlabeled points are not scored."""
        confusion = Confusion(len(SEMANTIC_KITTI), unscored=(0,))
        for index in range(len(self.validation)):
            scan = self.validation.scan(index)
            assert scan.label is not None
            confusion.update(self.segmenter().points(scan, self.device).cpu(), torch.from_numpy(scan.label))
        score = confusion.miou()
        return {"score": score, "miou": score, "accuracy": confusion.accuracy()}

    def preview(self) -> dict[str, np.ndarray]:
        """Labels of a validation scan: teacher's above, the network's below, (H, W, 3) uint8."""
        sample = self.validation[0]
        with torch.inference_mode():
            ids = self.networks["segmenter"](sample.lidar[None].to(self.device))[0].argmax(0).cpu()
        pair = [SEMANTIC_KITTI.paint(picture.numpy()) for picture in (sample.labels, ids)]
        return {"segments": np.concatenate(pair)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the segmenter has to know: label set, view, normalisation."""
        normalise = Normalisation()
        return {
            "labels": SEMANTIC_KITTI.name,
            "views": {"input": self.view.as_dict()},
            "normalisation": {"mean": list(normalise.mean), "deviation": list(normalise.deviation)},
        }


def rarity(dataset: RangeSamples, power: float) -> Tensor:
    """Weights (K,) of the classes: one over a power of their share of the points, mean 1, at most 6."""
    counts = np.zeros(len(SEMANTIC_KITTI))
    for index in range(len(dataset.frames)):
        label = dataset.scan(index).label
        assert label is not None
        counts += np.bincount(label, minlength=len(counts))
    share = np.maximum(counts / counts.sum(), 1e-5)
    weights = share**-power
    weights = np.minimum(weights / weights[1:].mean(), 6.0)
    return torch.from_numpy(weights).float()
