"""Task: SalsaNext on labelled scans. Cross-entropy with class weights, plus Lovasz-Softmax."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.data.range_images import PLAIN, RangeImageDataset, RangeImageSample, ScanAugmentation
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.supervised import class_weights, distillation, labelled_cross_entropy
from lidar2pano.pipeline import Segmenter
from lidar2pano.train.options import SegmentationOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import (
    Teacher,
    build_networks,
    device_of,
    fix_norms,
    range_view_card,
    segmentation_scores,
)
from lidar2pano.views import VIEWS, view_of


class Segmentation:
    """Trains a range-view segmenter; scores it per point on the validation split, KNN clean-up included."""

    released = ("segmenter",)

    def __init__(self, recipe: Recipe[SegmentationOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view], recipe.options
        options = recipe.options
        channels = recipe.networks["segmenter"].settings.get("channels", len(PLAIN.mean))
        self.normalise = Normalisation.of(channels)
        vary = ScanAugmentation(
            turn_deg=options.rotation_deg,
            chance=options.augment_probability,
            moves=channels == len(PLAIN.mean),
            remission=options.remission_scale,
            rings=options.ring_drop_probability,
            no_remission=options.remission_drop_probability,
        )
        self.tallest = view_of(options.tallest) if options.tallest else None
        if self.tallest is not None and recipe.training.batch != recipe.training.accumulate:
            raise InputError("options.tallest makes scans of several heights: set training.accumulate=training.batch")
        self.dataset = RangeImageDataset(
            root, recipe.data.train, self.view, options.columns, vary, self.tallest, self.normalise
        )
        self.validation = RangeImageDataset(
            root, recipe.data.val, self.view, tallest=self.tallest, normalise=self.normalise
        )
        self.networks = build_networks(recipe)
        if not options.dropout:
            for module in self.networks["segmenter"].modules():
                if isinstance(module, nn.Dropout2d):
                    module.p = 0.0
        self.weights = class_weights(
            self.dataset.class_counts(),
            options.class_weight_exponent,
            least=options.class_weight_least,
            most=options.class_weight_most,
        )
        self.teacher = Teacher(options.teacher, "salsanext") if options.teacher else None
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: RangeImageSample) -> Iterator[tuple[str, Tensor]]:
        """One update: cross-entropy over labelled pixels, Lovasz-Softmax over the classes present, the teacher."""
        if self.options.fixed_norms:
            fix_norms(self.networks["segmenter"])
        logits = self.networks["segmenter"](batch.lidar).float()
        self.weights = self.weights.to(logits.device)  # once
        entropy = labelled_cross_entropy(logits, batch.labels, 0, self.weights)
        lovasz = lovasz_softmax(logits.softmax(1), batch.labels, ignore=0)
        self.logs = {"cross_entropy": entropy.detach(), "lovasz": lovasz.detach()}
        loss = entropy + self.options.lovasz * lovasz
        if self.teacher is not None:
            gap = distillation(logits, self.teacher(batch.lidar), (batch.lidar != 0).any(1))
            self.logs["distillation"] = gap.detach()
            loss = loss + self.options.distillation * gap
        yield "segmenter", loss

    def validate(self) -> dict[str, float]:
        """MIoU and accuracy per point over up to 500 frames of the validation split, but for unlabelled points."""
        network = self.networks["segmenter"]
        segmenter = Segmenter(network=network, view=self.view, normalise=self.normalise, tallest=self.tallest)

        def pairs() -> Iterator[tuple[Tensor, Tensor]]:
            for index in evenly_spaced(len(self.validation)):
                scan = self.validation.scan(index)
                assert scan.label is not None
                yield segmenter.points(scan, device_of(network)).cpu(), torch.from_numpy(scan.label)

        return segmentation_scores(pairs(), len(SEMANTIC_KITTI), unscored=(0,))

    def preview(self) -> dict[str, np.ndarray]:
        """Ground truth above prediction for a validation scan, (H, W, 3) uint8."""
        sample, network = self.validation[0], self.networks["segmenter"]
        with torch.inference_mode():
            ids = network(sample.lidar[None].to(device_of(network)))[0].argmax(0).cpu()
        pair = [SEMANTIC_KITTI.paint(labels.numpy()) for labels in (sample.labels, ids)]
        return {"segments": np.concatenate(pair)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the segmenter has to know: label set, view, normalisation."""
        return {"labels": SEMANTIC_KITTI.name, **range_view_card(self.view, self.tallest, self.normalise)}
