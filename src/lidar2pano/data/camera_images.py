"""CameraImageDataset, for the camera's segmenter: images and their labels, at random sizes, places and colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageEnhance
from torch import Tensor

from lidar2pano.data.frames import IGNORE, SampleIndex
from lidar2pano.data.layouts import frames_of

PADDING_RGB = (124, 116, 104)  # beyond an image's border: ImageNet's mean, zero after normalisation


class CameraImageSample(NamedTuple):
    """An image and its labels; after collation every tensor gains a leading B.

    image   (3, H, W) uint8 RGB.
    labels  (H, W) int64 ids of CITYSCAPES, IGNORE if unknown or beyond the image.
    name    "seq/frame".
    """

    image: Tensor
    labels: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageAugmentation:
    """The augmentation of images; half of them are mirrored, too.

    crop           (rows, columns) of the samples.
    scale          smallest and largest factor by which an image is resized before it is cropped, drawn evenly.
    colour_jitter  by how much brightness, contrast and saturation, in this order, are made more or less: factors in
                   [1 - colour_jitter, 1 + colour_jitter].
    """

    crop: tuple[int, int]
    scale: tuple[float, float] = (0.5, 2.0)
    colour_jitter: float = 0.25


class CameraImageDataset:
    """Images of some splits with their labels; augmented when indexed by a SampleIndex, plain by an int."""

    def __init__(self, root: Path, splits: tuple[str, ...], augmentation: ImageAugmentation) -> None:
        self.frames = frames_of(root, splits)
        self.augmentation = augmentation

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
            return _sample(*self.pair(index), self.frames[index].name)
        generator = np.random.default_rng(index.seed)
        image, labels = augmented(*self.pair(index.index), self.augmentation, generator)
        return _sample(image, labels, self.frames[index.index].name)


def augmented(
    image: np.ndarray, ids: np.ndarray, augmentation: ImageAugmentation, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return an image (h, w, 3) uint8 and its ids (h, w) uint8: resized, cropped or padded, mirrored, recoloured."""
    rows, columns = augmentation.crop
    factor = generator.uniform(*augmentation.scale)
    size = (max(round(image.shape[1] * factor), 1), max(round(image.shape[0] * factor), 1))
    top, left = (
        int(generator.integers(min(0, have - want), max(0, have - want) + 1))
        for have, want in ((size[1], rows), (size[0], columns))
    )
    window = (left, top, left + columns, top + rows)
    crop = _cut(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), window, PADDING_RGB)
    labels = _cut(Image.fromarray(ids).resize(size, Image.Resampling.NEAREST), window, IGNORE)
    for enhance in (ImageEnhance.Brightness, ImageEnhance.Contrast, ImageEnhance.Color):
        crop = enhance(crop).enhance(generator.uniform(1 - augmentation.colour_jitter, 1 + augmentation.colour_jitter))
    step = -1 if generator.random() < 0.5 else 1
    return np.array(crop)[:, ::step], np.array(labels)[:, ::step]


def _cut(image: Image.Image, window: tuple[int, int, int, int], padding: int | tuple[int, int, int]) -> Image.Image:
    """Return the window (left, top, right, bottom) of an image, padded beyond its border."""
    left, top, right, bottom = window
    cut = Image.new(image.mode, (right - left, bottom - top), padding)
    cut.paste(image, (-left, -top))
    return cut


def _sample(image: np.ndarray, ids: np.ndarray, name: str) -> CameraImageSample:
    return CameraImageSample(
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))), torch.from_numpy(ids.astype(np.int64)), name
    )
