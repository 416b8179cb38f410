"""Frames to paint: segments and depth that the released networks make of a scan, and the image that belongs to it.

Each frame is segmented and translated once, on its first use, and kept in a file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple, Self, cast

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from lidar2pano.bounded_files import sha256_of
from lidar2pano.data.frames import IGNORE, Frame, SampleIndex, evenly_spaced
from lidar2pano.data.panorama_crops import PanoramaDataset, PanoramaWindow
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.torch_files import read_tensors
from lidar2pano.geometry.rasters import in_unit
from lidar2pano.hardware import Timer
from lidar2pano.labels import COMMON15
from lidar2pano.models.scene_painter import ScenePainter
from lidar2pano.pipeline import Pipeline
from lidar2pano.train.painter_recipes import ScenePaintingOptions
from lidar2pano.views import View

NOT_FLIPPED = ("look", "tone", "class_tones", "class_means")
SCORED_PIXELS = 30  # known pixels of a class in a frame, of every 64th; fewer say nothing about its tone
MEAN_OF = 48  # frames at most of a look, evenly spaced, for its mean colours
FORM = 8  # raised when the files of the same frames hold something else
MARGIN = 48  # columns of a camera's sector that are kept on each side beyond those of a crop


class PaintingSample(NamedTuple):
    """N crops, of which the first is real where real frames are; after collation with a leading B, see `flat`.

    segments  (N, 16, H, W) float16 probabilities;  depth_m (N, H, W) float32;  channels (N, 5, H, W) float32, of which
              only validity (0 or 1 in place of the range) and remission are filled.
    labels    (N, H, W) int64 ids of COMMON15, IGNORE where not known.
    image     (N, 3, 2H, 2W) float32 in [-1, 1];  valid (N, 2H, 2W) bool: where it is known.
    look      (N,) int64: number of the look;  tone (N, 3) float32: how much brighter than the mean of its look.
    openings     (N, H, W) float32: share of each pixel that is a window or a door, NaN where not known.
    class_tones  (N, 16, 3) float32: likewise each class; 0 where the frame does not show it.
    class_means  (N, 16, 3) float32: mean colour of each class in the look; NaN for the sky and where there is none.
    """

    segments: Tensor
    depth_m: Tensor
    channels: Tensor
    labels: Tensor
    image: Tensor
    valid: Tensor
    look: Tensor
    tone: Tensor
    openings: Tensor
    class_tones: Tensor
    class_means: Tensor

    def flat(self) -> Self:
        """Join the first two dimensions, batch and crops."""
        return type(self)(*(part.flatten(0, 1) for part in self))


class PaintingFrames:
    """Frames of some splits: crops of real and simulated frames; which share is which, and the rest, say the options.

    pipeline  segments and translates; frames are sorted into its painter's looks by their world.json.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        pipeline: Pipeline,
        options: ScenePaintingOptions,
    ) -> None:
        painter = cast("ScenePainter", pipeline.painter)
        looks, own = painter.looks, options.look or painter.look
        self.pipeline, self.options = pipeline, options
        self._made_by = made_by(pipeline.view, options.translator, options.segmenter)
        margin = (pipeline.view.columns - options.columns) // 2 if options.elsewhere_probability else MARGIN
        self.crops = PanoramaDataset(root, splits, pipeline.view, options.columns, image=True, shift_px=margin)
        simulated = [look_of(frame) for frame in self.crops.frames]
        for frame, look in zip(self.crops.frames, simulated, strict=True):
            if (look or own) not in looks:
                raise InputError(f"{frame.name}: its look {look or own!r} is none of {', '.join(looks)}")
        self.look = [looks.index(look or own) for look in simulated]
        groups = [
            [n for n, look in enumerate(simulated) if bool(look) == is_simulated] for is_simulated in (False, True)
        ]
        self.groups = [group for group in groups if group]
        self._means: dict[int, Tensor] = {}

    def __len__(self) -> int:
        """Number of real frames or, where there are none, of simulated ones: each is used once in an epoch."""
        return len(self.groups[0])

    def __getitem__(self, at: SampleIndex | int) -> PaintingSample:
        """A sample, cropped and mirrored by the seed of a SampleIndex; for an int the middle of that frame."""
        if isinstance(at, int):
            return self._joined([self._crop(self.groups[0][at], None)])
        generator = np.random.default_rng(at.seed)
        chosen = [self.groups[0][at.index]]
        if len(self.groups) > 1:
            group = self.groups[generator.random() < self.options.simulated_probability]
            chosen.append(group[generator.integers(len(group))])
        return self._joined([self._crop(index, generator) for index in chosen])

    @staticmethod
    def _joined(samples: list[PaintingSample]) -> PaintingSample:
        return PaintingSample(*(torch.stack(parts) for parts in zip(*samples, strict=True)))

    def _crop(self, index: int, generator: np.random.Generator | None) -> PaintingSample:
        kept, columns = self.kept(index), self.options.columns
        start = self._start(kept["seen"], generator)
        coarse, fine = slice(start, start + columns), slice(2 * start, 2 * (start + columns))
        channels = torch.zeros(5, len(kept["valid"]), columns)
        channels[0], channels[4] = kept["valid"][:, coarse], kept["remission"][:, coarse]
        tone, class_tones = self._tones(index)
        sample = PaintingSample(
            segments=kept["segments"][..., coarse],
            depth_m=kept["depth_m"][:, coarse].float(),
            channels=channels,
            labels=kept["camera"][:, coarse].long(),
            image=in_unit(kept["colour"][..., fine]),
            valid=kept["seen"][:, fine],
            look=torch.tensor(self.look[index]),
            tone=tone,
            openings=kept["openings"][:, coarse].float(),
            class_tones=class_tones,
            class_means=self._means[self.look[index]][: len(COMMON15)],
        )
        if generator is None or generator.random() < 0.5:
            return sample
        flipped = {name: getattr(sample, name).flip(-1) for name in sample._fields if name not in NOT_FLIPPED}
        return sample._replace(**flipped)

    def _start(self, valid: Tensor, generator: np.random.Generator | None) -> int:
        """A crop's first column: where a camera looks, but for a share anywhere; for None in the middle of that."""
        columns = self.options.columns
        spare = valid.shape[1] // 2 - columns
        first, last = valid.any(0).nonzero()[[0, -1], 0].tolist()
        middle = min(max((first + last) // 4 - columns // 2, 0), spare)
        if generator is None:
            return middle
        if generator.random() < self.options.elsewhere_probability:
            return int(generator.integers(spare + 1))
        least = min(max(first // 2 - MARGIN, 0), middle)
        most = max(min(last // 2 + MARGIN - columns, spare), middle)
        return int(generator.integers(least, most + 1))

    def kept(self, index: int) -> dict[str, Tensor]:
        """What is made of a frame, from its file; the first use writes it."""
        return kept_tensors(self._file(index), lambda: self._made(index))

    def _file(self, index: int) -> Path:
        return painting_file(self.crops.frames[index], self.options.cache, f"{self._made_by} {self.crops.shift_px}")

    def _made(self, index: int) -> dict[str, Tensor]:
        """Image, segments, depth, validity and remission of a frame in its window, the scene from the scan alone."""
        window, raster = self.crops.window(index), self.pipeline.view
        whole = replace(self.pipeline, view=replace(raster, origin=window.view.origin))
        scene = whole.translate(self.crops.frames[index].scan, Timer(whole.device))
        start = round((raster.left - window.view.left) * raster.columns / (raster.left - raster.right))
        columns = slice(start, start + window.view.columns)
        total, count = colours_of_classes(window)
        kept = {
            "segments": scene.probabilities[0, ..., columns].half(),
            "depth_m": scene.depth_m[0, :, columns].half(),
            "valid": scene.channels[0, 0, :, columns] > 0,
            "remission": scene.channels[0, 4, :, columns].half(),
            "camera": window.camera_labels,
            "colour": window.image,
            "seen": window.valid,
            "openings": window.openings.half(),
            "class_colours": total,
            "class_pixels": count,
        }
        return {name: value.contiguous() for name, value in kept.items()}

    def _tones(self, index: int) -> tuple[Tensor, Tensor]:
        """How much brighter an image is than its classes are on average in its look, (3,), and each class, (16, 3)."""
        look = self.look[index]
        if look not in self._means:
            members = [number for number, member in enumerate(self.look) if member == look]
            sums = [self._sums(members[number]) for number in evenly_spaced(len(members), MEAN_OF)]
            total, count = (torch.stack(part).sum(0) for part in zip(*sums, strict=True))
            self._means[look] = total / count[:, None]
        total, count = self._sums(index)
        excess = (total - self._means[look] * count[:, None]).nan_to_num(0)
        scored = (count >= SCORED_PIXELS)[:, None]
        class_tones = (excess / count.clamp(min=1)[:, None]).where(scored, 0.0)
        return excess.sum(0) / count.sum().clamp(min=1), class_tones[: len(COMMON15)]

    def _sums(self, index: int) -> tuple[Tensor, Tensor]:
        """As `colours_of_classes`: from the frame's file, if it is made; the same numbers from its image, if not."""
        if not self._file(index).is_file():
            return colours_of_classes(self.crops.window(index))
        kept = self.kept(index)
        return kept["class_colours"], kept["class_pixels"]


def colours_of_classes(window: PanoramaWindow) -> tuple[Tensor, Tensor]:
    """Sums of colours (256, 3) in [-1, 1] and numbers of pixels (256,) of each class: every 64th pixel counts."""
    ids = window.camera_labels[1::4, 1::4].long()
    labelled = window.valid[2::8, 2::8] & (ids != IGNORE) & (ids != COMMON15.id_of("sky"))
    colour = in_unit(window.image[:, 2::8, 2::8].movedim(0, 2)[labelled])
    total = torch.zeros(256, 3).index_add_(0, ids[labelled], colour)
    return total, torch.zeros(256).index_add_(0, ids[labelled], torch.ones(len(colour)))


def kept_tensors(file: Path, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """The tensors of a file of a cache; the first use makes it."""
    if not file.is_file():
        made = make()
        write_whole(file, lambda temporary: save_file(made, temporary), "options.cache")
    return read_tensors(file, "remove it, and it is made again")


def painting_file(frame: Frame, cache: str, made_by: str) -> Path:
    """The file that keeps what is made of a frame.

    cache  folder; "": .lidar2pano of the frame's data set;  made_by: what its content depends on beside the frame.
    """
    assert frame.root is not None, "frames of data sets have one"
    root, stem = frame.root.resolve(), frame.name.replace("/", "-")
    key = hashlib.sha256(os.fsencode(f"{made_by} {root}")).hexdigest()[:16]
    folder = Path(cache) if cache else root / ".lidar2pano"
    return folder / "painting" / key / f"{root.name}-{stem}.safetensors"


def made_by(view: View, *weights: str) -> str:
    """What the files of frames depend on, beside the frames: raster and networks, as one hexadecimal number."""
    digest = hashlib.sha256(f"{FORM} {view}".encode())
    for file in weights:
        digest.update(bytes.fromhex(sha256_of(file)))
    return digest.hexdigest()


def look_of(frame: Frame) -> str:
    """The look of a simulated frame; "" for a real one."""
    return _look_of_data_set(frame.root) if frame.root else ""


@cache
def _look_of_data_set(root: Path) -> str:
    """What `look_of` is for all frames of one data set: its world.json is read once, not once per frame."""
    file = root / "world.json"
    return str(read_json(file).get("look", "")) if file.is_file() else ""
