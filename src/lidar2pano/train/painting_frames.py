"""Frames to paint: segments and depth that the released networks make of a scan, and the picture that belongs to it.

Each frame is segmented and translated once, on its first draw, and kept in a file.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from lidar2pano.data.moments import read_moment
from lidar2pano.data.sequences import UNSURE, Draw, Frame, frames, located
from lidar2pano.errors import InputError
from lidar2pano.hardware import Timer
from lidar2pano.labels import COMMON15
from lidar2pano.pipeline import Pipeline

MARGIN = 96  # columns of a camera's sector that are held beyond those of a crop


class PaintingSample(NamedTuple):
    """N crops, one of each kind of data; after collation every tensor gains a leading B, which `flat` joins with N.

    segments  (N, 16, H, W) float16 probabilities;  depth_m (N, H, W) float32;  image (N, 5, H, W) float32, of which
              only validity (0 or 1 in place of the range) and remission are filled.
    camera    (N, H, W) int64 ids of COMMON15, UNSURE where not known.
    colour    (N, 3, 2H, 2W) float32 in [-1, 1];  seen (N, 2H, 2W) bool: where it is known.
    look      (N,) int64: number of the look;  tone (N, 3) float32: how much brighter than the mean of its look.
    """

    segments: Tensor
    depth_m: Tensor
    image: Tensor
    camera: Tensor
    colour: Tensor
    seen: Tensor
    look: Tensor
    tone: Tensor

    def flat(self) -> Self:
        """Join the first two dimensions."""
        return type(self)(*(part.flatten(0, 1) for part in self))


class PaintingFrames:
    """Frames of some splits; a sample is a crop of a real frame, of a simulated one, or of each where there are both.

    columns  of a crop on the translator's raster.
    looks    names;  look: that of frames that no simulator made (others: as world.json says).
    cache    folder for what is made of each frame.
    simulated  where there are both: how often the second crop is of a simulated frame and not of a real one as well.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        pipeline: Pipeline,
        *,
        columns: int,
        looks: tuple[str, ...],
        look: str,
        cache: Path,
        simulated: float = 1.0,
    ) -> None:
        self.pipeline, self.columns, self.cache, self.simulated = pipeline, columns, cache, simulated
        self.frames: list[Frame] = []
        self.look: list[int] = []
        for name in splits:
            folder, split = located(root, name)
            found = frames(folder, split)
            own = look_of(folder) or look
            if own not in looks:
                raise InputError(f"{folder}: its look {own!r} is none of the painter's: {', '.join(looks)}")
            self.frames += found
            self.look += [looks.index(own)] * len(found)
        around = [(frame.folder / "pano").is_dir() for frame in self.frames]
        kinds = [[n for n, whole in enumerate(around) if whole == wanted] for wanted in (False, True)]
        self.kinds = [kind for kind in kinds if kind]
        self._means: dict[int, Tensor] = {}

    def __len__(self) -> int:
        """Frames of the first kind: every one of them is drawn in an epoch."""
        return len(self.kinds[0])

    def __getitem__(self, draw: Draw | int) -> PaintingSample:
        """A sample, cropped and mirrored by a Draw's seed; the crop in the middle of frame `draw` for an int."""
        if isinstance(draw, int):
            return self._joined([self._crop(self.kinds[0][draw], None)])
        generator = np.random.default_rng(draw.seed)
        chosen = [self.kinds[0][draw.index]]
        if len(self.kinds) > 1:
            kind = self.kinds[generator.random() < self.simulated]
            chosen.append(kind[generator.integers(len(kind))])
        return self._joined([self._crop(index, generator) for index in chosen])

    @staticmethod
    def _joined(samples: list[PaintingSample]) -> PaintingSample:
        return PaintingSample(*(torch.stack(parts) for parts in zip(*samples, strict=True)))

    def _crop(self, index: int, generator: np.random.Generator | None) -> PaintingSample:
        held = self.held(index)
        spare = held["camera"].shape[1] - self.columns
        start = spare // 2 if generator is None else int(generator.integers(spare + 1))
        coarse, fine = slice(start, start + self.columns), slice(2 * start, 2 * (start + self.columns))
        image = torch.zeros(5, len(held["valid"]), self.columns)
        image[0], image[4] = held["valid"][:, coarse], held["remission"][:, coarse]
        sample = PaintingSample(
            segments=held["segments"][..., coarse],
            depth_m=held["depth_m"][:, coarse].float(),
            image=image,
            camera=held["camera"][:, coarse].long(),
            colour=held["colour"][..., fine].float() / 127.5 - 1,
            seen=held["seen"][:, fine],
            look=torch.tensor(self.look[index]),
            tone=self._tone(index),
        )
        if generator is None or generator.random() < 0.5:
            return sample
        flipped = {name: getattr(sample, name).flip(-1) for name in sample._fields if name not in ("look", "tone")}
        return sample._replace(**flipped)

    def held(self, index: int) -> dict[str, Tensor]:
        """What is made of a frame, from its file, on whose first reading it is made."""
        file = self._file(index)
        if not file.is_file():
            self.cache.mkdir(parents=True, exist_ok=True)
            beside = file.with_suffix(f".{os.getpid()}")
            save_file(self._made(self.frames[index]), beside)
            beside.replace(file)
        return load_file(file)

    def _file(self, index: int) -> Path:
        frame = self.frames[index]
        return self.cache / f"{frame.folder.parents[1].name}-{frame.folder.name}-{frame.stem}.safetensors"

    def _made(self, frame: Frame) -> dict[str, Tensor]:
        """Picture, segments, depth, validity and remission of a frame in its window, the scene from the scan alone."""
        moment = read_moment(frame, self.pipeline.view, MARGIN + self.columns, colour=True)
        view, whole = moment.view, self.pipeline.at(frame.calibration((1, 1)))
        seen = whole.translate(frame.scan(), Timer(whole.device))
        start = round((whole.view.left - view.left) * whole.view.columns / (whole.view.left - whole.view.right))
        window = slice(start, start + view.columns)
        ids = moment.camera[1::4, 1::4].long()
        known = moment.seen[2::8, 2::8] & (ids != UNSURE) & (ids != COMMON15.id_of("sky"))
        colour = moment.colour[:, 2::8, 2::8].movedim(0, 2)[known].float() / 127.5 - 1
        held = {
            "segments": seen.logits[0, ..., window].float().softmax(0).half(),
            "depth_m": seen.depth_m[0, :, window].half(),
            "valid": seen.channels[0, 0, :, window] > 0,
            "remission": seen.channels[0, 4, :, window].half(),
            "camera": moment.camera,
            "colour": moment.colour,
            "seen": moment.seen,
            "class_colours": torch.zeros(256, 3).index_add_(0, ids[known], colour),
            "class_pixels": torch.zeros(256).index_add_(0, ids[known], torch.ones(len(colour))),
        }
        return {name: value.contiguous() for name, value in held.items()}

    def _tone(self, index: int) -> Tensor:
        """How much brighter a picture is than its classes are on average in its look: (3,) in [-1, 1]."""
        look = self.look[index]
        if look not in self._means:
            files = {self._file(number) for number, one in enumerate(self.look) if one == look}
            sums = [self._sums(file) for file in sorted(files) if file.is_file()]
            total, count = (torch.stack(part).sum(0) for part in zip(*sums, strict=True))
            self._means[look] = total / count.clamp(min=1)[:, None]
        total, count = self._sums(self._file(index))
        return (total - self._means[look] * count[:, None]).sum(0) / count.sum().clamp(min=1)

    @staticmethod
    def _sums(file: Path) -> tuple[Tensor, Tensor]:
        with safe_open(file, "pt") as held:
            return held.get_tensor("class_colours"), held.get_tensor("class_pixels")


def look_of(root: Path) -> str:
    """The look of a simulated data set; "" for a real one."""
    file = root / "world.json"
    return str(json.loads(file.read_text(encoding="utf-8")).get("look", "")) if file.is_file() else ""
