"""What a look is learned from: images with labels, without scans; and scans, without images.

An image is laid on the panorama's raster, as a camera would have taken it that looks ahead from the panorama's origin.
Each scan is segmented and translated once, on its first use, and kept in a file.
"""

from __future__ import annotations

from math import radians, tan
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame, FrameList, SampleIndex, evenly_spaced
from lidar2pano.data.labelled_images import LabelledImage
from lidar2pano.data.panorama_crops import around_camera
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.geometry.camera import camera_in_panorama
from lidar2pano.hardware import Timer
from lidar2pano.pipeline import Pipeline
from lidar2pano.train.options import LookOptions
from lidar2pano.train.painting_frames import painting_file
from lidar2pano.views import View


class LookSample(NamedTuple):
    """A crop of a scene and one of an image, which have nothing to do with each other; collation adds a leading B.

    segments  (16, H, W) float16 probabilities;  depth_m (H, W) float32;  channels (5, H, W) float32, of which only
              validity (0 or 1 in place of the range) and remission are filled.
    image     (3, 2H, 2W) float32 in [-1, 1]: the image;  valid (2H, 2W) bool: where it is.
    labels    (H, W) int64 ids of COMMON15 of the image, IGNORE where not known.
    """

    segments: Tensor
    depth_m: Tensor
    channels: Tensor
    image: Tensor
    valid: Tensor
    labels: Tensor


class LookSamples:
    """A sample for every image, each with a random crop of a random scene.

    frames    images without scans are the images, all others the scenes, of which options.scenes are used.
    pipeline  segments and translates the scenes;  made_by: see `painting_frames.made_by`.
    Raises InputError where there are no images or no scenes.
    """

    def __init__(self, frames: FrameList[Frame], pipeline: Pipeline, options: LookOptions, made_by: str) -> None:
        self.pipeline, self.options, self._made_by = pipeline, options, made_by
        alone = [isinstance(frame, LabelledImage) for frame in frames]
        self.images = [frame for frame, image in zip(frames, alone, strict=True) if image]
        scenes = [frame for frame, image in zip(frames, alone, strict=True) if not image]
        if not self.images or not scenes:
            what, where = ("scans", "SCANS:all") if self.images else ("images without scans", "IMAGES:train")
            raise InputError(f"a look needs images and scans, and there are no {what}; add them to data.train: {where}")
        self.scenes = [scenes[index] for index in evenly_spaced(len(scenes), options.scenes)]

    def __len__(self) -> int:
        """Number of images."""
        return len(self.images)

    def __getitem__(self, at: SampleIndex | int) -> LookSample:
        """A sample, cropped and mirrored by the seed of a SampleIndex; for an int the middle of that image."""
        index, seed = (at, at) if isinstance(at, int) else (at.index, at.seed)
        generator = np.random.default_rng(seed)
        scene = self._scene(int(generator.integers(len(self.scenes))), generator)
        image = self._image(index, None if isinstance(at, int) else generator)
        return LookSample(*scene, *image)

    def _scene(self, index: int, generator: np.random.Generator) -> tuple[Tensor, ...]:
        kept = self.kept(index)
        height, width = kept["depth_m"].shape
        columns = (int(generator.integers(width)) + torch.arange(self.options.columns)) % width
        if generator.random() < 0.5:
            columns = columns.flip(0)
        channels = torch.zeros(5, height, len(columns))
        channels[0], channels[4] = kept["valid"][:, columns], kept["remission"][:, columns]
        return kept["segments"][..., columns], kept["depth_m"][:, columns].float(), channels

    def kept(self, index: int) -> dict[str, Tensor]:
        """What is made of a scene, from its file; the first use writes it."""
        frame = self.scenes[index]
        file = painting_file(frame, self.options.cache, f"{self._made_by} scene")
        if not file.is_file():
            found = self.pipeline.translate(frame.scan, Timer(self.pipeline.device))
            made = {
                "segments": found.logits[0].float().softmax(0).half(),
                "depth_m": found.depth_m[0].half(),
                "valid": found.channels[0, 0] > 0,
                "remission": found.channels[0, 4].half(),
            }
            contiguous = {name: value.contiguous() for name, value in made.items()}
            write_whole(file, lambda beside: save_file(contiguous, beside), "options.cache")
        return load_file(file)

    def _image(self, index: int, generator: np.random.Generator | None) -> tuple[Tensor, ...]:
        frame = self.images[index]
        pixels, ids = frame.require("image", "camera_labels")
        camera = level_camera((pixels.shape[1], pixels.shape[0]), self.options.field_of_view_deg, self.pipeline.view)
        around = self.pipeline.view
        spare = 0
        if generator is not None:
            sector = around.columns * self.options.field_of_view_deg / 360
            spare = max(round(sector) - self.options.columns, 0)
        window = around_camera(around, camera, self.options.columns + spare)
        shift = 0 if generator is None else int(generator.integers(spare + 1))
        window = window.window(shift, self.options.columns)
        lookup = camera_in_panorama(window.scaled(2), camera)
        image = lookup.linear(torch.from_numpy(pixels).movedim(2, 0).float()) / 127.5 - 1
        labels = camera_in_panorama(window, camera).nearest(torch.from_numpy(CITYSCAPES_TO_COMMON15[ids]), IGNORE)
        parts = (image, lookup.valid, labels.long())
        mirror = generator is not None and generator.random() < 0.5
        return tuple(part.flip(-1) for part in parts) if mirror else parts


def level_camera(size: tuple[int, int], field_of_view_deg: float, view: View) -> Calibration:
    """A pinhole camera at the origin of a view that looks ahead along the horizon.

    size  (width, height) in pixels;  field_of_view_deg: the horizontal one, of the whole width. The principal point is
    the image's middle.
    """
    width, height = size
    focal = width / 2 / tan(radians(field_of_view_deg) / 2)
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # x right, y down, z ahead
    T[:3, 3] = -T[:3, :3] @ np.array(view.origin)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Calibration(K=K, T_camera_lidar=T, size=size)
