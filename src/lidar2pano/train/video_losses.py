"""The losses of vid2vid's painter and discriminators, one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

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
from lidar2pano.train.options import VideoOptions

FLOW_PX = 20.0  # temporal discriminators read flow in units of these, as published
TEMPORAL = "temporal_"  # role of a temporal discriminator, followed by the number of frames between its images


class PaintedFrame(NamedTuple):
    """One frame of a clip; every tensor has a leading B. Images are (3, H, W) in [-1, 1].

    labels              (16, H, W) one-hot;  real, real_before: the camera's image and that before it.
    flow                the reference to the frame before: shift (2, H, W) pixels, known (H, W).
    coherent            (H, W): where the flow is known and the painter had a previous image.
    fake                the painter's image;  raw: the same without the warped previous one, `fake_before`.
    fake_flow           (2, H, W): the painter's own flow;  weight (1, H, W): the share of `raw` in `fake`.
    """

    labels: Tensor
    real: Tensor
    real_before: Tensor
    flow: Flow
    coherent: Tensor
    fake: Tensor
    raw: Tensor
    fake_before: Tensor
    fake_flow: Tensor
    weight: Tensor


class TemporalInput(NamedTuple):
    """The input of a temporal discriminator: three images and the flows between them, (B, 13, H, W) each."""

    real: Tensor
    fake: Tensor


class VideoLosses:
    """The losses of discriminators and painter, as published.

    networks  the task's, by role; the loop may replace them.
    options   the weights of the losses, and the file of VGG-19 ("": there is no perceptual loss).
    circular  whether the last column of an image meets its first.
    """

    def __init__(self, networks: Mapping[str, nn.Module], options: VideoOptions, *, circular: bool) -> None:
        self.networks, self.options, self.circular = networks, options, circular
        self.vgg = read_vgg(options.vgg_weights) if options.vgg_weights else None
        self.logs: dict[str, Tensor] = {}

    def steps(self, painted: int) -> list[int]:
        """Frames between the images of each temporal discriminator; InputError where `painted` frames are too few."""
        numbers = [role.removeprefix(TEMPORAL) for role in self.networks if role.startswith(TEMPORAL)]
        if wrong := [number for number in numbers if not number.isdecimal() or not int(number)]:
            raise InputError(f"network {TEMPORAL}{wrong[0]}: its name must end in a number of frames, as temporal_3")
        steps = sorted(int(number) for number in numbers)
        if steps and painted < 2 * steps[-1] + 1:
            raise InputError(
                f"network {TEMPORAL}{steps[-1]}: of {painted} painted frames no three are {steps[-1]} apart; "
                f"set options.clip_length to {2 * steps[-1] + 3} or more"
            )
        return steps

    def updates(self, frame: PaintedFrame, inputs: Mapping[int, TemporalInput]) -> Iterator[tuple[str, Tensor]]:
        """The image discriminator, the temporal ones, the painter; `inputs` by the frames between their images."""
        self.logs = {}
        true, *generated = (torch.cat([frame.labels, image], 1) for image in (frame.real, frame.fake, frame.raw))
        real = self.discriminated("critic", true)
        fakes = [self.discriminated("critic", fake.detach()) for fake in generated]
        yield "critic", _sum([least_squares_critic(real, fake) for fake in fakes])
        for step, triple in inputs.items():
            role = f"{TEMPORAL}{step}"
            real, fake = self.discriminated(role, triple.real), self.discriminated(role, triple.fake.detach())
            yield role, least_squares_critic(real, fake)
        pairs = [("critic", true, fake) for fake in generated]
        pairs += [(f"{TEMPORAL}{step}", triple.real, triple.fake) for step, triple in inputs.items()]
        losses = self.reconstruction(frame)
        adversarial = [self.adversarial(*pair) for pair in pairs]
        losses["adversarial"] = _sum([loss for loss, _ in adversarial])
        losses["feature_matching"] = self.options.feature_matching * _sum([features for _, features in adversarial])
        self.logs = {name: loss.detach() for name, loss in losses.items()}
        yield "painter", _sum(list(losses.values()))

    def reconstruction(self, frame: PaintedFrame) -> dict[str, Tensor]:
        """The painter's losses without a discriminator, by name, weighted; those of weight 0 are left out."""
        options, circular = self.options, self.circular
        shift, known = frame.flow.shift, frame.flow.known
        losses: dict[str, Tensor] = {}
        if options.flow:
            flow = flow_loss(frame.fake_flow, shift, known)
            flow += warping_loss(frame.fake_flow, frame.real_before, frame.real, known, circular=circular)
            losses["flow"] = options.flow * flow
        if options.coherence:
            coherence = coherence_loss(frame.fake, frame.fake_before, shift, frame.coherent, circular=circular)
            losses["coherence"] = options.coherence * coherence
        if options.mask:
            losses["mask"] = options.mask * mask_loss(frame.weight, frame.coherent)
        if options.pixels:
            losses["pixels"] = options.pixels * (l1_loss(frame.fake, frame.real) + l1_loss(frame.raw, frame.real))
        if options.perceptual and self.vgg is not None:
            self.vgg.to(frame.real.device)
            real = self.vgg(frame.real)
            parts = [perceptual(self.vgg(fake), real) for fake in (frame.fake, frame.raw)]
            losses["perceptual"] = options.perceptual * _sum(parts)
        return losses

    def adversarial(self, role: str, real: Tensor, fake: Tensor) -> tuple[Tensor, Tensor]:
        """The painter's least-squares and feature-matching losses against one discriminator."""
        with torch.no_grad():
            on_real = self.discriminated(role, real)
        on_fake = self.discriminated(role, fake)
        return least_squares_generator(on_fake), matched_features(on_real, on_fake)

    def discriminated(self, role: str, images: Tensor) -> list[list[Tensor]]:
        """A discriminator's outputs in float32: per scale, the features of every layer, scores last."""
        return [[layer.float() for layer in scale] for scale in self.networks[role](images)]


def temporal_input(images: list[Tensor], flows: list[Flow]) -> Tensor:
    """Images (B, 3, H, W) and the flows between them as a temporal discriminator reads them, the earliest first."""
    return torch.cat([*images, *(flow.shift / FLOW_PX for flow in flows)], 1)


def _sum(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).sum()
