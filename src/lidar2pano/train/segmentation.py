"""The range-view segmenter SalsaNext on labelled scans: options, task and recipes.

Cross-entropy with class weights, plus Lovasz-Softmax. Released families (runs/release.sh) learn from real and simulated
frames together: the street world's towns join with `--set data.train=train,WORLD:all`. They show rare classes and all
directions, real frames how things look. A split named twice counts twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
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
from lidar2pano.train.recipe import (
    NO_LIMIT,
    Data,
    Network,
    Optimizer,
    Recipe,
    TaskOptions,
    Training,
    on_two_cores,
    vary,
    with_optimizers,
)
from lidar2pano.train.task import (
    Teacher,
    build_networks,
    device_of,
    label_preview,
    range_view_card,
    segmentation_scores,
)
from lidar2pano.views import VIEWS, view_of


@dataclass(frozen=True, kw_only=True)
class SegmentationOptions(TaskOptions):
    """A range-view segmenter.

    columns                width of the azimuth crop; 0: all of the view.
    rotation_deg           largest rotation about the vertical axis, either way.
    augment_probability    of each of shifting, rotating and dropping points.
    remission_scale        largest relative change of a scan's remission.
    ring_drop_probability  of leaving out up to three quarters of the beams.
    remission_drop_probability  of a scan without remission.
    remission_octaves      of half of the scans: largest change of remission's level, as of another make of sensor.
    mix_probability        of a half-turn and things of another scan (PolarMix).
    place_probability      of each of a sensor standing higher or lower, and leaning.
    lovasz                 weight of Lovasz-Softmax beside the cross-entropy.
    class_weight_exponent,
    class_weight_least,
    class_weight_most      class weights in the cross-entropy are (share of the points, at least `least`) ** -exponent,
                           divided by their mean, at most `most`.
    dropout                whether the network's dropout is on;  fixed_norms: whether norms keep their statistics.
    tallest                name of the view as far as which rows are added for scans that go beyond the recipe's view
                           (geometry.projection.fitted_view); "": none are.
    teacher, distillation  weight file of a segmenter whose predictions are learned beside the labels (knowledge
                           distillation), "": none;  weight of that loss.
    """

    task = "segmentation"
    columns: int = 1024
    rotation_deg: float = 180.0
    augment_probability: float = 0.5
    remission_scale: float = 0.0
    ring_drop_probability: float = 0.0
    remission_drop_probability: float = 0.0
    remission_octaves: float = 0.0
    mix_probability: float = 0.0
    place_probability: float = 0.0
    lovasz: float = 1.0
    class_weight_exponent: float = 0.5
    class_weight_least: float = 1e-5
    class_weight_most: float = 6.0
    dropout: bool = True
    fixed_norms: bool = False
    tallest: str = ""
    teacher: str = ""
    distillation: float = 2.0


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
            sensors=options.remission_octaves,
            mixed=options.mix_probability,
            places=options.place_probability,
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
        for part in self.networks["segmenter"].modules() if self.options.fixed_norms else ():
            if isinstance(part, nn.BatchNorm2d):
                part.eval()  # it keeps its statistics
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
        return label_preview(SEMANTIC_KITTI, [(sample.labels, ids)])

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Label set, view, normalisation."""
        return {"labels": SEMANTIC_KITTI.name, **range_view_card(self.view, self.tallest, self.normalise)}


def salsanext(channels: int = 5) -> Recipe[SegmentationOptions]:
    """SalsaNext on LiDAR labels: cross-entropy with class weights, and Lovasz-Softmax. 6 channels: with roughness."""
    optimizer = Optimizer(rate=3e-3, weight_decay=1e-2, warmup=50, clip=5.0)
    settings = {"classes": 20, "channels": channels}
    return Recipe(
        view="hdl64e",
        networks={"segmenter": Network(model="salsanext", settings=settings, optimizer=optimizer)},
        options=SegmentationOptions(),
        training=Training(steps=20_000, batch=2),
    )


def salsanext_mini() -> Recipe:
    """SalsaNext on all labelled scans of a small data set, in some minutes of two CPU cores.

    Streets run along x in so small a set, and little time is left for rare classes.
    """
    recipe = vary(salsanext(), options={"rotation_deg": 20.0, "class_weight_exponent": 0.3})
    return replace(on_two_cores(recipe, minutes=22.0, batch=2), data=Data(train=("train", "labelled")))


def salsanext_published() -> Recipe[SegmentationOptions]:
    """SalsaNext with its published schedule: 150 epochs, batch 24, SGD 0.01 with momentum 0.9, times 0.99 an epoch.

    Cortinhal, Tzelepis, Aksoy 2020, and salsanext.yml of its code, whose first epoch warms up (here the 797 steps of
    SemanticKITTI's 19,130 scans). Whole range images; class weights 1 / share, as there with shares of at least 0.001.
    """
    optimizer = Optimizer(
        algorithm="sgd", rate=0.01, betas=(0.9, 0.0), weight_decay=1e-4, schedule="exponential", final=0.99**150,
        warmup=797,
    )  # fmt: skip
    settings = {"classes": 20, "channels": 5}
    return Recipe(
        view="hdl64e",
        networks={"segmenter": Network(model="salsanext", settings=settings, optimizer=optimizer)},
        options=SegmentationOptions(
            columns=0, class_weight_exponent=1.0, class_weight_least=1e-3, class_weight_most=1e3
        ),
        training=Training(steps=NO_LIMIT, epochs=150, batch=24, accumulate=2, ema=0.0),
    )


def release_segmenter() -> Recipe[SegmentationOptions]:
    """SalsaNext with roughness as an input; without dropout, since it lowers scores in short runs.

    Some scans have fewer beams or no remission.
    """
    augmentation = {"rotation_deg": 20.0, "augment_probability": 0.3, "ring_drop_probability": 0.3}
    remission = {"remission_scale": 0.3, "remission_drop_probability": 0.2}
    options = {**augmentation, **remission, "class_weight_exponent": 0.3, "dropout": False}
    recipe = with_optimizers(vary(salsanext(channels=6), options=options), rate=2e-3)
    return replace(recipe, training=replace(recipe.training, batch=16, workers=12))


def fast_segmenter() -> Recipe:
    """`release_segmenter` with less than half of the arithmetic: narrower, taught by a wide one (options.teacher)."""
    return vary(release_segmenter(), segmenter={"widths": (32, 48, 64, 128)}, options={"rotation_deg": 180.0})


RECIPES: dict[str, Callable[[], Recipe]] = {
    "salsanext": salsanext,
    "salsanext-mini": salsanext_mini,
    "salsanext-published": salsanext_published,
    "release-segmenter": release_segmenter,
    "release-segmenter-mini": lambda: on_two_cores(release_segmenter(), minutes=40, batch=2, ema=0.997),
    "fast-segmenter": fast_segmenter,
    "fast-segmenter-mini": lambda: on_two_cores(fast_segmenter(), minutes=26, batch=2, ema=0.99),
}
