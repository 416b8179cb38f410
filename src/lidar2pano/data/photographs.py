"""Photographs of any data set, all cameras alike, and latents of them by another encoder."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.frames import Frame, SampleIndex
from lidar2pano.data.layouts import frames_of
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError
from lidar2pano.formats.torch_files import read_tensors
from lidar2pano.geometry.rasters import in_unit

FACTOR = 8  # pixels per latent pixel
LATENTS_MEND = "make them by runs/teacher_latents.py"


class PhotographCrop(NamedTuple):
    """A crop of a photograph; after collation every tensor gains a leading B.

    image    (3, S, S) float32 RGB in [-1, 1].
    latents  (C, S/8, S/8) float32 of the teacher; (0, S/8, S/8) without one.
    """

    image: Tensor
    latents: Tensor


class PhotographDataset:
    """Crops of the photographs of some splits: at random for a SampleIndex, in the middle for an int.

    size     S, pixels, a multiple of FACTOR.
    latents  folder of the teacher's latents, <photograph_key>.safetensors; None: there is no teacher.
    """

    def __init__(self, root: Path, splits: tuple[str, ...], size: int, latents: Path | None = None) -> None:
        if size % FACTOR:
            raise InputError(f"crops of {size} pixels: must be a multiple of {FACTOR}")
        self.frames, self.size, self.latents = frames_of(root, splits), size, latents
        self._places = [(number, camera) for number, frame in enumerate(self.frames) for camera in cameras(frame)]

    def __len__(self) -> int:
        """Return the number of photographs."""
        return len(self._places)

    def photograph(self, index: int) -> np.ndarray:
        """Return a photograph (h, w, 3) uint8 RGB whose sides are multiples of FACTOR, cut at the right and below."""
        number, camera = self._places[index]
        frame = self.frames[number]
        if camera and isinstance(frame, SurroundFrame):
            image = frame.cameras[camera].image
        else:
            (image,) = frame.require("image")
        rows, columns = (side // FACTOR * FACTOR for side in image.shape[:2])
        return np.ascontiguousarray(image[:rows, :columns])

    def __getitem__(self, key: SampleIndex | int) -> PhotographCrop:
        """Return a crop; InputError where a photograph is smaller than a crop, or the teacher's latents lack."""
        index = key if isinstance(key, int) else key.index
        image = self.photograph(index)
        steps = [(side - self.size) // FACTOR for side in image.shape[:2]]
        if min(steps) < 0:
            name = self.frames.names[self._places[index][0]]
            raise InputError(f"{name}: its photograph is smaller than {self.size} pixels; take smaller crops")
        if isinstance(key, int):
            row, column = (step // 2 for step in steps)
        else:
            row, column = np.random.default_rng(key.seed).integers(np.add(steps, 1)).tolist()
        window = (slice(row * FACTOR, row * FACTOR + self.size), slice(column * FACTOR, column * FACTOR + self.size))
        cells = self.size // FACTOR
        latents = self._latents(image)[:, row : row + cells, column : column + cells]
        return PhotographCrop(as_signed(image[window]), latents.float())

    def _latents(self, image: np.ndarray) -> Tensor:
        """Return the teacher's latents (C, h/8, w/8) of a photograph; (0, h/8, w/8) without a teacher."""
        if self.latents is None:
            return torch.zeros(0, image.shape[0] // FACTOR, image.shape[1] // FACTOR)
        path = self.latents / f"{photograph_key(image)}.safetensors"
        tensors = read_tensors(path, LATENTS_MEND) if path.is_file() else {}
        if "latents" not in tensors:
            raise InputError(f"{path}: no latents of this photograph; {LATENTS_MEND}")
        return tensors["latents"]


def photograph_key(image: np.ndarray) -> str:
    """Return the name of a photograph's file of latents, of its pixels alone."""
    return hashlib.sha256(image.tobytes()).hexdigest()[:24]


def as_signed(image: np.ndarray) -> Tensor:
    """Return an image (h, w, 3) uint8 as (3, h, w) float32 in [-1, 1]."""
    return in_unit(torch.from_numpy(image).movedim(2, 0))


def cameras(frame: Frame) -> tuple[str, ...]:
    """Return the names of a surround frame's rectified cameras; ("",) for its image, or another frame's.

    Of KITTI-360 the image is taken, or all around what is stitched with the fisheye cameras' images.
    """
    names = frame.camera_names if isinstance(frame, SurroundFrame) else ()
    return names or ("",)
