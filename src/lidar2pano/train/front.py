"""Task: TITAN-Net in the paper's setting: front range view in, the camera's perspective segments out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.fronts import FrontSample, FrontSamples, Wanted
from lidar2pano.geometry.images import Normalisation, one_hot_layers
from lidar2pano.labels import COMMON14, SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.models.card import load
from lidar2pano.models.titan import IMAGE_SIZE
from lidar2pano.pipeline import Segmenter
from lidar2pano.train.adversarial import wasserstein_updates
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS, View


class FrontTranslation:
    """Trains TITAN-Net by WGAN-GP and Lovasz-Softmax; class 0 guides nobody and is not scored, as in the paper.

    Options: penalty, lambda of the gradient penalty; lovasz, weight of the guide (0: none, the paper's ablation);
    segmenter, a weight file whose labels validation takes ("": the labels of the data; training always takes those, as
    in the paper). Ablations without one of the inputs are settings of the network.
    """

    released = ("translator",)
    wanted = Wanted(classes=True)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.view, self.option = VIEWS[recipe.view], dict(recipe.options)
        self.networks = build_networks(recipe)
        size = image_size(recipe, "translator")
        self.dataset = FrontSamples(root, recipe.data.train, self.view, size, self.wanted)
        self.validation = FrontSamples(root, recipe.data.val, self.view, size, self.wanted)
        self.logs: dict[str, float | Tensor] = {}
        if self.option["segmenter"]:
            segmenter = Segmenter.from_card(*load(str(self.option["segmenter"]), expect="salsanext"))
            self.validation.predict(segmenter.points)

    def updates(self, batch: FrontSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition, lovasz = conditions(batch.segments), float(self.option["lovasz"])

        def guide(fake: Tensor) -> Tensor:
            return lovasz * lovasz_softmax(fake, batch.camera, ignore=0)

        updates = wasserstein_updates(
            lambda: self.networks["translator"](batch.lidar, condition).float().softmax(1),
            self.networks["critic"],
            one_hot_layers(batch.camera, len(COMMON14)),
            condition,
            penalty_weight=float(self.option["penalty"]),
            guide=guide if lovasz else None,
            logs=self.logs,
        )
        yield from called(updates, "translator")

    def predict(self, sample: FrontSample) -> Tensor:
        """Class ids (h, w) of a sample, from the network as it stands."""
        network = self.networks["translator"]
        device = next(network.parameters()).device
        condition = conditions(sample.segments[None].to(device))
        with torch.inference_mode():  # in float32: instance norms amplify what bfloat16 rounds away
            return network(sample.lidar[None].to(device), condition)[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image."""
        confusion = Confusion(len(COMMON14), unscored=(0,))
        for index in range(len(self.validation)):
            sample = self.validation[index]
            confusion.update(self.predict(sample), sample.camera)
        score = confusion.miou()
        return {"score": score, "miou": score, "accuracy": confusion.accuracy()}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for two validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(2, len(self.validation))):
            sample = self.validation[index]
            rows += [COMMON14.paint(ids.numpy()) for ids in (sample.camera, self.predict(sample))]
        return {"segments": np.concatenate(rows)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the translator has to know: label set, view, normalisation."""
        return {"labels": COMMON14.name, **range_view(self.view)}


def conditions(segments: Tensor) -> Tensor:
    """One-hot (B, 20, H, W) float32 of LiDAR segments (B, H, W)."""
    return one_hot_layers(segments, len(SEMANTIC_KITTI))


def image_size(recipe: Recipe, role: str) -> tuple[int, int]:
    """Rows and columns of the image that the recipe's network `role` writes: its setting, the option, or KITTI's."""
    rows, columns = recipe.networks[role].settings.get("size") or recipe.options.get("size", IMAGE_SIZE)
    return int(rows), int(columns)


def range_view(view: View) -> dict[str, Any]:
    """Fields of the card of a network that reads normalised range images of `view`."""
    normalise = Normalisation()
    normalisation = {"mean": list(normalise.mean), "deviation": list(normalise.deviation)}
    return {"views": {"input": view.as_dict()}, "normalisation": normalisation}


def called(updates: Iterable[tuple[str, Tensor]], generator: str) -> Iterator[tuple[str, Tensor]]:
    """The updates of an adversarial step with the generator under the name that the recipe has for it."""
    for who, loss in updates:
        yield generator if who == "generator" else who, loss
