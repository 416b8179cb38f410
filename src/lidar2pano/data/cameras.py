"""Samples for the camera's segmenter: pictures and their class ids, at random sizes, places and colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageEnhance
from torch import Tensor

from lidar2pano.data.sequences import UNSURE, SampleIndex, frames_of
from lidar2pano.errors import InputError

BEYOND = (124, 116, 104)  # RGB beyond a picture's border: ImageNet's mean, which normalisation makes zero


class PictureSample(NamedTuple):
    """A picture and what is in it; after collation every tensor gains a leading B.

    image   (3, H, W) uint8 RGB.
    labels  (H, W) int64 ids of CITYSCAPES, UNSURE where nobody knows or beyond the picture.
    name    "seq/frame".
    """

    image: Tensor
    labels: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Looks:
    """How pictures are augmented; half of them are mirrored, too.

    crop    (rows, columns) of the samples.
    scale   smallest and largest factor by which a picture is resized before it is cropped, drawn evenly.
    jitter  by how much brightness, contrast and saturation, in this order, are made more or less: factors in
            [1 - jitter, 1 + jitter].
    """

    crop: tuple[int, int]
    scale: tuple[float, float] = (0.5, 2.0)
    jitter: float = 0.25


class PictureSamples:
    """Pictures of some splits with the teacher's classes; augmented when drawn with a seed, plain when indexed."""

    def __init__(self, root: Path, splits: tuple[str, ...], looks: Looks) -> None:
        self.frames = frames_of(root, splits)
        self.looks = looks

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Read a frame: its picture (h, w, 3) uint8 RGB and class ids (h, w) uint8.

        InputError where their sizes differ, and where one is missing or damaged.
        """
        frame = self.frames[index]
        image, ids = frame.image(), frame.camera_labels()
        if image.shape[:2] != ids.shape:
            raise InputError(
                f"{frame.folder / 'camera_labels' / frame.stem}.png: is {ids.shape[1]}x{ids.shape[0]} and its image "
                f"{image.shape[1]}x{image.shape[0]}; label the image anew"
            )
        return image, ids

    def __getitem__(self, draw: SampleIndex | int) -> PictureSample:
        """Sample: of the size `looks.crop`, augmented by a SampleIndex's seed, or the whole image for an int."""
        if isinstance(draw, int):
            return _sample(*self.pair(draw), self.frames[draw].name)
        generator = np.random.default_rng(draw.seed)
        image, ids = varied(*self.pair(draw.index), self.looks, generator)
        return _sample(image, ids, self.frames[draw.index].name)


def varied(
    image: np.ndarray, ids: np.ndarray, looks: Looks, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A picture (h, w, 3) uint8 and its ids (h, w) uint8: resized, cropped or filled up, mirrored, recoloured."""
    rows, columns = looks.crop
    factor = generator.uniform(*looks.scale)
    size = (max(round(image.shape[1] * factor), 1), max(round(image.shape[0] * factor), 1))
    top, left = (
        int(generator.integers(min(0, have - want), max(0, have - want) + 1))
        for have, want in ((size[1], rows), (size[0], columns))
    )
    window = (left, top, left + columns, top + rows)
    picture = _cut(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), window, BEYOND)
    labels = _cut(Image.fromarray(ids).resize(size, Image.Resampling.NEAREST), window, UNSURE)
    for enhance in (ImageEnhance.Brightness, ImageEnhance.Contrast, ImageEnhance.Color):
        picture = enhance(picture).enhance(generator.uniform(1 - looks.jitter, 1 + looks.jitter))
    step = -1 if generator.random() < 0.5 else 1
    return np.array(picture)[:, ::step], np.array(labels)[:, ::step]


def _cut(picture: Image.Image, window: tuple[int, int, int, int], beyond: int | tuple[int, int, int]) -> Image.Image:
    """The window (left, top, right, bottom) of a picture, with the colour `beyond` where it sticks out."""
    left, top, right, bottom = window
    cut = Image.new(picture.mode, (right - left, bottom - top), beyond)
    cut.paste(picture, (-left, -top))
    return cut


def _sample(image: np.ndarray, ids: np.ndarray, name: str) -> PictureSample:
    return PictureSample(
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))), torch.from_numpy(ids.astype(np.int64)), name
    )
