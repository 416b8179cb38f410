"""Task: a painter of films (vid2vid), from classes and its own last pictures, against critics of pictures and films."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d
from torch.utils.data import default_collate

from lidar2pano.data.clips import Clip, Clips, Framing
from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.flow import Flow, chained
from lidar2pano.geometry.images import one_hot_layers
from lidar2pano.geometry.warp import warp
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.models.card import load
from lidar2pano.train.film_critics import Film, FilmCritics, Frame, film
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS

GIVEN = 2  # pictures that the painter sees before the one it paints
BROAD = 4  # pixels: colours are compared as means over squares of this size
MOST_SCORED = 20  # clips of the validation split
FIELDS = ("camera", "panorama")


class VideoPainting:
    """Trains vid2vid frame after frame: every frame that is painted moves the critics and then the painter.

    Networks: painter; critic, of a picture and its classes; temporal_N, of three painted pictures N frames apart and
    the flow between them (published: N = 1, 3, 9).
    Options: field, "camera" or "panorama" (the truth all around, which simulated data sets have); frames of a clip, of
    which the first two are given; rows and columns of its window; stills, splits whose frames stand alone and are
    panned over; blank, share of the clips before which the painter is shown nothing, as at a stream's beginning;
    single, a weight file of the first-frame network, by which films begin when they are scored ("": by nothing, or
    where blank is 0 by the truth); features, flow, coherence, mask, perceptual, pixels: weights of losses; vgg, the
    file of VGG-19's weights, without which there is no perceptual loss.
    """

    released = ("painter",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        option = recipe.options
        if option["field"] not in FIELDS:
            raise InputError(f"no options.field {option['field']!r}{closest(str(option['field']), FIELDS)}")
        self.view = VIEWS[recipe.view].scaled(recipe.scale)
        self.framing = Framing(
            rows=int(option["rows"]),
            columns=int(option["columns"]),
            scale=recipe.scale,
            view=self.view if option["field"] == "panorama" else None,
        )
        self.length = int(option["frames"])
        self.dataset, self.validation = (
            self._clips(root, splits, option["stills"]) for splits in (recipe.data.train, recipe.data.val)
        )
        self.networks = build_networks(recipe)
        self.critics = FilmCritics(self.networks, option, closed=self.framing.closed)
        self.steps = self.critics.steps(self.length - GIVEN)
        self.blank = float(option["blank"])
        self.single = _first_frames(str(option["single"])) if option["single"] else None
        self.logs: dict[str, float | Tensor] = {}

    def _clips(self, root: Path, splits: tuple[str, ...], stills: tuple[str, ...]) -> Clips:
        alone = tuple(split for split in splits if split in stills)
        followed = tuple(split for split in splits if split not in stills)
        return Clips(root, followed, self.framing, self.length, alone)

    def updates(self, batch: Clip) -> Iterator[tuple[str, Tensor]]:
        """For every painted frame: the critic, the temporal critics whose films are long enough, the painter."""
        labels = layers(batch)
        blank = torch.rand(len(labels), device=labels.device) < self.blank
        previous = batch.colour[:, :GIVEN].masked_fill(blank[:, None, None, None, None], 0)
        painted: list[Tensor] = []
        sums: dict[str, list[Tensor]] = {}
        for now in range(GIVEN, self.length):
            frame = self.frame(batch, labels, previous, now, blank & (now == GIVEN))
            painted.append(frame.painted)
            films = {step: self.film(batch, painted, step) for step in self.steps if len(painted) > 2 * step}
            yield from self.critics.updates(frame, films)
            for name, value in self.critics.logs.items():
                sums.setdefault(name, []).append(value)
            painted[-1] = frame.painted.detach()
            previous = torch.cat([previous[:, 1:], painted[-1][:, None]], 1)
        self.logs = {name: torch.stack(values).mean() for name, values in sums.items()}

    def frame(self, batch: Clip, labels: Tensor, previous: Tensor, now: int, first: Tensor) -> Frame:
        """Paint frame `now` after the pictures `previous` (B, 2, 3, H, W).

        first  (B,) bool: samples that have none; what is painted anew is all of their picture, as published.
        """
        answer = self.networks["painter"](labels[:, now - GIVEN : now + 1], previous)
        picture, flow, weight, raw = (part.float() for part in answer)
        known = batch.known[:, now]
        return Frame(
            labels=labels[:, now],
            true=batch.colour[:, now],
            true_before=batch.colour[:, now - 1],
            flow=Flow(shift=batch.shift[:, now], known=known),
            remembered=known.masked_fill(first[:, None, None], 0),
            painted=torch.where(first[:, None, None, None], raw, picture),
            raw=raw,
            painted_before=previous[:, -1],
            moved=flow,
            weight=weight,
        )

    def film(self, batch: Clip, painted: list[Tensor], step: int) -> Film:
        """The last painted picture and two before it, `step` frames apart, and the same of the truth."""
        now = GIVEN + len(painted) - 1
        flows = [self.over(batch, now - step, step), self.over(batch, now, step)]
        true = [batch.colour[:, now - back * step] for back in (2, 1, 0)]
        return Film(true=film(true, flows), painted=film([painted[-1 - back * step] for back in (2, 1, 0)], flows))

    def over(self, batch: Clip, now: int, step: int) -> Flow:
        """The reference flow of a frame to that `step` frames before it."""
        flow = Flow(shift=batch.shift[:, now], known=batch.known[:, now])
        for back in range(1, step):
            earlier = Flow(shift=batch.shift[:, now - back], known=batch.known[:, now - back])
            flow = chained(flow, earlier, closed=self.framing.closed)
        return flow

    def follow(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Paint a clip as a stream: pictures (K, 3, H, W) in [-1, 1] and flows (K, 2, H, W), on the CPU.

        It begins by the first-frame network, by nothing (the first classes stand for those before), or by the truth,
        whose two pictures are then the first.
        """
        network = self.networks["painter"]
        device = next(network.parameters()).device
        labels = layers(default_collate([clip])).to(device)
        pictures: list[Tensor] = []
        flows = [torch.zeros_like(labels[:, 0, :2])] * GIVEN
        with torch.inference_mode(), fast_arithmetic(device):
            if self.single is not None:
                self.single.to(device)
                pictures = [self.single(labels[:, now]).float() for now in range(GIVEN)]
            elif not self.blank:
                pictures = list(clip.colour[:GIVEN, None].to(device))
            flows = flows[: len(pictures)]
            for now in range(len(pictures), self.length):
                seen = labels[:, [max(now - back, 0) for back in (2, 1, 0)]]
                black = [torch.zeros_like(labels[:, 0, :3])] * (GIVEN - now)
                answer = network(seen, torch.stack([*black, *pictures[-GIVEN:]], 1))
                pictures.append((answer.picture if now else answer.raw).float())
                flows.append(answer.flow.float())
        return torch.cat(pictures).cpu(), torch.cat(flows).cpu()

    def validate(self) -> dict[str, float]:
        """Broad colours, coherence of what is painted (and of the truth), the painter's flow.

        broad_colour  mean distance of broad colours in [0, 1] from the third frame on.
        flicker       mean distance in [0, 1] of a picture from that before it, warped by the reference flow where that
                      is known; flicker_of_truth likewise, of the camera's pictures: noise, and errors of the flow.
        flow_px       mean length of the difference of the flows, likewise.
        The score is minus the first two.
        """
        apart = np.linspace(0, len(self.validation) - 1, min(len(self.validation), MOST_SCORED)).round().astype(int)
        rows = []
        for index in apart.tolist():
            clip = self.validation[index]
            pictures, flows = self.follow(clip)
            gap = avg_pool2d(pictures - clip.colour, BROAD)[GIVEN:].abs().mean() / 2
            wrong = (flows - clip.shift).norm(dim=1)[GIVEN:] * clip.known[GIVEN:]
            flow_px = wrong.sum() / clip.known[GIVEN:].sum().clamp(min=1)
            rows.append([gap, self.flicker(pictures, clip), self.flicker(clip.colour, clip), flow_px])
        means = torch.tensor(rows).mean(0).tolist()
        scores = dict(zip(("broad_colour", "flicker", "flicker_of_truth", "flow_px"), means, strict=True))
        return {"score": -scores["broad_colour"] - scores["flicker"], **scores}

    def flicker(self, pictures: Tensor, clip: Clip) -> Tensor:
        """Distance of each picture from the third on from the one before it, warped; see `validate`."""
        was = warp(pictures[GIVEN - 1 : -1], clip.shift[GIVEN:], closed=self.framing.closed)
        known = clip.known[GIVEN:]
        return ((pictures[GIVEN:] - was).abs().mean(1) * known).sum() / known.sum().clamp(min=1) / 2

    def preview(self) -> dict[str, np.ndarray]:
        """Truth above painted, frames of a clip side by side from the third on: two clips to validate on, one to train.

        (H, W, 3) uint8.
        """
        strips = []
        for clip in (self.validation[0], self.validation[len(self.validation) // 2], self.dataset[0]):
            for pictures in (clip.colour, self.follow(clip)[0]):
                strips.append(torch.cat(list(pictures[GIVEN:]), 2))
        sheet = torch.cat(strips, 1).movedim(0, 2)
        return {"film": ((sheet + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).numpy()}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Its classes, and the panorama's raster on which things are as large as in the pictures it learned from."""
        return {"labels": COMMON15.name, "views": {"panorama": self.view.as_dict()}}


def _first_frames(file: str) -> nn.Module:
    network, card = load(file, expect="vid2vid-single")
    if card.labels != COMMON15.name:
        raise InputError(f"options.single={file}: it reads {card.labels or 'unnamed'} classes, not {COMMON15.name}")
    return network


def layers(batch: Clip) -> Tensor:
    """Classes of a batch of clips as layers (B, K, 16, H, W): one where a pixel is of the class, else zero."""
    return one_hot_layers(batch.classes.flatten(0, 1), len(COMMON15)).unflatten(0, batch.classes.shape[:2])
