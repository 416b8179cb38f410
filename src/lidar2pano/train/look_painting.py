"""Task: a scene painter's new look, from images that have labels and no scans.

Images and what is painted show different places, so nothing is compared pixel by pixel: patches of a class are drawn
to the distribution of the images' patches of that class, in colour and in frozen features (PatchStatistics). There is
no critic.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

from lidar2pano.data.frames import IGNORE
from lidar2pano.data.layouts import frames_of
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses.patch_statistics import PATCH, STRIDE, Distribution, DistributionLoss
from lidar2pano.models.added_look import train_last_look, with_look
from lidar2pano.models.card import load
from lidar2pano.models.families import weight_files
from lidar2pano.models.imagenet_features import LITE0, ImagenetFeatures
from lidar2pano.models.scene_painter import TONE, Known, ScenePainter, framed, outlined, painter_inputs, with_cars
from lidar2pano.pipeline import Pipeline, load_part, load_segmenter
from lidar2pano.train.look_samples import LookSample, LookSamples
from lidar2pano.train.options import LookOptions
from lidar2pano.train.painting_frames import made_by
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import as_image, device_of, fix_norms
from lidar2pano.views import VIEWS

COLOURS = 4  # pixels of the image, each way, whose mean is one colour
DEPTHS = 3  # of features that are compared, beside colours
DOMINANT = 0.7  # least share of a patch that is of one class, for the patch to be of it


class LookPainting:
    """Trains what is a new look's alone in a painter that knows other looks already: see `with_look`."""

    released = ("painter",)

    def __init__(self, recipe: Recipe[LookOptions], root: Path) -> None:
        self.options, self.view = recipe.options, VIEWS[recipe.view].scaled(recipe.scale)
        if not recipe.options.weights:
            raise InputError(f"recipe {recipe.name!r} needs --set options.weights=FAMILY: its painter learns")
        files = weight_files(recipe.options.weights)
        painter, self.source = load(files["painter"], expect="scene-painter")
        painter, self.settings = with_look(cast(ScenePainter, painter), dict(self.source.settings), recipe.options.look)
        train_last_look(painter)
        self.networks: dict[str, torch.nn.Module] = {"painter": painter}
        self.painter = painter
        cpu = torch.device("cpu")
        segmenter, _ = load_segmenter(files["segmenter"], cpu)
        translator, _ = load_part(files["translator"], cpu, expect="titan-pano")
        pipeline = Pipeline(segmenter=segmenter, translator=translator, painter=painter, view=self.view, device=cpu)
        networks = made_by(self.view, str(files["segmenter"]), str(files["translator"]))
        self.dataset = LookSamples(frames_of(root, recipe.data.train), pipeline, recipe.options, networks)
        self.features = ImagenetFeatures.load(LITE0)
        sizes = (3, *LITE0.channels[:DEPTHS])
        self.statistics = [[DistributionLoss(size) for size in sizes] for _ in COMMON15.classes]
        self.all_classes = [Distribution(size) for size in sizes]  # of the images' patches, of each depth
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: LookSample) -> Iterator[tuple[str, Tensor]]:
        """The painter."""
        self.features.to(batch.depth_m.device)
        fake, segments = self.painted(batch)
        real = batch.image
        known = batch.labels.masked_fill(avg_pool2d(batch.valid[:, None].float(), 2)[:, 0] < 1, IGNORE)
        with fast_arithmetic(batch.depth_m.device):
            with torch.no_grad():
                on_real = self._layers(real)
            on_fake = self._layers(fake)
        terms = [
            self._distance(depth, one.float(), other.float(), known, segments.max(1).indices)
            for depth, (one, other) in enumerate(zip(on_real, on_fake, strict=True))
        ]
        weights = [self.options.colours] + [self.options.statistics] * DEPTHS
        names = ["colours", *(f"features {depth}" for depth in range(1, DEPTHS + 1))]
        self.logs = {name: term.detach() for name, term in zip(names, terms, strict=True)}
        total = torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)]).sum()
        yield "painter", total + 0 * fake.sum()  # until the statistics are known, no gradient comes from them

    def painted(self, batch: LookSample) -> tuple[Tensor, Tensor]:
        """The scenes in the new look (B, 3, 2H, 2W) float32 in [-1, 1], and their segments (B, 16, H, W)."""
        painter = self.networks["painter"]
        fix_norms(painter)
        with torch.no_grad():
            samples, columns = len(batch.depth_m), batch.depth_m.shape[2]
            pose = np.eye(4)
            pose[:3, 3] = np.random.uniform(0, 64, 3)  # noqa: NPY002 seeded by the loop, step by step
            window = self.view.window(int(np.random.randint(self.view.columns)), columns)  # noqa: NPY002
            segments, depth_m, tones, _ = with_cars(batch.segments.float(), batch.depth_m, window, pose)
            segments = outlined(segments, self.painter.sharp, depth_m, window, pose)
            known = Known(tones)
            inputs = painter_inputs(segments, depth_m, batch.channels, window, pose, known, self.painter.unread)
            shares = torch.eye(len(self.painter.looks), device=depth_m.device)[-1:].expand(samples, -1)
        return painter(*framed(*inputs), shares, shares.new_zeros(samples, TONE)).float(), segments

    def _layers(self, image: Tensor) -> list[Tensor]:
        """Colours and features that are compared, (B, C, h, w) at 1/4, 1/4, 1/8, 1/16 of the image."""
        features = self.features(image.contiguous(memory_format=torch.channels_last))
        return [avg_pool2d(image.float(), COLOURS), *features[:DEPTHS]]

    def _distance(self, depth: int, real: Tensor, painted: Tensor, known: Tensor, classes: Tensor) -> Tensor:
        """Mean distance of the painted patches at a depth from their classes' distributions."""
        size = (real.shape[2], real.shape[3])
        if min(size) < PATCH:  # the raster is too small for patches of such deep features
            return painted.new_zeros(())
        real_patches, painted_patches = (avg_pool2d(part, PATCH, STRIDE).movedim(1, 3) for part in (real, painted))
        real_ids, painted_ids = patch_classes(known, size, whole=True), patch_classes(classes, size)
        if (real_ids != IGNORE).any():
            self.all_classes[depth].update(real_patches[real_ids != IGNORE])
        variance = self.all_classes[depth].covariance.trace()
        total, count = painted.new_zeros(()), 0
        for number in torch.cat([real_ids, painted_ids], 2).unique().tolist():
            if number in (0, IGNORE):
                continue
            chosen = painted_ids == number
            here = self.statistics[number][depth](real_patches[real_ids == number], painted_patches[chosen], variance)
            total, count = total + here * chosen.sum(), count + int(chosen.sum())
        return total / max(count, 1)

    def validate(self) -> dict[str, float]:
        """Mean distance in [0, 1] of the classes' mean colours, as of the last steps; no score: the latest counts."""
        pairs = [depths[0] for depths in self.statistics if depths[0].step]
        gaps = [float((pair.real.first - pair.painted.first).abs().mean()) / 2 for pair in pairs]
        return {"class colours": float(np.mean(gaps)) if gaps else float("nan")}

    def preview(self) -> dict[str, np.ndarray]:
        """Images above scenes as they are painted, three of each, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.dataset))):
            sample = self.dataset[index]
            device = device_of(self.networks["painter"])
            fake, _ = self.painted(LookSample(*(part[None].to(device) for part in sample)))
            rows += [sample.image * sample.valid, fake[0].cpu()]
        return {"image": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """The painter's card with the new look; its licence holds for what was made from it."""
        return {
            "settings": self.settings,
            "labels": None,
            "views": {"panorama": self.view.as_dict()},
            "licence": self.source.licence,
        }


def patch_classes(ids: Tensor, size: tuple[int, int], *, whole: bool = False) -> Tensor:
    """The class of each patch of a raster: that of at least DOMINANT of it, IGNORE where there is none.

    ids    (B, H, W) int64 of COMMON15 or IGNORE;  size: rows and columns of the raster that patches are cut from.
    whole  whether only patches count of which every pixel is known.
    Returns (B, h, w) int64, for the patches of avg_pool2d(..., PATCH, STRIDE).
    """
    known = ids != IGNORE
    layers = one_hot_layers(ids.where(known, 0), len(COMMON15)) * known[:, None]
    shares = avg_pool2d(adaptive_avg_pool2d(layers.float(), size), PATCH, STRIDE)
    best, found = shares.max(1)
    counted = best >= DOMINANT
    if whole:
        counted &= shares.sum(1) > 0.999
    return found.where(counted, IGNORE)
