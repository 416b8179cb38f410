"""Task: the painter on the camera's pictures, in panorama coordinates, against a patch critic."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, l1_loss, mse_loss
from torch.utils.data import default_collate

from lidar2pano.data.panoramas import PanoramaSample, PanoramaSamples
from lidar2pano.data.sequences import UNSURE
from lidar2pano.errors import InputError
from lidar2pano.geometry.images import one_hot_layers
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import feature_matching, hinge_critic, hinge_generator
from lidar2pano.losses.diff_augment import Changes
from lidar2pano.models.card import load
from lidar2pano.models.titan_pano import STRIDE, depth_code
from lidar2pano.pipeline import Segmenter
from lidar2pano.train.panorama import conditions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS

BROAD = 4  # pixels: colours are compared as means over squares of this size


class Painting:
    """Trains a painter: hinge loss, feature matching, and the distance of broad colours and of pixels.

    Broad colours are compared by their squares, whose best guess is the mean: of what is now in the sun and now in the
    shade the absolute distance would paint the shade.

    Options: columns and jitter, crop and how far it moves, on the translator's raster; translator and segmenter,
    weight files that make the segments and depths to paint; trust, share of the draws that take the camera teacher's
    segments where it is sure; adversarial, features, broad, pixels: weights of those losses (no critic where the first
    two are 0); augment, the chance of each kind of change that the critic sees pictures with (losses.diff_augment).
    """

    released = ("painter",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.view = VIEWS[recipe.view].scaled(recipe.scale)
        option = recipe.options
        if not option["translator"] or not option["segmenter"]:
            raise InputError(f"recipe {recipe.name!r} needs --set options.translator=FILE and options.segmenter=FILE")
        columns, jitter = int(option["columns"]), int(option["jitter"])
        self.dataset = PanoramaSamples(root, recipe.data.train, self.view, columns, colour=True, jitter=jitter)
        whole = (columns + 2 * jitter) // STRIDE * STRIDE
        self.validation = PanoramaSamples(root, recipe.data.val, self.view, whole, colour=True, jitter=0)
        self.networks = build_networks(recipe)
        self.translator, _ = load(str(option["translator"]), expect="titan-pano")
        segmenter = Segmenter.from_card(*load(str(option["segmenter"]), expect="salsanext"))
        for samples in (self.dataset, self.validation):
            samples.predict(segmenter.points)
        self.weights = {name: float(option[name]) for name in ("adversarial", "features", "broad", "pixels")}
        self.trust, self.augment = float(option["trust"]), float(option["augment"])
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: PanoramaSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, unless its word weighs nothing, then the painter."""
        segments, depth_m = self.scene(batch, trust=torch.rand(len(batch.camera)) < self.trust)
        fake = self.networks["painter"](segments, depth_m, batch.image).float()
        seen = batch.seen[:, None].float()
        broad = mse_loss(avg_pool2d(fake * seen, BROAD), avg_pool2d(batch.colour * seen, BROAD))
        pixels = l1_loss(fake * seen, batch.colour * seen)
        self.logs = {"broad": broad.detach(), "pixels": pixels.detach()}
        loss = self.weights["broad"] * broad + self.weights["pixels"] * pixels
        if self.weights["adversarial"] or self.weights["features"]:
            told = torch.cat([segments, depth_code(depth_m)[:, None]], 1)
            told = interpolate(told, scale_factor=2.0, mode="nearest")
            changes = Changes.drawn(len(fake), self.augment)
            real, shown = (changes.of(colours, seen, told) for colours in (batch.colour, fake))
            on_real, on_fake = (self.judged(picture) for picture in (real, shown.detach()))
            yield "critic", _mean([hinge_critic(r[-1], f[-1]) for r, f in zip(on_real, on_fake, strict=True)])
            with torch.no_grad():
                on_real = self.judged(real)
            on_fake = self.judged(shown)
            adversarial = _mean([hinge_generator(f[-1]) for f in on_fake])
            features = _mean([feature_matching(r[:-1], f[:-1]) for r, f in zip(on_real, on_fake, strict=True)])
            self.logs |= {"adversarial": adversarial.detach(), "features": features.detach()}
            loss = loss + self.weights["adversarial"] * adversarial + self.weights["features"] * features
        yield "painter", loss

    def judged(self, picture: Tensor) -> list[list[Tensor]]:
        """The critic's answers in float32: per scale, the features of every layer, scores last."""
        return [[layer.float() for layer in scale] for scale in self.networks["critic"](picture)]

    @torch.no_grad()
    def scene(self, batch: PanoramaSample, trust: Tensor) -> tuple[Tensor, Tensor]:
        """What is to be painted: segments (B, 16, H, W), probabilities, and depths (B, H, W) in metres.

        trust  (B,) bool: samples whose segments are the camera teacher's, where it is sure.
        """
        device = batch.image.device
        self.translator.to(device)
        with fast_arithmetic(device):
            logits, depth_m = self.translator(batch.image, conditions(batch.segments))
        segments = logits.float().softmax(1)
        sure = (batch.camera != UNSURE) & trust.to(device)[:, None, None]
        teacher = one_hot_layers(batch.camera.where(sure, 0), len(COMMON15))
        return torch.where(sure[:, None], teacher, segments), depth_m

    def paint(self, index: int) -> tuple[Tensor, PanoramaSample]:
        """A validation frame's sector, painted from the scan alone: (3, 2H, 2W) in [-1, 1]; and the sample."""
        network = self.networks["painter"]
        device = next(network.parameters()).device
        sample = self.validation[index]
        one = default_collate([sample])
        one = one._replace(image=one.image.to(device), segments=one.segments.to(device), camera=one.camera.to(device))
        segments, depth_m = self.scene(one, trust=torch.zeros(1, dtype=torch.bool))
        with torch.inference_mode(), fast_arithmetic(device):
            return network(segments, depth_m, one.image)[0].float().cpu(), sample

    def validate(self) -> dict[str, float]:
        """Mean distance of broad colours in [0, 1] over the camera's sector; the score is its negative."""
        distances = []
        for index in range(len(self.validation)):
            fake, sample = self.paint(index)
            seen = sample.seen.float()
            gap = avg_pool2d((fake - sample.colour) * seen, BROAD).abs().mean() / seen.mean() / 2
            distances.append(gap.item())
        distance = float(np.mean(distances))
        return {"score": -distance, "broad_colour": distance}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera above painter, for three validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.validation))):
            fake, sample = self.paint(index)
            rows += [sample.colour * sample.seen, fake]
        pictures = torch.cat(rows, 1).movedim(0, 2)
        return {"picture": ((pictures + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).numpy()}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the painter has to know: the label set it reads and the raster it reads it on."""
        return {"labels": None, "views": {"panorama": self.view.as_dict()}}


def _mean(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).mean()
