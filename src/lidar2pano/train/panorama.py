"""Task: TITAN-pano on scan/camera pairs in panorama coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from lidar2pano.data.panoramas import PanoramaSample, PanoramaSamples
from lidar2pano.data.sequences import UNSURE
from lidar2pano.geometry.images import one_hot_layers
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.models.card import load
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.pipeline import Segmenter
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS


class PanoramaTranslation:
    """Trains a translator: cross-entropy and Lovasz-Softmax where the camera looks, depth where the LiDAR measured.

    Options: columns, the width of the crop around the camera's sector; lovasz and depth, weights of those losses;
    rarity, the power of a class's rarity that weighs it in the cross-entropy (less of it is less generous to rare
    classes); segmenter, a weight file whose labels are used beside the teacher's in training and alone in validation
    ("": the teacher's everywhere).
    """

    released = ("translator",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.view = VIEWS[recipe.view].scaled(recipe.scale)
        columns = int(recipe.options["columns"])
        self.dataset = PanoramaSamples(root, recipe.data.train, self.view, columns)
        self.validation = PanoramaSamples(root, recipe.data.val, self.view, columns)
        self.networks = build_networks(recipe)
        self.lovasz, self.depth = float(recipe.options["lovasz"]), float(recipe.options["depth"])
        self.weights = camera_rarity(self.dataset, float(recipe.options["rarity"]))
        self.logs: dict[str, float | Tensor] = {}
        if recipe.options["segmenter"]:
            segmenter = Segmenter.from_card(*load(str(recipe.options["segmenter"]), expect="salsanext"))
            for samples in (self.dataset, self.validation):
                samples.predict(segmenter.points)

    def updates(self, batch: PanoramaSample) -> Iterator[tuple[str, Tensor]]:
        """One update of the translator."""
        logits, depth_m = self.networks["translator"](batch.image, conditions(batch.segments))
        logits = logits.float()
        entropy = cross_entropy(logits, batch.camera, weight=self.weights.to(logits.device), ignore_index=UNSURE)
        lovasz = lovasz_softmax(logits.softmax(1), batch.camera, ignore=UNSURE)
        measured = batch.depth_m > 0
        gap = (depth_code(depth_m) - depth_code(batch.depth_m)).abs()
        depth = (gap * measured).sum() / measured.sum().clamp(min=1)
        self.logs = {"cross_entropy": entropy.detach(), "lovasz": lovasz.detach(), "depth": depth.detach()}
        yield "translator", entropy + self.lovasz * lovasz + self.depth * depth

    def predict(self, sample: PanoramaSample) -> Tensor:
        """Class ids (H, W) of the sample's crop, from the network as it stands."""
        network = self.networks["translator"]
        device = next(network.parameters()).device
        with torch.inference_mode(), fast_arithmetic(device):
            logits, _ = network(sample.image[None].to(device), conditions(sample.segments[None].to(device)))
        return logits[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes in the camera's sector, on the raster; sky and unsure pixels are not scored."""
        confusion = Confusion(len(COMMON15), unscored=(0, COMMON15.id_of("sky")))
        for index in range(len(self.validation)):
            sample = self.validation[index]
            confusion.update(self.predict(sample), sample.camera)
        score = confusion.miou()
        return {"score": score, "miou": score, "accuracy": confusion.accuracy()}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for three validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.validation))):
            sample = self.validation[index]
            rows += [COMMON15.paint(ids.numpy()) for ids in (sample.camera, self.predict(sample))]
        return {"segments": np.concatenate(rows)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the translator has to know: label set and raster."""
        return {"labels": COMMON15.name, "views": {"panorama": self.view.as_dict()}}


def conditions(segments: Tensor) -> Tensor:
    """One-hot (B, 20, H, W) float32 of LiDAR segments (B, H, W)."""
    return one_hot_layers(segments, len(SEMANTIC_KITTI))


def camera_rarity(dataset: PanoramaSamples, power: float) -> Tensor:
    """Weights (K,) of the camera's classes: one over a power of their share of the pixels, mean 1, at most 4."""
    counts = np.zeros(256)
    for index in range(len(dataset)):
        counts += np.bincount(dataset.moment(index).camera.flatten().numpy(), minlength=256)
    share = np.maximum(counts[: len(COMMON15)] / counts[: len(COMMON15)].sum(), 1e-4)
    weights = share**-power
    return torch.from_numpy(np.minimum(weights / weights[1:].mean(), 4.0)).float()
