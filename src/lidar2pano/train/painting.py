"""Task: the painter on the camera's images, in panorama coordinates, against a patch discriminator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, l1_loss, mse_loss
from torch.utils.data import default_collate

from lidar2pano.data.frames import IGNORE
from lidar2pano.data.panorama_crops import PanoramaDataset, PanoramaSample
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.losses import feature_matching, hinge_critic, hinge_generator, pooled
from lidar2pano.losses.diff_augment import DiffAugment
from lidar2pano.models.card import load
from lidar2pano.models.titan_pano import STRIDE, depth_code
from lidar2pano.train.options import PaintingOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import as_image, build_networks, device_of, load_segmenter
from lidar2pano.views import VIEWS


class Painting:
    """Trains a painter: hinge loss, feature matching, and the distances of pooled colours and of pixels.

    Pooled colours are compared by squared error, whose best estimate is the mean: the absolute distance would paint
    what is in the sun in some images and in the shade in most as if it were always in the shade.
    """

    released = ("painter",)

    def __init__(self, recipe: Recipe[PaintingOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view].scaled(recipe.scale), recipe.options
        columns, shift_px = recipe.options.columns, recipe.options.shift_px
        if not recipe.options.translator or not recipe.options.segmenter:
            raise InputError(f"recipe {recipe.name!r} needs --set options.translator=FILE and options.segmenter=FILE")
        self.dataset = PanoramaDataset(root, recipe.data.train, self.view, columns, image=True, shift_px=shift_px)
        whole = (columns + 2 * shift_px) // STRIDE * STRIDE
        self.validation = PanoramaDataset(root, recipe.data.val, self.view, whole, image=True, shift_px=0)
        self.networks = build_networks(recipe)
        self.translator, _ = load(self.options.translator, expect="titan-pano")
        label_points = load_segmenter(self.options.segmenter)
        for samples in (self.dataset, self.validation):
            samples.predict(label_points, self.options.segmenter)
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: PanoramaSample) -> Iterator[tuple[str, Tensor]]:
        """Discriminator loss (if weighted), then generator loss."""
        options = self.options
        teacher = torch.rand(len(batch.camera_labels)) < options.teacher_label_probability
        segments, depth_m = self.painter_inputs(batch, teacher)
        fake = self.networks["painter"](segments, depth_m, batch.range_image).float()
        valid = batch.valid[:, None].float()
        coarse = mse_loss(pooled(fake * valid), pooled(batch.image * valid))
        pixels = l1_loss(fake * valid, batch.image * valid)
        self.logs = {"pooled": coarse.detach(), "pixels": pixels.detach()}
        loss = options.pooled * coarse + options.pixels * pixels
        if options.adversarial or options.feature_matching:
            condition = torch.cat([segments, depth_code(depth_m)[:, None]], 1)
            condition = interpolate(condition, scale_factor=2.0, mode="nearest")
            augment = DiffAugment.drawn(len(fake), options.augment_probability)
            real, generated = (augment.apply(colour, valid, condition) for colour in (batch.image, fake))
            on_real, on_fake = (self.discriminated(image) for image in (real, generated.detach()))
            yield "critic", _mean([hinge_critic(r[-1], f[-1]) for r, f in zip(on_real, on_fake, strict=True)])
            with torch.no_grad():
                on_real = self.discriminated(real)
            on_fake = self.discriminated(generated)
            adversarial = _mean([hinge_generator(f[-1]) for f in on_fake])
            features = _mean([feature_matching(r[:-1], f[:-1]) for r, f in zip(on_real, on_fake, strict=True)])
            self.logs |= {"adversarial": adversarial.detach(), "feature_matching": features.detach()}
            loss = loss + options.adversarial * adversarial + options.feature_matching * features
        yield "painter", loss

    def discriminated(self, image: Tensor) -> list[list[Tensor]]:
        """The discriminator's outputs in float32: per scale, the features of every layer, scores last."""
        return [[layer.float() for layer in scale] for scale in self.networks["critic"](image)]

    @torch.no_grad()
    def painter_inputs(self, batch: PanoramaSample, teacher: Tensor) -> tuple[Tensor, Tensor]:
        """Segments (B, 16, H, W), probabilities, and depths (B, H, W) in metres, by the translator.

        teacher  (B,) bool: samples whose segments are the camera teacher's labels, where it is sure.
        """
        device = batch.range_image.device
        self.translator.to(device)
        with fast_arithmetic(device):
            condition = one_hot_layers(batch.segments, len(SEMANTIC_KITTI))
            logits, depth_m = self.translator(batch.range_image, condition)
        sure = (batch.camera_labels != IGNORE) & teacher.to(device)[:, None, None]
        labels = one_hot_layers(batch.camera_labels.where(sure, 0), len(COMMON15))
        return torch.where(sure[:, None], labels, logits.float().softmax(1)), depth_m

    def paint(self, index: int) -> tuple[Tensor, PanoramaSample]:
        """A validation frame's sector, painted from the scan alone: (3, 2H, 2W) in [-1, 1]; and the sample."""
        network = self.networks["painter"]
        device = device_of(network)
        sample = self.validation[index]
        one = default_collate([sample])
        moved = {part: getattr(one, part).to(device) for part in ("range_image", "segments", "camera_labels")}
        one = one._replace(**moved)
        segments, depth_m = self.painter_inputs(one, teacher=torch.zeros(1, dtype=torch.bool))
        with torch.inference_mode(), fast_arithmetic(device):
            return network(segments, depth_m, one.range_image)[0].float().cpu(), sample

    def validate(self) -> dict[str, float]:
        """Mean distance of pooled colours in [0, 1] over the camera's sector; the score is its negative."""
        distances = []
        for index in range(len(self.validation)):
            fake, sample = self.paint(index)
            valid = sample.valid.float()
            gap = pooled((fake - sample.image) * valid).abs().mean() / valid.mean() / 2
            distances.append(gap.item())
        distance = float(np.mean(distances))
        return {"score": -distance, "pooled_colour": distance}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera above painter, for three validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.validation))):
            fake, sample = self.paint(index)
            rows += [sample.image * sample.valid, fake]
        return {"image": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the painter has to know: the raster of its input."""
        return {"labels": None, "views": {"panorama": self.view.as_dict()}}


def _mean(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).mean()
