"""Frames to paint: segments and depth that the released networks make of a scan, and the picture that belongs to it.

Each frame is segmented and translated once, on its first draw, and held in memory.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.moments import Moment, read_moment
from lidar2pano.data.sequences import UNSURE, Draw, Frame, frames, located
from lidar2pano.errors import InputError
from lidar2pano.labels import COMMON15
from lidar2pano.pipeline import Pipeline, Stopwatch

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
    """Frames of some splits; a sample holds a crop of a real frame, of a simulated one, or of each where there are both.

    columns  of a crop on the translator's raster.
    looks    names;  look: that of frames that no simulator made (others: as world.json says).
    """

    def __init__(
        self, root: Path, splits: tuple[str, ...], pipeline: Pipeline, columns: int, looks: tuple[str, ...], look: str
    ) -> None:
        self.pipeline, self.columns = pipeline, columns
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
        self._moments: dict[Path, Moment] = {}
        self._held: dict[Path, tuple[Tensor, ...]] = {}
        self._means: dict[int, Tensor] = {}

    def __len__(self) -> int:
        """Frames of the first kind: every one of them is drawn in an epoch."""
        return len(self.kinds[0])

    def __getitem__(self, draw: Draw | int) -> PaintingSample:
        """A sample, cropped and mirrored by a Draw's seed; the crop in the middle of frame `draw` for an int."""
        if isinstance(draw, int):
            return self._joined([self._crop(self.kinds[0][draw], None)])
        generator = np.random.default_rng(draw.seed)
        chosen = [self.kinds[0][draw.index], *(kind[generator.integers(len(kind))] for kind in self.kinds[1:])]
        return self._joined([self._crop(index, generator) for index in chosen])

    @staticmethod
    def _joined(samples: list[PaintingSample]) -> PaintingSample:
        return PaintingSample(*(torch.stack(parts) for parts in zip(*samples, strict=True)))

    def _crop(self, index: int, generator: np.random.Generator | None) -> PaintingSample:
        segments, depth_m, valid, remission = self._scene(index)
        moment = self._moment(index)
        spare = moment.view.columns - self.columns
        start = spare // 2 if generator is None else int(generator.integers(spare + 1))
        coarse, fine = slice(start, start + self.columns), slice(2 * start, 2 * (start + self.columns))
        image = torch.zeros(5, *depth_m.shape[:1], self.columns)
        image[0], image[4] = valid[:, coarse], remission[:, coarse]
        sample = PaintingSample(
            segments=segments[..., coarse],
            depth_m=depth_m[:, coarse],
            image=image,
            camera=moment.camera[:, coarse].long(),
            colour=moment.colour[..., fine].float() / 127.5 - 1,
            seen=moment.seen[:, fine],
            look=torch.tensor(self.look[index]),
            tone=self._tone(index),
        )
        if generator is None or generator.random() < 0.5:
            return sample
        flipped = {name: getattr(sample, name).flip(-1) for name in sample._fields if name not in ("look", "tone")}
        return sample._replace(**flipped)

    def _moment(self, index: int) -> Moment:
        frame = self.frames[index]
        key = frame.folder / frame.stem
        if key not in self._moments:
            self._moments[key] = read_moment(frame, self.pipeline.view, self.columns + MARGIN, colour=True)
        return self._moments[key]

    def _scene(self, index: int) -> tuple[Tensor, ...]:
        """Segments, depth, validity and remission of a frame in its window, made from the scan alone."""
        frame = self.frames[index]
        key = frame.folder / frame.stem
        if key not in self._held:
            moment = self._moment(index)
            view = moment.view
            whole = self.pipeline.at(frame.calibration((1, 1)))
            seen = whole.translated(frame.scan(), Stopwatch(whole.device))
            start = round((whole.view.left - view.left) * whole.view.columns / (whole.view.left - whole.view.right))
            window = slice(start, start + view.columns)
            self._held[key] = (
                seen.logits[0, ..., window].float().softmax(0).half(),
                seen.depth_m[0, :, window].float(),
                (seen.channels[0, 0, :, window] > 0).clone(),
                seen.channels[0, 4, :, window].half(),
            )
        return self._held[key]

    def _tone(self, index: int) -> Tensor:
        """How much brighter a picture is than its classes are on average in its look: (3,) in [-1, 1]."""
        look = self.look[index]
        if look not in self._means:
            total, count = torch.zeros(256, 3), torch.zeros(256)
            for other in {n for n, one in enumerate(self.look) if one == look}:
                colour, ids = self._pixels(other)
                total.index_add_(0, ids, colour)
                count.index_add_(0, ids, torch.ones(len(ids)))
            self._means[look] = total / count.clamp(min=1)[:, None]
        colour, ids = self._pixels(index)
        return (colour - self._means[look][ids]).mean(0) if len(ids) else torch.zeros(3)

    def _pixels(self, index: int) -> tuple[Tensor, Tensor]:
        """Every fourth pixel of the known part of a picture: colours (P, 3) in [-1, 1] and ids (P,), sky left out."""
        moment = self._moment(index)
        ids = moment.camera[1::4, 1::4].long()
        known = moment.seen[2::8, 2::8] & (ids != UNSURE) & (ids != COMMON15.id_of("sky"))
        return moment.colour[:, 2::8, 2::8].movedim(0, 2)[known].float() / 127.5 - 1, ids[known]


def look_of(root: Path) -> str:
    """The look of a simulated data set; "" for a real one."""
    file = root / "world.json"
    return str(json.loads(file.read_text(encoding="utf-8")).get("look", "")) if file.is_file() else ""
