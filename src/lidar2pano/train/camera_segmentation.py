"""The camera's segmenter SD-Net, on images with a teacher's labels: samples, options, task and recipes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageEnhance
from torch import Tensor

from lidar2pano.data.frames import IGNORE, SampleIndex, evenly_spaced
from lidar2pano.data.layouts import frames_of
from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.supervised import labelled_cross_entropy
from lidar2pano.models.camera_teachers import CameraSegmenter, ImageNormalisation
from lidar2pano.train.recipe import (
    Network,
    Optimizer,
    Recipe,
    TaskOptions,
    Training,
    check_range,
    on_two_cores,
    vary,
    with_optimizers,
)
from lidar2pano.train.task import build_networks, segmentation_scores

PADDING_RGB = (124, 116, 104)  # beyond an image's border: ImageNet's mean, zero after normalisation


class CameraImageSample(NamedTuple):
    """An image and its labels; after collation every tensor gains a leading B.

    image   (3, H, W) uint8 RGB.
    labels  (H, W) int64 ids of CITYSCAPES, IGNORE if unknown or beyond the image.
    """

    image: Tensor
    labels: Tensor


@dataclass(frozen=True, kw_only=True)
class CameraSegmentationOptions(TaskOptions):
    """A camera segmenter (SD-Net).

    rows, columns         size of the crops, pixels;  scale_min, scale_max: range of the random resizing before.
    colour_jitter         brightness, contrast and saturation, in this order, change by factors in [1 - it, 1 + it].
    lovasz                weight of Lovasz-Softmax of the joint output.
    auxiliary, per_scale  weights of the cross-entropies of OCR's first output and of every scale by itself.
    """

    task = "camera-segmentation"
    SIZES = ("rows", "columns")
    rows: int = 1024
    columns: int = 2048
    scale_min: float = 0.5
    scale_max: float = 2.0
    colour_jitter: float = 0.25
    lovasz: float = 1.0
    auxiliary: float = 0.4
    per_scale: float = 0.05

    def __post_init__(self) -> None:
        """Refuse impossible sizes, beside the values that TaskOptions refuses (InputError)."""
        super().__post_init__()
        check_range("options", 0.01, self.scale_max, scale_min=self.scale_min)
        check_range("options", self.scale_min, 16, scale_max=self.scale_max)
        check_range("options", 0, 1, colour_jitter=self.colour_jitter)


class CameraImageDataset:
    """Images of some splits with their labels; augmented when indexed by a SampleIndex, plain by an int."""

    def __init__(self, root: Path, splits: tuple[str, ...], options: CameraSegmentationOptions) -> None:
        self.frames, self.options = frames_of(root, splits), options

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a frame's image (h, w, 3) uint8 RGB and labels (h, w) uint8.

        InputError if their sizes differ, and if one is missing or damaged.
        """
        image, labels = self.frames[index].require("image", "camera_labels")
        return image, labels

    def __getitem__(self, index: SampleIndex | int) -> CameraImageSample:
        """Return a sample: a crop augmented by a SampleIndex's seed, or the whole image for an int."""
        if isinstance(index, int):
            return _sample(*self.pair(index))
        return _sample(*augmented(*self.pair(index.index), self.options, np.random.default_rng(index.seed)))


def augmented(
    image: np.ndarray, ids: np.ndarray, options: CameraSegmentationOptions, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return an image (h, w, 3) uint8 and its ids (h, w) uint8: resized, cropped or padded, recoloured.

    Half of them are mirrored, too.
    """
    rows, columns, jitter = options.rows, options.columns, options.colour_jitter
    factor = generator.uniform(options.scale_min, options.scale_max)
    size = (max(round(image.shape[1] * factor), 1), max(round(image.shape[0] * factor), 1))
    top, left = (
        int(generator.integers(min(0, have - want), max(0, have - want) + 1))
        for have, want in ((size[1], rows), (size[0], columns))
    )
    window = (left, top, left + columns, top + rows)
    crop = _cut(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), window, PADDING_RGB)
    labels = _cut(Image.fromarray(ids).resize(size, Image.Resampling.NEAREST), window, IGNORE)
    for enhance in (ImageEnhance.Brightness, ImageEnhance.Contrast, ImageEnhance.Color):
        crop = enhance(crop).enhance(generator.uniform(1 - jitter, 1 + jitter))
    step = -1 if generator.random() < 0.5 else 1
    return np.array(crop)[:, ::step], np.array(labels)[:, ::step]


def _cut(image: Image.Image, window: tuple[int, int, int, int], padding: int | tuple[int, int, int]) -> Image.Image:
    """Return the window (left, top, right, bottom) of an image, padded beyond its border."""
    left, top, right, bottom = window
    cut = Image.new(image.mode, (right - left, bottom - top), padding)
    cut.paste(image, (-left, -top))
    return cut


def _sample(image: np.ndarray, ids: np.ndarray) -> CameraImageSample:
    pixels = np.ascontiguousarray(image.transpose(2, 0, 1))
    return CameraImageSample(torch.from_numpy(pixels), torch.from_numpy(ids.astype(np.int64)))


class CameraSegmentation:
    """Trains SD-Net as its authors do, on the joint and auxiliary outputs and, with a small weight, on each scale's.

    Pixels without a sure label are ignored.
    """

    released = ("camera",)

    def __init__(self, recipe: Recipe[CameraSegmentationOptions], root: Path) -> None:
        if recipe.training.batch <= recipe.training.accumulate:
            raise InputError(
                "training.batch is one image at a time, of whose mean no norm can be taken; set it to twice"
                " training.accumulate or more"
            )
        self.options = recipe.options
        self.dataset = CameraImageDataset(root, recipe.data.train, recipe.options)
        self.validation = CameraImageDataset(root, recipe.data.val, recipe.options)
        self.networks = build_networks(recipe)
        self.normalise = ImageNormalisation()
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: CameraImageSample) -> Iterator[tuple[str, Tensor]]:
        """One update: cross-entropy of all outputs, and Lovasz-Softmax of the joint one."""
        options = self.options
        images = self.normalise(batch.image).contiguous(memory_format=torch.channels_last)
        outputs = self.networks["camera"](images)
        entropy = labelled_cross_entropy(outputs.joint, batch.labels, IGNORE)
        loss = entropy + options.auxiliary * labelled_cross_entropy(outputs.auxiliary, batch.labels, IGNORE)
        for logits in outputs.each if options.per_scale else ():
            loss = loss + options.per_scale * labelled_cross_entropy(logits, batch.labels, IGNORE)
        self.logs = {"cross_entropy": entropy.detach()}
        if options.lovasz:
            lovasz = lovasz_softmax(outputs.joint.float().softmax(1), batch.labels, ignore=IGNORE)
            self.logs["lovasz"] = lovasz.detach()
            loss = loss + options.lovasz * lovasz
        yield "camera", loss

    def predict(self, image: np.ndarray) -> Tensor:
        """Class ids (h, w) of a whole image (h, w, 3) uint8, at the network's scales."""
        segmenter = CameraSegmenter(network=self.networks["camera"], normalise=self.normalise)
        return segmenter.probabilities(image).argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the classes in labels or predictions of the split, and the accuracy of pixels.

        Whole images; pixels without a sure label are not scored.
        """
        pairs = (self.validation.pair(index) for index in evenly_spaced(len(self.validation)))
        return segmentation_scores(((self.predict(image), ids) for image, ids in pairs), CITYSCAPES)

    def preview(self) -> dict[str, np.ndarray]:
        """Image, teacher's classes and the network's, one above the other, for two validation frames; uint8 RGB."""
        previews = {}
        for index in range(min(2, len(self.validation))):
            image, ids = self.validation.pair(index)
            name = self.validation.frames[index].name.replace("/", "-")
            painted = [CITYSCAPES.paint(labels) for labels in (ids, self.predict(image).numpy())]
            previews[f"camera-{name}"] = np.concatenate([image, *painted])
        return previews

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Label set and normalisation."""
        return {"labels": CITYSCAPES.name, "normalisation": self.normalise.as_dict()}


def sdnet() -> Recipe[CameraSegmentationOptions]:
    """SD-Net with the published settings (Tao et al. 2020, section 4; scripts/train_cityscapes.yml as far as known.

    Two scales, crops of 1024 x 2048, one a GPU on eight GPUs, 0.4 of the auxiliary loss, 0.05 of each scale's own.
    Instead of SGD, region mutual information and class-uniform sampling: AdamW, Lovasz-Softmax, every image once
    an epoch. For KITTI's images set options.rows=352 and options.columns=1216.
    """
    width = {"width": 48, "stem": 64, "blocks": 4, "modules": (1, 4, 3), "context": 512}
    optimizer = Optimizer(rate=5e-4, weight_decay=1e-2, warmup=1000, clip=5.0)
    settings = {"classes": 19, "scales": (0.5, 1.0), **width}
    return Recipe(
        view="panorama",  # not used: the task reads no scan
        networks={"camera": Network(model="sdnet", settings=settings, optimizer=optimizer)},
        options=CameraSegmentationOptions(),
        training=Training(steps=65_000, batch=8),
    )


def sdnet_mini() -> Recipe[CameraSegmentationOptions]:
    """A narrow SD-Net for some minutes of two CPU cores."""
    crops = {"rows": 256, "columns": 512, "scale_min": 0.7, "scale_max": 1.4}
    narrow = {"width": 16, "stem": 24, "blocks": 2, "modules": (1, 1, 1), "context": 96}
    recipe = vary(with_optimizers(sdnet(), rate=2e-3, warmup=30), options=crops, camera=narrow)
    return on_two_cores(recipe, minutes=10.0, batch=4)


RECIPES: dict[str, Callable[[], Recipe]] = {"sdnet": sdnet, "sdnet-mini": sdnet_mini}
