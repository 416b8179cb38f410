"""What moves a painter of films and its critics, one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import l1_loss

from lidar2pano.errors import InputError
from lidar2pano.geometry.flow import Flow
from lidar2pano.losses.video import (
    coherence_loss,
    flow_loss,
    least_squares_critic,
    least_squares_generator,
    mask_loss,
    matched_features,
    perceptual,
    warping_loss,
)
from lidar2pano.models.vgg import read_vgg

FLOW_PX = 20.0  # temporal critics are shown the flow in these, as published
TEMPORAL = "temporal_"  # role of a critic of films, followed by the number of frames between its pictures
SHARES = ("features", "flow", "coherence", "mask", "perceptual", "pixels")


class Frame(NamedTuple):
    """One frame of a clip; every tensor has a leading B. Pictures are (3, H, W) in [-1, 1].

    labels       (16, H, W) one-hot;  true, true_before: the camera's picture and that before it.
    flow         the reference to the frame before: shift (2, H, W) pixels, known (H, W).
    remembered   (H, W): where the flow is known and the painter had a picture before this one.
    painted      the painter's picture;  raw: what it would be without the one before it, `painted_before`.
    moved        (2, H, W): the painter's own flow;  weight (1, H, W): the share that is painted anew.
    """

    labels: Tensor
    true: Tensor
    true_before: Tensor
    flow: Flow
    remembered: Tensor
    painted: Tensor
    raw: Tensor
    painted_before: Tensor
    moved: Tensor
    weight: Tensor


class Film(NamedTuple):
    """Three frames as a temporal critic is shown them: pictures and the flows between them, (B, 13, H, W) each."""

    true: Tensor
    painted: Tensor


class FilmCritics:
    """The losses of critics and painter, as published.

    networks  the task's, by role; the loop may replace them.
    option    weights SHARES of the losses, and vgg, the file of VGG-19 ("": there is no perceptual loss).
    closed    whether pictures close in azimuth.
    """

    def __init__(self, networks: Mapping[str, nn.Module], option: Mapping[str, Any], *, closed: bool) -> None:
        self.networks, self.closed = networks, closed
        self.share = {name: float(option[name]) for name in SHARES}
        self.vgg = read_vgg(str(option["vgg"])) if option["vgg"] else None
        self.logs: dict[str, Tensor] = {}

    def steps(self, painted: int) -> list[int]:
        """Frames between the pictures of each temporal critic; InputError where `painted` frames are too few for it."""
        numbers = [role.removeprefix(TEMPORAL) for role in self.networks if role.startswith(TEMPORAL)]
        if wrong := [number for number in numbers if not number.isdecimal() or not int(number)]:
            raise InputError(f"network {TEMPORAL}{wrong[0]}: its name must end in a number of frames, as temporal_3")
        steps = sorted(int(number) for number in numbers)
        if steps and painted < 2 * steps[-1] + 1:
            raise InputError(
                f"network {TEMPORAL}{steps[-1]}: of {painted} painted frames no three are {steps[-1]} apart; "
                f"set options.frames to {2 * steps[-1] + 3} or more"
            )
        return steps

    def updates(self, frame: Frame, films: Mapping[int, Film]) -> Iterator[tuple[str, Tensor]]:
        """The critic of pictures, those of films, the painter; `films` by the frames between their pictures."""
        self.logs = {}
        true, *shown = (torch.cat([frame.labels, picture], 1) for picture in (frame.true, frame.painted, frame.raw))
        real = self.asked("critic", true)
        yield "critic", sum_of([least_squares_critic(real, self.asked("critic", fake.detach())) for fake in shown])
        for step, film in films.items():
            role = f"{TEMPORAL}{step}"
            real, fake = self.asked(role, film.true), self.asked(role, film.painted.detach())
            yield role, least_squares_critic(real, fake)
        pairs = [("critic", true, fake) for fake in shown]
        pairs += [(f"{TEMPORAL}{step}", film.true, film.painted) for step, film in films.items()]
        losses = self.from_truth(frame)
        adversarial = [self.persuaded(*pair) for pair in pairs]
        losses["adversarial"] = sum_of([convinced for convinced, _ in adversarial])
        losses["features"] = self.share["features"] * sum_of([features for _, features in adversarial])
        self.logs = {name: loss.detach() for name, loss in losses.items()}
        yield "painter", sum_of(list(losses.values()))

    def from_truth(self, frame: Frame) -> dict[str, Tensor]:
        """The painter's losses that need no critic, by name, weighted; those of weight 0 are left out."""
        shift, known = frame.flow.shift, frame.flow.known
        share, closed = self.share, self.closed
        losses: dict[str, Tensor] = {}
        if share["flow"]:
            losses["flow"] = flow_loss(frame.moved, shift, known)
            losses["flow"] += warping_loss(frame.moved, frame.true_before, frame.true, known, closed=closed)
        if share["coherence"]:
            before = frame.painted_before
            losses["coherence"] = coherence_loss(frame.painted, before, shift, frame.remembered, closed=closed)
        if share["mask"]:
            losses["mask"] = mask_loss(frame.weight, frame.remembered)
        if share["pixels"]:
            losses["pixels"] = l1_loss(frame.painted, frame.true) + l1_loss(frame.raw, frame.true)
        if share["perceptual"] and self.vgg is not None:
            self.vgg.to(frame.true.device)
            real = self.vgg(frame.true)
            losses["perceptual"] = sum_of([perceptual(self.vgg(fake), real) for fake in (frame.painted, frame.raw)])
        return {name: share[name] * loss for name, loss in losses.items()}

    def persuaded(self, role: str, true: Tensor, painted: Tensor) -> tuple[Tensor, Tensor]:
        """How far a critic is from taking the painted for true, and from seeing the same in both."""
        with torch.no_grad():
            real = self.asked(role, true)
        fake = self.asked(role, painted)
        return least_squares_generator(fake), matched_features(real, fake)

    def asked(self, role: str, shown: Tensor) -> list[list[Tensor]]:
        """A critic's answer in float32: per scale, the features of every layer, scores last."""
        return [[layer.float() for layer in scale] for scale in self.networks[role](shown)]


def film(pictures: list[Tensor], flows: list[Flow]) -> Tensor:
    """Pictures (B, 3, H, W) and the flows between them as a temporal critic is shown them, the earliest first."""
    return torch.cat([*pictures, *(flow.shift / FLOW_PX for flow in flows)], 1)


def sum_of(losses: list[Tensor]) -> Tensor:
    """The sum as one tensor."""
    return torch.stack(losses).sum()
