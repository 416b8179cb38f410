"""Paints a stream of label maps with vid2vid: on any raster, in the camera or all around, each frame after the last.

How a stream begins. Published code (vid2vid_model_G.py, generate_first_frame) paints the first two frames with the
network for single images, and the generator goes on from there; without such a network
(no_first_img), the generator begins from black images and its first frame is its unwarped image (`raw`).
So do we, with and without a `vid2vid-single`. Published code never shows the first two frames, and asks for the label
maps before the first one; a stream has none, so its first label map stands for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Self, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import upsample_azimuth, upsample_classes
from lidar2pano.labels import CITYSCAPES_IDS, COMMON15, TABLES, LabelSet
from lidar2pano.models.vid2vid import Vid2Vid, Vid2VidSingle
from lidar2pano.models.vid2vid_layers import close
from lidar2pano.scene.record import Scene

TWICE = Fraction(2)  # the finished panorama's raster is twice that of the segments
MARGIN = 64  # columns of a panorama's overlap with itself at each end, if its width does not divide


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Past:
    """Memory of a painter about previous frames, on its padded raster.

    ids     (T, H, W) uint8: the latest label maps, ids of COMMON15; T is one less than the generator's frames.
    levels  coarse to fine, each scale's latest images (1, T, 3, h, w) in [-1, 1]; as long as there are fewer than T
            images, only those of the finest scale.
    """

    ids: Tensor
    levels: list[Tensor]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelChannels:
    """From ids of COMMON15 to a network's channels: one-hot in its own label set, then edges, if any.

    labels  the network's set: COMMON15, or CITYSCAPES_IDS as published weights have it.
    edges   whether it reads edges of instances. A LiDAR's segments have no instances, so we give edges of classes (in
            published data a map of instances has the class for pixels without an instance).
    """

    labels: LabelSet
    edges: bool

    @classmethod
    def of(cls, channels: int) -> Self:
        """Those of a network with so many channels; InputError if no label set of ours fits."""
        for labels in (COMMON15, CITYSCAPES_IDS):
            if channels - len(labels) in (0, 1):
                return cls(labels=labels, edges=channels > len(labels))
        counts = f"{len(COMMON15)} ({COMMON15.name}) or {len(CITYSCAPES_IDS)} ({CITYSCAPES_IDS.name})"
        raise InputError(f"it reads {channels} label channels; make one that reads {counts}, or one more for edges")

    def __call__(self, ids: Tensor, closed: bool) -> Tensor:
        """(T, H, W) uint8 ids of COMMON15 -> (1, T, channels, H, W) float32; closed: columns meet at their ends."""
        own = ids
        if self.labels is not COMMON15:
            own = torch.from_numpy(TABLES[COMMON15.name, self.labels.name]).to(ids.device)[ids.long()]
        frames, rows, columns = ids.shape
        channels = torch.zeros(frames, len(self.labels) + self.edges, rows, columns, device=ids.device)
        channels.scatter_(1, own[:, None].long(), 1.0)
        if self.edges:
            channels[:, -1] = edges(own, closed)
        return channels[None]


def edges(ids: Tensor, closed: bool) -> Tensor:
    """Find pixels with a neighbour, of four, of another id: (T, H, W) -> bool (T, H, W)."""
    border = torch.zeros_like(ids, dtype=torch.bool)
    down, right = ids[:, 1:] != ids[:, :-1], ids[:, :, 1:] != ids[:, :, :-1]
    border[:, 1:] |= down
    border[:, :-1] |= down
    border[:, :, 1:] |= right
    border[:, :, :-1] |= right
    if closed:
        seam = ids[:, :, 0] != ids[:, :, -1]
        border[:, :, 0] |= seam
        border[:, :, -1] |= seam
    return border


class Vid2VidPainter(nn.Module):
    """vid2vid's generator, and the network for first frames if there is one; InputError unless the two match.

    closed  images close in azimuth (panoramas), otherwise they end (cameras).
    finer   pixels of `paint`'s raster per pixel of the segments' raster.
    """

    def __init__(
        self, generator: Vid2Vid, single: Vid2VidSingle | None = None, *, closed: bool = True, finer: Fraction = TWICE
    ) -> None:
        super().__init__()
        self.generator, self.single, self.closed, self.finer = generator, single, closed, finer
        self.reads = LabelChannels.of(generator.channels)
        if single is not None and single.classes != len(self.reads.labels):
            raise InputError(
                f"the first-frame network reads {single.classes} classes and the generator {len(self.reads.labels)}; "
                "take two that belong together"
            )
        self.stride = max(generator.stride, single.stride if single is not None else 1)
        close(self, closed)

    @classmethod
    def all_around(cls, generator: nn.Module, single: nn.Module | None, columns: int, segments: int) -> Self:
        """The painter of panoramas whose segments are `segments` columns wide, on a raster of `columns`.

        Raises InputError unless one of the two is a multiple of the other, and so with twice the segments' (the
        finished panorama's).
        """
        finer = Fraction(columns, segments)
        if not all(1 in ratio.as_integer_ratio() for ratio in (finer, TWICE / finer)):
            raise InputError(
                f"it paints panoramas of {columns} columns, which do not fit the translator's {segments}: "
                f"choose weights for {segments // 2}, {segments} or {2 * segments}"
            )
        return cls(cast("Vid2Vid", generator), cast("Vid2VidSingle | None", single), finer=finer)

    def paint(self, past: Past | None, scene: Scene, look: str = "") -> tuple[Past, Tensor]:  # noqa: ARG002 it has one
        """Paint the next panorama, from its classes alone; as of StreamPainter."""
        grow, shrink = self.finer.as_integer_ratio()
        past, image = self.follow(past, upsample_classes(_shrunk(scene.probabilities, shrink), grow))
        grow, shrink = (TWICE / self.finer).as_integer_ratio()
        image = _shrunk(image[None], shrink)
        return past, image if grow == 1 else upsample_azimuth(image, grow)

    def follow(self, past: Past | None, ids: Tensor) -> tuple[Past, Tensor]:
        """Paint the next label map of a stream.

        past  of the previous frame; None at the beginning of a stream.
        ids   (H, W) integer ids of COMMON15, any size; every frame of a stream of the same.
        Returns the next frame's past, and the image (3, H, W) float32 in [-1, 1].
        """
        framed, rows, columns = _framed(ids.to(torch.uint8), self.stride, self.closed)
        keep = self.generator.frames - 1
        if past is None:
            past = Past(ids=framed.expand(keep, -1, -1), levels=[])
        if past.ids.shape[1:] != framed.shape[1:]:
            raise ValueError(f"a stream's frames have one size, not {tuple(ids.shape)} after another")
        label_maps = torch.cat([past.ids, framed])
        if self.single is not None and (not past.levels or past.levels[-1].shape[1] < keep):
            levels = self._begun(self.single, past.levels, framed)
        else:
            levels = self._gone_on(past.levels, label_maps)
        image = levels[-1][0, -1, :, rows, columns].clone()  # the caller's own: levels are remembered
        return Past(ids=label_maps[1:], levels=levels), image

    def _begun(self, single: Vid2VidSingle, levels: list[Tensor], ids: Tensor) -> list[Tensor]:
        """One of the first frames, by the network for single images."""
        one_hot = LabelChannels(labels=self.reads.labels, edges=False)(ids, self.closed)[0]
        images = torch.cat([*levels, single(one_hot).float()[None]], 1)
        return self.generator.pyramid(images) if images.shape[1] == self.generator.frames - 1 else [images]

    def _gone_on(self, levels: list[Tensor], ids: Tensor) -> list[Tensor]:
        """A frame by the generator; the very first of a stream from black images, unwarped."""
        labels = self.reads(ids, self.closed)
        first = not levels
        if first:
            levels = self.generator.pyramid(labels.new_zeros(1, len(ids) - 1, 3, *ids.shape[1:]))
        painted = self.generator.scales(self.generator.pyramid(labels), levels)
        latest = [scale.raw if first else scale.image for scale in painted]
        return [torch.cat([level[:, 1:], new[:, None]], 1) for level, new in zip(levels, latest, strict=True)]


def _shrunk(x: Tensor, factor: int) -> Tensor:
    return x if factor == 1 else avg_pool2d(x, factor)


def _framed(ids: Tensor, stride: int, closed: bool) -> tuple[Tensor, slice, slice]:
    """Continue a label map (H, W) to a divisible raster: its last row and column go on; a panorama overlaps itself.

    If a panorama's columns divide by the stride, nothing is added, and a turn by the stride turns the answer.
    Returns the map (1, H', W') on the raster, and the rows and columns of the requested one in it.
    """
    rows, columns = ids.shape
    rows_below = max(-rows % stride, 2 * stride - rows)
    columns_beyond = max(-columns % stride, 2 * stride - columns)
    left = 0
    if closed and columns_beyond:
        columns_beyond = 2 * MARGIN + -(columns + 2 * MARGIN) % stride
        left = columns_beyond // 2
        ids = ids[:, (torch.arange(columns + columns_beyond, device=ids.device) - left) % columns]
        columns_beyond = 0
    if rows_below or columns_beyond:
        ids = pad(ids[None].float(), (0, columns_beyond, 0, rows_below), mode="replicate")[0].to(torch.uint8)
    return ids[None], slice(rows), slice(left, left + columns)
