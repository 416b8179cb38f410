"""Clips: frames that follow each other, their classes and the flow between them, for networks that paint films."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.sequences import Frame, SampleIndex, frames_of
from lidar2pano.data.sights import Sight, camera_sight, flow_to, panorama_sight
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import Lookup
from lidar2pano.geometry.flow import Flow, reaches
from lidar2pano.views import View

HELD = 128  # frames that stay in memory
# How far a still's window moves from frame to frame at most: rows and columns in pixels, and by which share it grows.
PAN, ZOOM = (2.0, 12.0), 0.04


class Clip(NamedTuple):
    """K frames, the earliest first; after collation every tensor gains a leading B.

    colour   (K, 3, H, W) float32 in [-1, 1].
    classes  (K, H, W) int64 ids of COMMON15, 0 where nobody knows.
    shift    (K, 2, H, W) float32 pixels: flow of each frame to the one before it; zero where not known and in frame 0.
    known    (K, H, W) float32, 1 where the flow is known; 0 in frame 0.
    name     of the last frame, "seq/frame".
    """

    colour: Tensor
    classes: Tensor
    shift: Tensor
    known: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Framing:
    """What of a frame a clip shows.

    rows, columns  of the window that is cut out of every frame of a clip at one place.
    scale          the camera's picture is first made this many times as wide and high.
    view           the panorama's raster, to look all around instead; then `scale` is not used. Windows as wide as a
                   circular view are turned by any angle instead of cut.
    """

    rows: int
    columns: int
    scale: float = 1.0
    view: View | None = None

    @property
    def closed(self) -> bool:
        """Whether the last column of a clip meets its first."""
        return self.view is not None and self.view.circular and self.columns == self.view.columns


class Clips:
    """Clips of some splits.

    splits  every run of `length` frames whose numbers follow each other, in one sequence, is a clip; so frames must be
            numbered in time.
    stills  splits whose frames have nothing to do with each other: each becomes a clip by itself, under a window that
            pans and zooms over it, so that its flow is known. Where there are both kinds, runs are repeated until they
            are as many as the stills.
    Raises InputError where the splits hold no clip.
    """

    def __init__(
        self, root: Path, splits: tuple[str, ...], framing: Framing, length: int, stills: tuple[str, ...] = ()
    ) -> None:
        self.framing, self.length = framing, length
        found = [run for split in splits for run in runs(frames_of(root, (split,)), length)]
        alone = [[frame] for frame in frames_of(root, stills)]
        if not found and not alone:
            raise InputError(
                f"{root}: no {length} frames of split {' or '.join(splits)} follow each other; choose another split or "
                "fewer options.clip_length, or name the split in options.single_frame_splits"
            )
        self.clips = found * max(1, len(alone) // max(len(found), 1)) + alone
        self._sights: dict[Path, Sight] = {}
        self._flows: dict[Path, Flow] = {}

    def __len__(self) -> int:
        """Number of clips, repeated ones counted."""
        return len(self.clips)

    def __getitem__(self, draw: SampleIndex | int) -> Clip:
        """Clip: window, pan and mirror by a SampleIndex's seed, or for an int the middle, unmirrored."""
        plain = isinstance(draw, int)
        generator = np.random.default_rng(draw if plain else draw.seed)
        run = self.clips[draw if plain else draw.index]
        sights = [self.sight(frame) for frame in run]
        self._check(run[0], sights[0])
        if len(run) == 1:
            clip = panned(sights[0], generator, self.framing, self.length, run[0].name)
        else:
            clip = self._window(run, sights, None if plain else generator)
        return clip if plain or generator.random() < 0.5 else mirrored(clip)

    def sight(self, frame: Frame) -> Sight:
        """Read a frame; the last ones are held."""
        key, framing = frame.folder / frame.stem, self.framing
        if key not in self._sights:
            seen = panorama_sight(frame, framing.view) if framing.view else camera_sight(frame, framing.scale)
            _hold(self._sights, key, seen)
        return self._sights[key]

    def flow(self, before: Frame, frame: Frame) -> Flow:
        """Flow of a frame to the one before it, on the whole raster; the last ones are held."""
        key = frame.folder / frame.stem
        if key not in self._flows:
            _hold(self._flows, key, flow_to(before, frame, self.sight(before), self.sight(frame)))
        return self._flows[key]

    def _check(self, frame: Frame, sight: Sight) -> None:
        rows, columns = sight.classes.shape
        wanted = self.framing
        if rows < wanted.rows or columns < wanted.columns:
            raise InputError(
                f"{frame.name}: its picture at this scale has {rows} x {columns} pixels, fewer than the window of "
                f"{wanted.rows} x {wanted.columns}; set scale, options.rows or options.columns"
            )

    def _window(self, run: list[Frame], sights: list[Sight], generator: np.random.Generator | None) -> Clip:
        """One window of a run of frames; in the middle where nothing is drawn."""
        rows, columns = sights[0].classes.shape
        turn = top = left = 0
        if generator is None:
            top, left = (rows - self.framing.rows) // 2, (columns - self.framing.columns) // 2
        else:
            top = int(generator.integers(rows - self.framing.rows + 1))
            left = int(generator.integers(columns - self.framing.columns + 1))
            if self.framing.view and self.framing.view.circular:
                turn = int(generator.integers(columns))

        def cut(picture: Tensor) -> Tensor:
            turned = picture.roll(turn, -1) if turn else picture
            return turned[..., top : top + self.framing.rows, left : left + self.framing.columns]

        flows = [self.flow(before, frame) for before, frame in pairwise(run)]
        shift = torch.stack([torch.zeros_like(flows[0].shift), *(flow.shift for flow in flows)])
        known = torch.stack([torch.zeros_like(flows[0].known), *(flow.known for flow in flows)])
        shift, known = cut(shift), cut(known)
        known = known & reaches(shift, closed=self.framing.closed)
        return _clip(
            torch.stack([cut(sight.colour) for sight in sights]).float(),
            torch.stack([cut(sight.classes) for sight in sights]),
            Flow(shift=shift, known=known),
            run[-1].name,
        )


def runs(found: list[Frame], length: int) -> list[list[Frame]]:
    """Every run of `length` frames of one sequence whose numbers follow each other."""
    ordered = sorted((frame for frame in found if frame.stem.isdecimal()), key=lambda f: (f.folder, int(f.stem)))
    windows = [ordered[first : first + length] for first in range(len(ordered) - length + 1)]
    return [run for run in windows if all(_next(one, other) for one, other in pairwise(run))]


def panned(sight: Sight, generator: np.random.Generator, framing: Framing, length: int, name: str) -> Clip:
    """One frame under a window that moves (see `pan`)."""
    rows, columns = framing.rows, framing.columns
    size, middle = pan(generator, sight.classes.shape, (rows, columns), length)
    row, column = torch.arange(rows) - (rows - 1) / 2, torch.arange(columns) - (columns - 1) / 2
    everywhere = torch.ones(rows, columns, dtype=torch.bool)
    colours, classes, shifts = [], [], [torch.zeros(2, rows, columns)]
    for k in range(length):
        places = torch.meshgrid(middle[k, 0] + size[k] * row, middle[k, 1] + size[k] * column, indexing="ij")
        lookup = Lookup(row=places[0] + 0.5, column=places[1] + 0.5, valid=everywhere, circular=False)
        colours.append(lookup.linear(sight.colour.float()))
        classes.append(lookup.nearest(sight.classes))
        if k:
            was = [(place - middle[k - 1, axis]) / size[k - 1] for axis, place in enumerate(places)]
            shifts.append(torch.stack([was[1] - column, was[0] - row[:, None]]))
    shift = torch.stack(shifts)
    known = reaches(shift)
    known[0] = False
    return _clip(torch.stack(colours), torch.stack(classes), Flow(shift=shift, known=known), name)


def pan(
    generator: np.random.Generator, whole: tuple[int, ...], window: tuple[int, int], length: int
) -> tuple[Tensor, Tensor]:
    """A window's way over a picture of `whole` (rows, columns): sizes (K,) in windows, middles (K, 2) (row, column).

    Float32; it stays inside, and changes from frame to frame by the same steps. Pixel centres are at integers.
    """
    most = min(whole[0] / window[0], whole[1] / window[1], 1 + ZOOM * (length - 1))
    first, last = 1.0, generator.uniform(1.0, most)
    if generator.random() < 0.5:
        first, last = last, first
    size = np.linspace(first, last, length)
    middle = np.zeros((length, 2))
    for axis in (0, 1):
        half = size * (window[axis] - 1) / 2
        low, high = half, whole[axis] - 1 - half
        start = generator.uniform(low[0], max(high[0], low[0]))
        reach = PAN[axis] * (length - 1)
        nearest, farthest = max(low[-1], start - reach), min(high[-1], start + reach)
        end = generator.uniform(nearest, farthest) if nearest < farthest else min(max(start, low[-1]), high[-1])
        middle[:, axis] = np.linspace(start, end, length)
    return torch.from_numpy(size).float(), torch.from_numpy(middle).float()


def mirrored(clip: Clip) -> Clip:
    """The clip with left and right swapped."""
    shift = clip.shift.flip(-1) * torch.tensor([-1.0, 1.0])[:, None, None]
    return clip._replace(
        colour=clip.colour.flip(-1), classes=clip.classes.flip(-1), shift=shift, known=clip.known.flip(-1)
    )


def _clip(colour: Tensor, classes: Tensor, flow: Flow, name: str) -> Clip:
    return Clip(
        colour=colour / 127.5 - 1,
        classes=classes.long(),
        shift=(flow.shift * flow.known[:, None]).float(),
        known=flow.known.float(),
        name=name,
    )


def _next(one: Frame, other: Frame) -> bool:
    return one.folder == other.folder and int(other.stem) == int(one.stem) + 1


def _hold(held: dict[Path, Any], key: Path, value: Sight | Flow) -> None:
    while len(held) >= HELD:
        del held[next(iter(held))]
    held[key] = value
