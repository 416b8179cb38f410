"""Our translator TITAN-pano on scan/camera pairs in panorama coordinates: options, task and recipes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
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
from lidar2pano.models.titan_pano import with_rows
from lidar2pano.scene.depth import depth_code
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, on_two_cores, vary
from lidar2pano.train.task import Teacher, build_networks, device_of, label_preview, load_segmenter, segmentation_scores
from lidar2pano.views import VIEWS


@dataclass(frozen=True, kw_only=True)
class PanoramaOptions(TaskOptions):
    """TITAN-pano.

    columns                width of the crop around the camera's sector.
    lovasz, depth          weights of Lovasz-Softmax and of the distance of depth codes.
    class_weight_exponent  class weights in the cross-entropy are (share of the pixels) ** -exponent.
    segmenter              weight file whose labels take half of the training samples and all of validation;
                           "": the labels of the data everywhere.
    teacher, distillation  weight file of a translator whose classes and depths are learned beside the ground truth
                           (knowledge distillation), "": none;  weight of that loss.
    elsewhere_probability  with a teacher, of a crop of a real frame from anywhere, also out of the camera's sector.
    remission_octaves      of most samples: largest change of remission's level, as of another make of sensor; with it
                           half of the samples are enlarged (PanoramaDataset).
    building_margin        by how much the losses lower the logits of buildings, so that the network raises them (logit
                           adjustment, Menon et al. 2021): on streets that are new to it, too few are found.
    """

    task = "panorama"
    SIZES = ("columns",)
    columns: int = 576
    lovasz: float = 1.0
    depth: float = 2.0
    class_weight_exponent: float = 0.25
    segmenter: str = ""
    teacher: str = ""
    distillation: float = 2.0
    elsewhere_probability: float = 1.0
    remission_octaves: float = 0.0
    building_margin: float = 0.0


class PanoramaTranslation:
    """Trains a translator: cross-entropy and Lovasz-Softmax in the camera's sector, measured depth elsewhere."""

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
            sensors=options.remission_octaves,
        )
        self.validation = PanoramaDataset(root, recipe.data.val, self.view, options.columns)
        self.networks = build_networks(recipe)
        self.weights = class_weights(
            self.dataset.class_counts()[: len(COMMON15)], options.class_weight_exponent, least=1e-4, most=4.0
        )
        self.margins = torch.zeros(len(COMMON15), 1, 1)
        self.margins[COMMON15.id_of("building")] = options.building_margin
        self.teacher = Teacher(options.teacher, "titan-pano") if options.teacher else None
        self.logs: dict[str, float | Tensor] = {}
        if options.segmenter:
            label_points = load_segmenter(options.segmenter)
            for samples in (self.dataset, self.validation):
                samples.predict(label_points, options.segmenter)

    def updates(self, batch: PanoramaSample) -> Iterator[tuple[str, Tensor]]:
        """One update of the translator."""
        inputs = with_rows(batch.range_image, self.view), one_hot_layers(batch.segments, len(SEMANTIC_KITTI))
        logits, depth_m = self.networks["translator"](*inputs)
        self.weights, self.margins = self.weights.to(logits.device), self.margins.to(logits.device)  # once
        logits = logits.float() - self.margins
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
        """Predict class ids (H, W) of a sample's crop."""
        network = self.networks["translator"]
        device = device_of(network)
        condition = one_hot_layers(sample.segments[None].to(device), len(SEMANTIC_KITTI))
        with torch.inference_mode(), fast_arithmetic(device):
            logits, _ = network(with_rows(sample.range_image[None].to(device), self.view), condition)
        return logits[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes in the camera's sector, on the raster; sky and unknown pixels are not scored."""
        samples = (self.validation[index] for index in evenly_spaced(len(self.validation)))
        pairs = ((self.predict(sample), sample.camera_labels) for sample in samples)
        return segmentation_scores(pairs, len(COMMON15), unscored=(0, COMMON15.id_of("sky")))

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for three validation frames, (H, W, 3) uint8."""
        samples = (self.validation[index] for index in range(min(3, len(self.validation))))
        return label_preview(COMMON15, ((sample.camera_labels, self.predict(sample)) for sample in samples))

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Label set and raster."""
        return {"labels": COMMON15.name, "views": {"panorama": self.view.as_dict()}}


def titan_pano() -> Recipe[PanoramaOptions]:
    """Our translator, trained in panorama coordinates at half the raster."""
    optimizer = Optimizer(rate=2e-3, weight_decay=1e-2, warmup=50, clip=5.0)
    settings = {"classes": 16, "conditions": 20}
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={"translator": Network(model="titan-pano", settings=settings, optimizer=optimizer)},
        options=PanoramaOptions(),
        training=Training(steps=20_000, batch=4),
    )


def release_translator() -> Recipe[PanoramaOptions]:
    """TITAN-pano with half as much weight again on Lovasz-Softmax, and a GPU's batch."""
    recipe = vary(titan_pano(), options={"lovasz": 1.5})
    return replace(recipe, training=replace(recipe.training, batch=16, workers=12))


def fast_translator() -> Recipe:
    """`release_translator` with half of the arithmetic, taught by a wide one."""
    return vary(release_translator(), translator={"widths": (16, 48, 96, 128, 192), "pyramid": 64})


RECIPES: dict[str, Callable[[], Recipe]] = {
    "titan-pano": titan_pano,
    "titan-pano-mini": lambda: on_two_cores(titan_pano(), minutes=24, batch=4),
    "release-translator": release_translator,
    "release-translator-mini": lambda: on_two_cores(release_translator(), minutes=30, batch=4, ema=0.995),
    "fast-translator": fast_translator,
    "fast-translator-mini": lambda: on_two_cores(fast_translator(), minutes=26, batch=4, ema=0.99),
}
