"""vid2vid: options, losses, task and recipes.

The painter learns from classes and its own previous images, against discriminators of images and of clips.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import l1_loss
from torch.utils.data import default_collate

from lidar2pano.data.clips import ClipDataset, ClipSample, Framing
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.errors import InputError
from lidar2pano.geometry.flow import Flow, chained
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.geometry.rasters import as_image, warp
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import pooled
from lidar2pano.losses.painting import (
    least_squares_critic,
    least_squares_generator,
    masked_l1,
    matched_features,
    perceptual,
)
from lidar2pano.models.card import load
from lidar2pano.models.frozen_features import read_vgg
from lidar2pano.train.recipe import (
    Data,
    Network,
    Optimizer,
    Recipe,
    TaskOptions,
    Training,
    on_two_cores,
    vary,
    with_optimizers,
)
from lidar2pano.train.task import build_networks, device_of
from lidar2pano.views import VIEWS

FLOW_PX = 20.0  # temporal discriminators read flow in units of these, as published
TEMPORAL = "temporal_"  # role of a temporal discriminator, followed by the number of frames between its images
PREVIOUS = 2  # previous images in the painter's input
MOST_SCORED = 20  # clips of the validation split


@dataclass(frozen=True, kw_only=True)
class VideoOptions(TaskOptions):
    """vid2vid.

    source                   "camera" images, or the "panorama" ground truth of simulated data sets.
    clip_length              frames of a clip, the first two given;  rows, columns: of its window.
    single_frame_splits      splits whose frames do not follow each other; a window pans over each.
    no_previous_probability  of clips without previous images at their beginning, as in a stream.
    first_frame_weights      weight file of the first-frame network for clips of validation; "": they begin with
                             nothing or, if no_previous_probability is 0, with ground truth.
    feature_matching, flow, coherence, mask, perceptual, pixels: weights of losses.
    vgg_weights              file of VGG-19's weights; "": no perceptual loss.
    """

    task = "video"
    SIZES = ("clip_length", "rows", "columns")
    source: Literal["camera", "panorama"] = "camera"
    clip_length: int = 12
    rows: int = 160
    columns: int = 512
    single_frame_splits: tuple[str, ...] = ()
    no_previous_probability: float = 0.33
    first_frame_weights: str = ""
    feature_matching: float = 10.0
    flow: float = 10.0
    coherence: float = 10.0
    mask: float = 1.0
    perceptual: float = 10.0
    pixels: float = 0.0
    vgg_weights: str = ""


class PaintedFrame(NamedTuple):
    """One frame of a clip; every tensor has a leading B. Images are (3, H, W) in [-1, 1].

    labels              (16, H, W) one-hot;  real, real_before: the camera's image and the previous one.
    flow                the reference to the frame before: shift (2, H, W) pixels, known (H, W).
    coherent            (H, W): pixels of known flow, of samples with a previous image.
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


def temporal_steps(roles: Iterable[str], painted: int) -> list[int]:
    """Frames between the images of each temporal discriminator; InputError when `painted` frames are too few."""
    numbers = [role.removeprefix(TEMPORAL) for role in roles if role.startswith(TEMPORAL)]
    if wrong := [number for number in numbers if not number.isdecimal() or not int(number)]:
        raise InputError(f"network {TEMPORAL}{wrong[0]}: its name must end in a number of frames, as temporal_3")
    steps = sorted(int(number) for number in numbers)
    if steps and painted < 2 * steps[-1] + 1:
        raise InputError(
            f"network {TEMPORAL}{steps[-1]}: of {painted} painted frames no three are {steps[-1]} apart; "
            f"set options.clip_length to {2 * steps[-1] + 3} or more"
        )
    return steps


def _sum(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).sum()


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
        self.steps = temporal_steps(self.networks, options.clip_length - PREVIOUS)
        self.vgg = read_vgg(options.vgg_weights) if options.vgg_weights else None
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
            for name, loss in (yield from self.frame_updates(frame, inputs)).items():
                sums.setdefault(name, []).append(loss.detach())
            painted[-1] = frame.fake.detach()
            previous = torch.cat([previous[:, 1:], painted[-1][:, None]], 1)
        self.logs = {name: torch.stack(values).mean() for name, values in sums.items()}

    def frame_updates(
        self, frame: PaintedFrame, inputs: Mapping[int, tuple[Tensor, Tensor]]
    ) -> Generator[tuple[str, Tensor], None, dict[str, Tensor]]:
        """The image discriminator, the temporal ones, the painter; returns the painter's losses by name.

        inputs  real and painted images of each temporal one (`temporal`), by the frames between them.
        """
        true, *generated = (torch.cat([frame.labels, image], 1) for image in (frame.real, frame.fake, frame.raw))
        real = self.discriminated("critic", true)
        fakes = [self.discriminated("critic", fake.detach()) for fake in generated]
        yield "critic", _sum([least_squares_critic(real, fake) for fake in fakes])
        temporal = [(f"{TEMPORAL}{step}", *pair) for step, pair in inputs.items()]
        for role, real, fake in temporal:
            yield role, least_squares_critic(self.discriminated(role, real), self.discriminated(role, fake.detach()))
        losses = self.reconstruction(frame)
        adversarial, features = [], []
        for role, real, fake in [*(("critic", true, fake) for fake in generated), *temporal]:
            with torch.no_grad():
                on_real = self.discriminated(role, real)
            on_fake = self.discriminated(role, fake)
            adversarial.append(least_squares_generator(on_fake))
            features.append(matched_features(on_real, on_fake))
        losses["adversarial"] = _sum(adversarial)
        losses["feature_matching"] = self.options.feature_matching * _sum(features)
        yield "painter", _sum(list(losses.values()))
        return losses

    def reconstruction(self, frame: PaintedFrame) -> dict[str, Tensor]:
        """The painter's losses without a discriminator, by name, weighted; those of weight 0 are left out.

        flow                 equation 8 of the paper, both parts;  perceptual, pixels: of `fake` and `raw`.
        coherence, mask      in the published code only (G_Warp, and loss W with --no_first_img): `fake` is near the
                             warped image before, and most of that is left if its flow is known.
        """
        options, circular, flow_known = self.options, self.framing.circular, frame.flow.known
        losses: dict[str, Tensor] = {}
        if options.flow:
            warped = warp(frame.real_before, frame.fake_flow, circular=circular)
            flow = masked_l1(frame.fake_flow, frame.flow.shift, flow_known)
            losses["flow"] = options.flow * (flow + masked_l1(warped, frame.real, flow_known))
        if options.coherence:
            warped = warp(frame.fake_before, frame.flow.shift, circular=circular).detach()
            losses["coherence"] = options.coherence * masked_l1(frame.fake, warped, frame.coherent)
        if options.mask:
            losses["mask"] = options.mask * masked_l1(frame.weight, torch.zeros_like(frame.weight), frame.coherent)
        if options.pixels:
            losses["pixels"] = options.pixels * (l1_loss(frame.fake, frame.real) + l1_loss(frame.raw, frame.real))
        if options.perceptual and self.vgg is not None:
            self.vgg.to(frame.real.device)
            real = self.vgg(frame.real)
            parts = [perceptual(self.vgg(fake), real) for fake in (frame.fake, frame.raw)]
            losses["perceptual"] = options.perceptual * _sum(parts)
        return losses

    def discriminated(self, role: str, images: Tensor) -> list[list[Tensor]]:
        """A discriminator's outputs in float32: per scale, the features of every layer, scores last."""
        return [[layer.float() for layer in scale] for scale in self.networks[role](images)]

    def frame(self, batch: ClipSample, labels: Tensor, previous: Tensor, now: int, first: Tensor) -> PaintedFrame:
        """Paint frame `now` after the images `previous` (B, 2, 3, H, W).

        first  (B,) bool: samples without previous images; `raw` is all of their image, as published.
        """
        output = self.networks["painter"](labels[:, now - PREVIOUS : now + 1], previous)
        image, flow, weight, raw = (part.float() for part in output)
        reference = self.flow_over(batch, now, 1)
        return PaintedFrame(
            labels=labels[:, now],
            real=batch.image[:, now],
            real_before=batch.image[:, now - 1],
            flow=reference,
            coherent=reference.known.masked_fill(first[:, None, None], 0),
            fake=torch.where(first[:, None, None, None], raw, image),
            raw=raw,
            fake_before=previous[:, -1],
            fake_flow=flow,
            weight=weight,
        )

    def temporal(self, batch: ClipSample, painted: list[Tensor], step: int) -> tuple[Tensor, Tensor]:
        """Return inputs (B, 13, H, W), real and painted: three images `step` frames apart, and the flows between."""
        now = PREVIOUS + len(painted) - 1
        flows = [self.flow_over(batch, end, step).shift / FLOW_PX for end in (now - step, now)]
        real = [batch.image[:, now - back * step] for back in (2, 1, 0)]
        fake = [painted[-1 - back * step] for back in (2, 1, 0)]
        return torch.cat([*real, *flows], 1), torch.cat([*fake, *flows], 1)

    def flow_over(self, batch: ClipSample, now: int, step: int) -> Flow:
        """Reference flow of a frame to the frame `step` earlier."""
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
        flicker          mean distance in [0, 1] of an image from the one before it, warped by the reference flow
                         as far as known; flicker_of_real likewise, of the camera's: noise, and errors of the flow.
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
        flow_known = clip.known[PREVIOUS:]
        return ((images[PREVIOUS:] - warped).abs().mean(1) * flow_known).sum() / flow_known.sum().clamp(min=1) / 2

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
        """Its classes, and a panorama's raster with objects as large as in its training images."""
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


def vid2vid() -> Recipe[VideoOptions]:
    """vid2vid's one-scale street network with the published settings, on clips of the camera's images.

    Published (NVIDIA/vid2vid, train.py --loadSize 512 --fg): Adam 2e-4, least squares, feature matching, flow and
    coherence 10, two scales of two temporal discriminators, one clip a step, first images given; 20 epochs, with
    a linear fall of the rate in their second half (--niter 10 --niter_decay 10). 60,000 steps are 20 epochs of the
    2,975 clips of Cityscapes. Ours: classes of common-15 without instances' edges (1 is the car), and a window of the
    published size in images half the camera's size, as fine as half the panorama's raster. The perceptual loss needs
    options.vgg_weights. A third of the clips begins without previous images (published: --no_first_img, all or none),
    so that a stream can.
    """
    adam = Optimizer(algorithm="adam", rate=2e-4, betas=(0.5, 0.999), schedule="linear")
    blocks = {"downsamplings": 3, "blocks": (9, 3), "foreground": (1,), "batch_statistics": True}
    painter = {"channels": 16, "widths": (128,), **blocks}
    temporal = Network(model="vid2vid-temporal-critic", settings={"channels": 13, "width": 64}, optimizer=adam)
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="vid2vid", settings=painter, optimizer=adam),
            "critic": Network(model="vid2vid-image-critic", settings={"channels": 19, "width": 64}, optimizer=adam),
            "temporal_1": temporal,
            "temporal_3": temporal,
        },
        options=VideoOptions(),
        training=Training(steps=60_000, batch=1, ema=0.0, precision="32-true"),
    )


def vid2vid_mini() -> Recipe:
    """A narrow vid2vid on `kitti-mini` in some minutes of two CPU cores.

    Twelve frames of one drive follow each other; the others become clips under a panning window. So the network
    learns to colour classes, to warp images along flows of a few pixels, and to keep still; not parallax, traffic
    or other light, nor flows other than a panning window's. In so few steps VGG's features are replaced
    by the pixels themselves and rates are higher. The flow loss, whose published weight would dominate the features
    shared by flow and image, weighs less; so does the mask loss, since it blurs images until flow is learned.
    """
    recipe = with_optimizers(vid2vid(), rate=5e-4, schedule="cosine")
    narrow = {"painter": {"widths": (16,), "blocks": (4, 3), "foreground": ()}}
    clips = {"clip_length": 5, "rows": 128, "columns": 384, "single_frame_splits": ("train", "val")}
    losses = {"flow": 1.0, "mask": 0.1, "pixels": 20.0}
    recipe = vary(
        recipe,
        options={**clips, **losses, "no_previous_probability": 0.5},
        **{role: narrow.get(role, {"width": 16}) for role in recipe.networks},
    )
    networks = {role: network for role, network in recipe.networks.items() if role != "temporal_3"}
    recipe = replace(recipe, networks=networks, data=Data(train=("drive", "train"), val=("val",)))
    return on_two_cores(recipe, minutes=12.0, batch=1, precision="bf16-mixed")


RECIPES: dict[str, Callable[[], Recipe]] = {"vid2vid": vid2vid, "vid2vid-mini": vid2vid_mini}
