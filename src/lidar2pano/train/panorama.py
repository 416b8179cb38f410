"""Task: TITAN-pano on scan/camera pairs in panorama coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.frames import IGNORE, evenly_spaced
from lidar2pano.data.panorama_crops import SHIFT_PX, PanoramaDataset, PanoramaSample
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.supervised import class_weights, distillation, labelled_cross_entropy
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.train.options import PanoramaOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import Teacher, build_networks, device_of, load_segmenter, segmentation_scores
from lidar2pano.views import VIEWS


class PanoramaTranslation:
    """Trains a translator: cross-entropy and Lovasz-Softmax in the camera's sector, depth where the LiDAR measured."""

    released = ("translator",)

    def __init__(self, recipe: Recipe[PanoramaOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view].scaled(recipe.scale), recipe.options
        options = recipe.options
        self.dataset = PanoramaDataset(
            root,
            recipe.data.train,
            self.view,
            options.columns,
            shift_px=(self.view.columns - options.columns) // 2 if options.teacher else SHIFT_PX,
            elsewhere=options.elsewhere_probability,
        )
        self.validation = PanoramaDataset(root, recipe.data.val, self.view, options.columns)
        self.networks = build_networks(recipe)
        self.weights = class_weights(
            self.dataset.class_counts()[: len(COMMON15)], options.class_weight_exponent, least=1e-4, most=4.0
        )
        self.teacher = Teacher(options.teacher, "titan-pano") if options.teacher else None
        self.logs: dict[str, float | Tensor] = {}
        if options.segmenter:
            label_points = load_segmenter(options.segmenter)
            for samples in (self.dataset, self.validation):
                samples.predict(label_points, options.segmenter)

    def updates(self, batch: PanoramaSample) -> Iterator[tuple[str, Tensor]]:
        """One update of the translator."""
        inputs = batch.range_image, one_hot_layers(batch.segments, len(SEMANTIC_KITTI))
        logits, depth_m = self.networks["translator"](*inputs)
        logits = logits.float()
        self.weights = self.weights.to(logits.device)  # once
        entropy = labelled_cross_entropy(logits, batch.camera_labels, IGNORE, self.weights)
        lovasz = lovasz_softmax(logits.softmax(1), batch.camera_labels, ignore=IGNORE)
        measured = batch.depth_m > 0
        gap = (depth_code(depth_m) - depth_code(batch.depth_m)).abs()
        depth = (gap * measured).sum() / measured.sum().clamp(min=1)
        self.logs = {"cross_entropy": entropy.detach(), "lovasz": lovasz.detach(), "depth": depth.detach()}
        loss = entropy + self.options.lovasz * lovasz + self.options.depth * depth
        if self.teacher is not None:
            taught, taught_m = self.teacher(*inputs)
            classes = distillation(logits, taught)
            depths = (depth_code(depth_m) - depth_code(taught_m)).abs().mean()
            self.logs |= {"distillation": classes.detach(), "taught_depth": depths.detach()}
            loss = loss + self.options.distillation * (classes + self.options.depth * depths)
        yield "translator", loss

    def predict(self, sample: PanoramaSample) -> Tensor:
        """Class ids (H, W) that the current network predicts for the sample's crop."""
        network = self.networks["translator"]
        device = device_of(network)
        condition = one_hot_layers(sample.segments[None].to(device), len(SEMANTIC_KITTI))
        with torch.inference_mode(), fast_arithmetic(device):
            logits, _ = network(sample.range_image[None].to(device), condition)
        return logits[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes in the camera's sector, on the raster; sky and unknown pixels are not scored."""
        samples = (self.validation[index] for index in evenly_spaced(len(self.validation)))
        pairs = ((self.predict(sample), sample.camera_labels) for sample in samples)
        return segmentation_scores(pairs, len(COMMON15), unscored=(0, COMMON15.id_of("sky")))

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for three validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.validation))):
            sample = self.validation[index]
            rows += [COMMON15.paint(ids.numpy()) for ids in (sample.camera_labels, self.predict(sample))]
        return {"segments": np.concatenate(rows)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the translator has to know: label set and raster."""
        return {"labels": COMMON15.name, "views": {"panorama": self.view.as_dict()}}
