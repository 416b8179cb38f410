"""Task: a video painter (vid2vid), from classes and its own previous images, against image and video discriminators."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

from lidar2pano.data.clips import ClipDataset, ClipSample, Framing
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.errors import InputError
from lidar2pano.geometry.flow import Flow, chained
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.geometry.warp import warp
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import pooled
from lidar2pano.models.card import load
from lidar2pano.train.options import VideoOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import as_image, build_networks, device_of
from lidar2pano.train.video_losses import PaintedFrame, TemporalInput, VideoLosses, temporal_input
from lidar2pano.views import VIEWS

PREVIOUS = 2  # images that the painter reads before the one it paints
MOST_SCORED = 20  # clips of the validation split


class VideoPainting:
    """Trains vid2vid frame after frame: every painted frame updates the discriminators and then the painter.

    Networks: painter; critic, of an image and its classes; temporal_N, of three painted images N frames apart and the
    flow between them (published: N = 1, 3, 9).
    """

    released = ("painter",)

    def __init__(self, recipe: Recipe[VideoOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view].scaled(recipe.scale), recipe.options
        options = recipe.options
        self.framing = Framing(
            rows=options.rows,
            columns=options.columns,
            scale=recipe.scale,
            view=self.view if options.source == "panorama" else None,
        )
        self.dataset, self.validation = (self._clips(root, splits) for splits in (recipe.data.train, recipe.data.val))
        self.networks = build_networks(recipe)
        self.losses = VideoLosses(self.networks, options, circular=self.framing.circular)
        self.steps = self.losses.steps(options.clip_length - PREVIOUS)
        self.first = _first_frames(options.first_frame_weights) if options.first_frame_weights else None
        self.logs: dict[str, float | Tensor] = {}

    def _clips(self, root: Path, splits: tuple[str, ...]) -> ClipDataset:
        single = tuple(split for split in splits if split in self.options.single_frame_splits)
        sequences = tuple(split for split in splits if split not in single)
        return ClipDataset(root, sequences, self.framing, self.options.clip_length, single)

    def updates(self, batch: ClipSample) -> Iterator[tuple[str, Tensor]]:
        """For every painted frame: the critic, the temporal ones with enough frames, the painter."""
        labels = one_hot_clip(batch)
        blank = torch.rand(len(labels), device=labels.device) < self.options.no_previous_probability
        previous = batch.image[:, :PREVIOUS].masked_fill(blank[:, None, None, None, None], 0)
        painted: list[Tensor] = []
        sums: dict[str, list[Tensor]] = {}
        for now in range(PREVIOUS, self.options.clip_length):
            frame = self.frame(batch, labels, previous, now, blank & (now == PREVIOUS))
            painted.append(frame.fake)
            inputs = {step: self.temporal(batch, painted, step) for step in self.steps if len(painted) > 2 * step}
            yield from self.losses.updates(frame, inputs)
            for name, value in self.losses.logs.items():
                sums.setdefault(name, []).append(value)
            painted[-1] = frame.fake.detach()
            previous = torch.cat([previous[:, 1:], painted[-1][:, None]], 1)
        self.logs = {name: torch.stack(values).mean() for name, values in sums.items()}

    def frame(self, batch: ClipSample, labels: Tensor, previous: Tensor, now: int, first: Tensor) -> PaintedFrame:
        """Paint frame `now` after the images `previous` (B, 2, 3, H, W).

        first  (B,) bool: samples without previous images; `raw` is all of their image, as published.
        """
        output = self.networks["painter"](labels[:, now - PREVIOUS : now + 1], previous)
        image, flow, weight, raw = (part.float() for part in output)
        known = batch.known[:, now]
        return PaintedFrame(
            labels=labels[:, now],
            real=batch.image[:, now],
            real_before=batch.image[:, now - 1],
            flow=Flow(shift=batch.shift[:, now], known=known),
            coherent=known.masked_fill(first[:, None, None], 0),
            fake=torch.where(first[:, None, None, None], raw, image),
            raw=raw,
            fake_before=previous[:, -1],
            fake_flow=flow,
            weight=weight,
        )

    def temporal(self, batch: ClipSample, painted: list[Tensor], step: int) -> TemporalInput:
        """The last painted image and two before it, `step` frames apart, and the same of the camera's."""
        now = PREVIOUS + len(painted) - 1
        flows = [self.flow_over(batch, now - step, step), self.flow_over(batch, now, step)]
        real = [batch.image[:, now - back * step] for back in (2, 1, 0)]
        fake = [painted[-1 - back * step] for back in (2, 1, 0)]
        return TemporalInput(real=temporal_input(real, flows), fake=temporal_input(fake, flows))

    def flow_over(self, batch: ClipSample, now: int, step: int) -> Flow:
        """The reference flow of a frame to that `step` frames before it."""
        flow = Flow(shift=batch.shift[:, now], known=batch.known[:, now])
        for back in range(1, step):
            earlier = Flow(shift=batch.shift[:, now - back], known=batch.known[:, now - back])
            flow = chained(flow, earlier, circular=self.framing.circular)
        return flow

    def paint(self, clip: ClipSample) -> tuple[Tensor, Tensor]:
        """Paint a clip as a stream: images (K, 3, H, W) in [-1, 1] and flows (K, 2, H, W), on the CPU.

        It begins with the first-frame network, with no image (the first classes stand for those before), or with
        ground truth, whose two images are then the first.
        """
        network = self.networks["painter"]
        device = device_of(network)
        labels = one_hot_clip(default_collate([clip])).to(device)
        images: list[Tensor] = []
        flows = [torch.zeros_like(labels[:, 0, :2])] * PREVIOUS
        with torch.inference_mode(), fast_arithmetic(device):
            if self.first is not None:
                self.first.to(device)
                images = [self.first(labels[:, now]).float() for now in range(PREVIOUS)]
            elif not self.options.no_previous_probability:
                images = list(clip.image[:PREVIOUS, None].to(device))
            flows = flows[: len(images)]
            for now in range(len(images), self.options.clip_length):
                recent = labels[:, [max(now - back, 0) for back in (2, 1, 0)]]
                black = [torch.zeros_like(labels[:, 0, :3])] * (PREVIOUS - now)
                output = network(recent, torch.stack([*black, *images[-PREVIOUS:]], 1))
                images.append((output.image if now else output.raw).float())
                flows.append(output.flow.float())
        return torch.cat(images).cpu(), torch.cat(flows).cpu()

    def validate(self) -> dict[str, float]:
        """Pooled colours, temporal coherence of painted and of real images, and the painter's flow.

        pooled_colour    mean distance of pooled colours in [0, 1] from the third frame on.
        flicker          mean distance in [0, 1] of an image from the one before it, warped by the reference flow where
                         that is known; flicker_of_real likewise, of the camera's: noise, and errors of the flow.
        flow_px          mean length of the difference of the flows, likewise.
        The score is minus the first two.
        """
        rows = []
        for index in evenly_spaced(len(self.validation), MOST_SCORED):
            clip = self.validation[index]
            images, flows = self.paint(clip)
            gap = pooled(images - clip.image)[PREVIOUS:].abs().mean() / 2
            wrong = (flows - clip.shift).norm(dim=1)[PREVIOUS:] * clip.known[PREVIOUS:]
            flow_px = wrong.sum() / clip.known[PREVIOUS:].sum().clamp(min=1)
            rows.append([gap, self.flicker(images, clip), self.flicker(clip.image, clip), flow_px])
        means = torch.tensor(rows).mean(0).tolist()
        scores = dict(zip(("pooled_colour", "flicker", "flicker_of_real", "flow_px"), means, strict=True))
        return {"score": -scores["pooled_colour"] - scores["flicker"], **scores}

    def flicker(self, images: Tensor, clip: ClipSample) -> Tensor:
        """Distance of each image from the third on from the one before it, warped; see `validate`."""
        warped = warp(images[PREVIOUS - 1 : -1], clip.shift[PREVIOUS:], circular=self.framing.circular)
        known = clip.known[PREVIOUS:]
        return ((images[PREVIOUS:] - warped).abs().mean(1) * known).sum() / known.sum().clamp(min=1) / 2

    def preview(self) -> dict[str, np.ndarray]:
        """Real above painted, a clip's frames side by side from the third on: two validation clips, one of training.

        (H, W, 3) uint8.
        """
        strips = []
        for clip in (self.validation[0], self.validation[len(self.validation) // 2], self.dataset[0]):
            for images in (clip.image, self.paint(clip)[0]):
                strips.append(torch.cat(list(images[PREVIOUS:]), 2))
        return {"video": as_image(torch.cat(strips, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Its classes, and the panorama's raster on which things are as large as in its training images."""
        return {"labels": COMMON15.name, "views": {"panorama": self.view.as_dict()}}


def _first_frames(file: str) -> nn.Module:
    network, card = load(file, expect="vid2vid-single")
    if card.labels != COMMON15.name:
        labels = card.labels or "unnamed"
        raise InputError(f"options.first_frame_weights={file}: it reads {labels} classes, not {COMMON15.name}")
    return network


def one_hot_clip(batch: ClipSample) -> Tensor:
    """One-hot classes (B, K, 16, H, W) of a batch of clips."""
    return one_hot_layers(batch.labels.flatten(0, 1), len(COMMON15)).unflatten(0, batch.labels.shape[:2])
