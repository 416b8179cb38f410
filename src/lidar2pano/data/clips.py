"""ClipDataset: consecutive frames, their labels and the flow between them, for networks painting videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.cache import LruCache
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame, FrameList, SampleIndex
from lidar2pano.data.layouts import frames_of
from lidar2pano.data.panorama_crops import panorama_on
from lidar2pano.errors import InputError, require_extra
from lidar2pano.geometry.camera import Lookup, at_camera, panorama_in_camera
from lidar2pano.geometry.flow import Flow, ego_flow, reaches, relative_pose, scan_distances
from lidar2pano.geometry.rasters import in_unit, warp
from lidar2pano.labels import COMMON15
from lidar2pano.views import View

SKY = COMMON15.id_of("sky")
# How far a single frame's window moves per step at most: rows and columns in pixels, and its share of growth.
PAN, ZOOM = (2.0, 12.0), 0.04


class ClipSample(NamedTuple):
    """K frames, the earliest first; after collation every tensor gains a leading B.

    image   (K, 3, H, W) float32 in [-1, 1].
    labels  (K, H, W) int64 ids of COMMON15, 0 if unknown.
    shift   (K, 2, H, W) float32 pixels: flow of each frame to the one before it; zero if not known and in frame 0.
    known   (K, H, W) float32, 1 if the flow is known; 0 in frame 0.
    name    of the last frame, "seq/frame".
    """

    image: Tensor
    labels: Tensor
    shift: Tensor
    known: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Framing:
    """The part of a frame in a clip.

    rows, columns  of the window, at one place in every frame of a clip.
    scale          factor of resizing the camera's image first.
    view           the panorama's raster, to take the true panorama instead; then `scale` is not used. Windows as wide
                   as a circular view are turned by any angle instead of cut.
    """

    rows: int
    columns: int
    scale: float = 1.0
    view: View | None = None

    @property
    def circular(self) -> bool:
        """True if the last column of a clip meets its first."""
        return self.view is not None and self.view.circular and self.columns == self.view.columns


class LabelledImage(NamedTuple):
    """An image and its labels on one raster.

    raster  the panorama's View, or the camera of the image; None: an unknown camera.
    image   (3, H, W) uint8 RGB;  labels: (H, W) uint8 ids of COMMON15, 0 if unknown.
    """

    raster: View | Calibration | None
    image: Tensor
    labels: Tensor


class ClipDataset:
    """Clips of some splits.

    splits  every run of `length` frames whose numbers follow each other, in one sequence, is a clip; so frames must be
            numbered in time.
    stills  splits whose frames are unrelated to each other: each becomes a clip by itself, under a window panning
            and zooming over it, so its flow is known. With both kinds, runs are repeated until they are
            as many as the stills.
    Raises InputError if the splits hold no clip.
    """

    def __init__(
        self, root: Path, splits: tuple[str, ...], framing: Framing, length: int, stills: tuple[str, ...] = ()
    ) -> None:
        self.framing, self.length = framing, length
        self.frames = FrameList[Frame]()
        sequences: list[range | tuple[int, ...]] = []
        for split in splits:
            frames = frames_of(root, (split,))
            sequences += [tuple(len(self.frames) + index for index in run) for run in runs(frames.names, length)]
            self.frames += frames
        single = frames_of(root, stills)
        singles = [range(index, index + 1) for index in range(len(self.frames), len(self.frames) + len(single))]
        self.frames += single
        if not sequences and not singles:
            raise InputError(
                f"{root}: no {length} frames of split {' or '.join(splits)} follow each other; choose another split or "
                "a smaller options.clip_length, or name the split in options.single_frame_splits"
            )
        self.clips = sequences * max(1, len(singles) // max(len(sequences), 1)) + singles  # indices of frames
        self._images, self._flows = LruCache(), LruCache()

    def __len__(self) -> int:
        """Return the number of clips, repeated ones counted."""
        return len(self.clips)

    def __getitem__(self, index: SampleIndex | int) -> ClipSample:
        """Return the clip: window, pan and mirror by a SampleIndex's seed, or for an int the middle, unmirrored."""
        plain = isinstance(index, int)
        generator = np.random.default_rng(index if plain else index.seed)
        run = self.clips[index if plain else index.index]
        frames = {number: self.frames[number] for number in run}
        images = [self._images.get(number, lambda i=number: self._read(frames[i])) for number in run]
        self._check(frames[run[0]], images[0])
        if len(run) == 1:
            clip = panned(images[0], generator, self.framing, self.length, frames[run[0]].name)
        else:
            flows = [
                self._flows.get(
                    pair, lambda k=k, pair=pair: flow_to(frames[pair[0]], frames[pair[1]], images[k], images[k + 1])
                )
                for k, pair in enumerate(pairwise(run))
            ]
            clip = self._window(frames[run[-1]].name, images, flows, None if plain else generator)
        return clip if plain or generator.random() < 0.5 else mirrored(clip)

    def _read(self, frame: Frame) -> LabelledImage:
        return (
            panorama_image(frame, self.framing.view) if self.framing.view else camera_image(frame, self.framing.scale)
        )

    def _check(self, frame: Frame, image: LabelledImage) -> None:
        rows, columns = image.labels.shape
        framing = self.framing
        if rows < framing.rows or columns < framing.columns:
            raise InputError(
                f"{frame.name}: its image at this scale has {rows} x {columns} pixels, fewer than the window of "
                f"{framing.rows} x {framing.columns}; set scale, options.rows or options.columns"
            )

    def _window(
        self, name: str, images: list[LabelledImage], flows: list[Flow], generator: np.random.Generator | None
    ) -> ClipSample:
        """One window of a run of frames; in the middle without a generator."""
        rows, columns = images[0].labels.shape
        turn = top = left = 0
        if generator is None:
            top, left = (rows - self.framing.rows) // 2, (columns - self.framing.columns) // 2
        else:
            top = int(generator.integers(rows - self.framing.rows + 1))
            left = int(generator.integers(columns - self.framing.columns + 1))
            if self.framing.view and self.framing.view.circular:
                turn = int(generator.integers(columns))

        def cut(raster: Tensor) -> Tensor:
            turned = raster.roll(turn, -1) if turn else raster
            return turned[..., top : top + self.framing.rows, left : left + self.framing.columns]

        shift = torch.stack([torch.zeros_like(flows[0].shift), *(flow.shift for flow in flows)])
        valid = torch.stack([torch.zeros_like(flows[0].known), *(flow.known for flow in flows)])
        shift, valid = cut(shift), cut(valid)
        valid = valid & reaches(shift, circular=self.framing.circular)
        return _clip(
            torch.stack([cut(image.image) for image in images]).float(),
            torch.stack([cut(image.labels) for image in images]),
            Flow(shift=shift, known=valid),
            name,
        )


def runs(names: Sequence[str], length: int) -> list[tuple[int, ...]]:
    """Return every run of `length` frames "seq/NNNNNN" of one sequence whose numbers follow each other, as indices."""
    parts = [
        (sequence, int(stem), index)
        for index, name in enumerate(names)
        for sequence, stem in [name.split("/")]
        if stem.isdecimal()
    ]
    ordered = sorted(parts)
    windows = [ordered[first : first + length] for first in range(len(ordered) - length + 1)]
    return [
        tuple(index for _, _, index in window)
        for window in windows
        if all(left[0] == right[0] and right[1] == left[1] + 1 for left, right in pairwise(window))
    ]


def camera_image(frame: Frame, scale: float) -> LabelledImage:
    """Return the camera's image and labels, resized by the factor `scale`; InputError if a file is missing."""
    image, ids = frame.require("image", "camera_labels")
    common = CITYSCAPES_TO_COMMON15[ids]
    common[common == IGNORE] = 0
    camera = frame.calibration.scaled(scale) if frame.calibration else None
    size = camera.size if camera else (round(image.shape[1] * scale), round(image.shape[0] * scale))
    resized = Image.fromarray(image).resize(size, Image.Resampling.BOX)
    labels = np.array(Image.fromarray(common).resize(size, Image.Resampling.NEAREST))
    return LabelledImage(
        camera, torch.from_numpy(np.array(resized)).movedim(2, 0).contiguous(), torch.from_numpy(labels)
    )


def panorama_image(frame: Frame, view: View) -> LabelledImage:
    """Return the true panorama and its labels on the raster `view` around the camera; InputError if there is none."""
    panorama = panorama_on(frame, view)
    image = torch.from_numpy(panorama.image).movedim(2, 0).contiguous()
    return LabelledImage(panorama.view, image, torch.from_numpy(panorama.labels))


def flow_to(previous: Frame, current: Frame, image_previous: LabelledImage, image_current: LabelledImage) -> Flow:
    """Return the flow of a frame to the one before: by poses and depths, else optical flow of the images."""
    if previous.pose is None or current.pose is None or image_current.raster is None:
        return optical_flow(image_current.image, image_previous.image)
    distances = distances_m(current, image_current), distances_m(previous, image_previous)
    return ego_flow(*distances, relative_pose(previous.pose, current.pose), image_current.raster)


def optical_flow(current: Tensor, previous: Tensor) -> Flow:
    """Return the flow from an image (3, H, W) uint8 RGB to the one before: (2, H, W) pixels and (H, W) bool.

    Kroeger et al. 2016 (arXiv:1603.03590), preset "medium". Known where the flows forth and back undo each other
    as far as Sundaram et al. 2010 (ECCV), equation 5, ask: |w + w'|^2 < 0.01 (|w|^2 + |w'|^2) + 0.5.
    Raises InputError if OpenCV is not installed.
    """
    forth, back = _dis(current, previous), _dis(previous, current)
    returned = warp(back[None], forth[None])[0]
    gap, length = (forth + returned).square().sum(0), forth.square().sum(0) + returned.square().sum(0)
    valid = (gap < 0.01 * length + 0.5) & reaches(forth[None])[0]
    return Flow(shift=forth * valid, known=valid)


def _dis(first: Tensor, second: Tensor) -> Tensor:
    """Return the flow (2, H, W) float32 from `first` to `second`, pixels."""
    with require_extra("train", "flow without poses.txt"):
        import cv2
    grey = [cv2.cvtColor(image.movedim(0, 2).numpy().copy(), cv2.COLOR_RGB2GRAY) for image in (first, second)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return torch.from_numpy(dis.calc(grey[0], grey[1], None)).movedim(2, 0).contiguous()  # pyright: ignore[reportCallIssue, reportArgumentType]


def distances_m(frame: Frame, image: LabelledImage) -> Tensor:
    """Return distances (H, W) float32 for `ego_flow`: of the true panorama if it has labels, else of the scan.

    Depths of a panorama stitched without labels are sparse; the scan's are completed.
    """
    raster = image.raster
    assert raster is not None, "without a camera flow comes from the images"
    if isinstance(raster, View):
        return _sky_is_far(panorama_on(frame, raster).depth_m)
    if frame.panorama_labels is not None and frame.panorama is not None:
        depth_m = _sky_is_far(frame.panorama.depth_m)
        return panorama_in_camera(at_camera(frame.panorama.view, raster), raster).nearest(depth_m)
    distance = scan_distances(torch.from_numpy(frame.scan.xyz), raster)
    return distance.where(image.labels != SKY, torch.inf)


def _sky_is_far(depth_m: np.ndarray | None) -> Tensor:
    assert depth_m is not None
    return torch.from_numpy(np.where(depth_m > 0, depth_m, np.float32(np.inf)))


def panned(
    image: LabelledImage, generator: np.random.Generator, framing: Framing, length: int, name: str
) -> ClipSample:
    """Return a clip of one frame under a moving window (see `pan`)."""
    rows, columns = framing.rows, framing.columns
    size, middle = pan(generator, image.labels.shape, (rows, columns), length)
    row, column = torch.arange(rows) - (rows - 1) / 2, torch.arange(columns) - (columns - 1) / 2
    everywhere = torch.ones(rows, columns, dtype=torch.bool)
    images, labels, shifts = [], [], [torch.zeros(2, rows, columns)]
    for k in range(length):
        places = torch.meshgrid(middle[k, 0] + size[k] * row, middle[k, 1] + size[k] * column, indexing="ij")
        lookup = Lookup(row=places[0] + 0.5, column=places[1] + 0.5, valid=everywhere, circular=False)
        images.append(lookup.linear(image.image.float()))
        labels.append(lookup.nearest(image.labels))
        if k:
            was = [(place - middle[k - 1, axis]) / size[k - 1] for axis, place in enumerate(places)]
            shifts.append(torch.stack([was[1] - column, was[0] - row[:, None]]))
    shift = torch.stack(shifts)
    valid = reaches(shift)
    valid[0] = False
    return _clip(torch.stack(images), torch.stack(labels), Flow(shift=shift, known=valid), name)


def pan(
    generator: np.random.Generator, whole: tuple[int, ...], window: tuple[int, int], length: int
) -> tuple[Tensor, Tensor]:
    """Return the path of a window over an image of `whole` (rows, columns): sizes (K,), middles (K, 2) (row, column).

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


def mirrored(clip: ClipSample) -> ClipSample:
    """Return the clip with left and right swapped."""
    shift = clip.shift.flip(-1) * torch.tensor([-1.0, 1.0])[:, None, None]
    return clip._replace(image=clip.image.flip(-1), labels=clip.labels.flip(-1), shift=shift, known=clip.known.flip(-1))


def _clip(image: Tensor, labels: Tensor, flow: Flow, name: str) -> ClipSample:
    return ClipSample(
        image=in_unit(image),
        labels=labels.long(),
        shift=(flow.shift * flow.known[:, None]).float(),
        known=flow.known.float(),
        name=name,
    )
