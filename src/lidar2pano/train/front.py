"""Tasks in the paper's setting: front range view in, the camera's perspective segments out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import nll_loss

from lidar2pano.data.cache import PredictedLabels, Predictions, StoredPredictions
from lidar2pano.data.camera_pairs import FrontViewDataset, FrontViewSample, SampleParts
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.labels import COMMON14, SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.train.adversarial import pix2pix_updates, renamed, wasserstein_updates
from lidar2pano.train.options import FrontDepthOptions, FrontOptions, Pix2PixSegmentsOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import (
    build_networks,
    device_of,
    image_size,
    load_segmenter,
    range_view_card,
    segmentation_scores,
)
from lidar2pano.views import VIEWS

TINY = 1e-8  # least probability whose logarithm is taken


class FrontTask:
    """Networks, data, scores and previews that the tasks of this file share; subclasses have `updates`.

    The translator's `size` is that of the image that it predicts.
    """

    released = ("translator",)
    options: Any
    wanted: ClassVar[SampleParts] = SampleParts(labels=True)

    def __init__(self, recipe: Recipe[FrontOptions] | Recipe[Pix2PixSegmentsOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view], recipe.options
        self.networks = build_networks(recipe)
        size = image_size(self.networks["translator"])
        self.dataset = FrontViewDataset(root, recipe.data.train, self.view, size, self.wanted)
        self.validation = FrontViewDataset(root, recipe.data.val, self.view, size, self.wanted)
        self.logs: dict[str, float | Tensor] = {}
        use_predictions(recipe.options, self.dataset, self.validation)

    def output(self, sample: FrontViewSample) -> Any:  # noqa: ANN401 logits, or logits and depths
        """What the current translator gives for one sample, as a batch of one.

        In float32, since instance norms amplify the rounding of bfloat16.
        """
        network = self.networks["translator"]
        device = device_of(network)
        condition = one_hot_layers(sample.segments[None].to(device), len(SEMANTIC_KITTI))
        with torch.inference_mode():
            return network(sample.lidar[None].to(device), condition)

    def predict(self, sample: FrontViewSample) -> Tensor:
        """Class ids (h, w) that the current network predicts for a sample."""
        return self.output(sample)[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image, over up to 500 frames."""
        samples = (self.validation[index] for index in evenly_spaced(len(self.validation)))
        pairs = ((self.predict(sample), sample.camera_labels) for sample in samples)
        return segmentation_scores(pairs, len(COMMON14), unscored=(0,))

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for two validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(2, len(self.validation))):
            sample = self.validation[index]
            rows += [COMMON14.paint(ids.numpy()) for ids in (sample.camera_labels, self.predict(sample))]
        return {"segments": np.concatenate(rows)}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the translator has to know: label set, view, normalisation."""
        return {"labels": COMMON14.name, **range_view_card(self.view)}


def use_predictions(
    options: FrontOptions | Pix2PixSegmentsOptions, training: FrontViewDataset, validation: FrontViewDataset
) -> None:
    """Condition data sets on a segmenter's labels, as the options want it; InputError where there are none."""
    chosen = (training, validation) if options.segments == "predicted" else (validation,)
    if options.segmenter:
        predicted: Predictions = PredictedLabels(load_segmenter(options.segmenter), options.segmenter)
    elif options.segments == "predicted":
        predicted = StoredPredictions()
    else:
        return
    for samples in chosen:
        samples.use(predicted)


class FrontTranslation(FrontTask):
    """Trains TITAN-Net by WGAN-GP and Lovasz-Softmax; class 0 is neither trained nor scored, as in the paper.

    Ablations without one of the inputs are settings of the network.
    """

    options: FrontOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition = one_hot_layers(batch.segments, len(SEMANTIC_KITTI))

        def auxiliary(fake: Tensor) -> Tensor:
            return self.options.lovasz * lovasz_softmax(fake, batch.camera_labels, ignore=0)

        updates = wasserstein_updates(
            lambda: self.networks["translator"](batch.lidar, condition).float().softmax(1),
            self.networks["critic"],
            one_hot_layers(batch.camera_labels, len(COMMON14)),
            condition,
            penalty_weight=self.options.gradient_penalty,
            auxiliary=auxiliary if self.options.lovasz else None,
            logs=self.logs,
        )
        return renamed(updates, "translator")


class FrontDepthTranslation(FrontTask):
    """Trains TITAN-Next: WGAN-GP over classes and depth together, with auxiliary losses on both.

    The depth target is the LiDAR's own, projected into the camera, so it is known at some pixels only: auxiliary loss
    and critic use depths there alone. Auxiliary losses are Lovasz-Softmax and cross-entropy without class 0, and the
    absolute distance of depth codes where depth was measured.
    """

    wanted: ClassVar[SampleParts] = SampleParts(labels=True, depth=True)

    options: FrontDepthOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition, classes = one_hot_layers(batch.segments, len(SEMANTIC_KITTI)), len(COMMON14)
        measured = (batch.depth_m > 0)[:, None].float()
        depth = depth_code(batch.depth_m)[:, None]  # zero where none was measured
        options = self.options

        def forward() -> Tensor:
            logits, depth_m = self.networks["translator"](batch.lidar, condition)
            return torch.cat([logits.float().softmax(1), depth_code(depth_m)[:, None] * measured], 1)

        def auxiliary(fake: Tensor) -> Tensor:
            probabilities = fake[:, :classes]
            lovasz = lovasz_softmax(probabilities, batch.camera_labels, ignore=0)
            entropy = nll_loss(probabilities.clamp(min=TINY).log(), batch.camera_labels, ignore_index=0)
            gap = (fake[:, classes:] - depth).abs().sum() / measured.sum().clamp(min=1)
            self.logs |= {"lovasz": lovasz.detach(), "cross_entropy": entropy.detach(), "depth": gap.detach()}
            parts = [options.lovasz * lovasz, options.cross_entropy * entropy, options.depth * gap]
            return torch.stack(parts).sum()

        updates = wasserstein_updates(
            forward,
            self.networks["critic"],
            torch.cat([one_hot_layers(batch.camera_labels, classes), depth], 1),
            condition,
            penalty_weight=options.gradient_penalty,
            auxiliary=auxiliary,
            logs=self.logs,
        )
        return renamed(updates, "translator")

    def predict_both(self, sample: FrontViewSample) -> tuple[Tensor, Tensor]:
        """Class ids (h, w) and depths (h, w), metres, that the current network predicts for a sample."""
        logits, depth_m = self.output(sample)
        return logits[0].argmax(0).cpu(), depth_m[0].cpu()

    def predict(self, sample: FrontViewSample) -> Tensor:
        """Class ids (h, w) that the current network predicts for a sample."""
        return self.predict_both(sample)[0]

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image; mean relative error of depths that the LiDAR measured."""
        errors: list[float] = []

        def pairs() -> Iterator[tuple[Tensor, Tensor]]:
            for index in evenly_spaced(len(self.validation)):
                sample = self.validation[index]
                ids, depth_m = self.predict_both(sample)
                measured = sample.depth_m > 0
                errors.append(((depth_m - sample.depth_m).abs() / sample.depth_m)[measured].mean().item())
                yield ids, sample.camera_labels

        scores = segmentation_scores(pairs(), len(COMMON14), unscored=(0,))
        return {**scores, "depth_abs_rel": float(np.nanmean(errors))}

    def preview(self) -> dict[str, np.ndarray]:
        """As in FrontTask, and "depth": measured above predicted, near is bright."""
        rows: list[Tensor] = []
        for index in range(min(2, len(self.validation))):
            sample = self.validation[index]
            depths = (sample.depth_m, self.predict_both(sample)[1])
            rows += [(1 - depth_code(depth_m)) * (depth_m > 0) for depth_m in depths]
        grey = (255 * torch.cat(rows)).round().clamp(0, 255).to(torch.uint8)
        return {**super().preview(), "depth": grey[..., None].expand(-1, -1, 3).contiguous().numpy()}


class Pix2PixSegments(FrontTask):
    """Trains Pix2Pix from range view and segments to the camera's segments, one-hot in [-1, 1].

    Every pixel counts, those of class 0 too: Pix2Pix ignores no class.
    """

    options: Pix2PixSegmentsOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The discriminator, then the translator."""
        condition = one_hot_layers(batch.segments, len(SEMANTIC_KITTI))
        updates = pix2pix_updates(
            lambda: self.networks["translator"](batch.lidar, condition).float(),
            self.networks["critic"],
            2 * one_hot_layers(batch.camera_labels, len(COMMON14)) - 1,
            torch.cat([batch.lidar, condition], 1),
            self.options,
            logs=self.logs,
        )
        return renamed(updates, "translator")
