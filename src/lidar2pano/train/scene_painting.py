"""Task: the scene painter on real and simulated pictures at once, against heads on frozen features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, mse_loss

from lidar2pano.appearance.cars import with_cars
from lidar2pano.appearance.painter_inputs import (
    OPENINGS,
    TONES,
    Hints,
    framed,
    painter_inputs,
    sharpened,
    twice,
)
from lidar2pano.data.frames import IGNORE
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.geometry.rasters import as_image
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import (
    PatchStatistics,
    hinge_critic,
    hinge_generator,
    inside,
    pooled,
    streaks,
)
from lidar2pano.losses.adversarial import DiffAugment, frozen
from lidar2pano.models.frozen_features import LITE0, ImagenetFeatures
from lidar2pano.models.scene_painter import ScenePainter
from lidar2pano.pipeline import assemble, load_part, load_segmenter
from lidar2pano.scene.depth import depth_code
from lidar2pano.scene.record import Scene
from lidar2pano.train.painter_recipes import ScenePaintingOptions
from lidar2pano.train.painting_frames import PaintingFrames, PaintingSample
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import Teacher, build_networks, device_of, fix_norms
from lidar2pano.views import VIEWS, View

NAMES = ("road", "building", "car", "person", "traffic-sign", "vegetation")
ROAD, BUILDING, CAR, PERSON, SIGN, VEGETATION = map(COMMON15.id_of, NAMES)
# Pixels on either side of which the tone of a class in a photograph is the mean: each car has a paint, and each tree
# stands in the sun or in the shade. A random one of three counts.
NEARBY = {CAR: (3, 8, 20), SIGN: (2, 4, 8), VEGETATION: (6, 16, 40)}
PAINTED = (CAR, SIGN)  # one has nothing to do with the next
SPREAD = 0.4  # how far colours of a class in [-1, 1] are from their mean without being outliers
IN_USE = [BUILDING, CAR, PERSON, SIGN]  # classes whose tones are invented in use
INSIDE_PX = 2  # a road's or a pane's edge is no streak
MATCHED = 3  # depths of features whose statistics are matched


def teacher_of(painter: ScenePainter, file: str) -> Teacher:
    """The scene painter in a file, made to enlarge as its student does, which would learn dashes of repeated pixels."""
    teacher = Teacher(file, "scene-painter")
    cast("ScenePainter", teacher.network).bilinear = painter.bilinear
    return teacher


class ScenePainting:
    """Trains a scene painter: perceptual loss, pooled colours, pixels, hinge loss of a projected discriminator.

    Where a camera did not look, its picture is completed with what was painted, so that no loss arises there.
    """

    released = ("painter",)

    def __init__(self, recipe: Recipe[ScenePaintingOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view].scaled(recipe.scale), recipe.options
        if not recipe.options.translator or not recipe.options.segmenter:
            raise InputError(f"recipe {recipe.name!r} needs --set options.translator=FILE and options.segmenter=FILE")
        self.features = ImagenetFeatures.load(LITE0)
        self.networks = build_networks(recipe)
        painter = cast("ScenePainter", self.networks["painter"])
        device = torch.device("cpu")
        segmenter, _ = load_segmenter(Path(recipe.options.segmenter), device)
        translator, _ = load_part(Path(recipe.options.translator), device, expect="titan-pano")
        pipeline = assemble(segmenter, translator, painter, self.view, device)
        self.looks, self.unread = painter.looks, painter.unread
        self.teacher = teacher_of(painter, recipe.options.teacher) if recipe.options.teacher else None
        self.dataset, self.validation = (
            PaintingFrames(root, splits, pipeline, recipe.options) for splits in (recipe.data.train, recipe.data.val)
        )
        self.statistics = PatchStatistics(len(self.looks), LITE0.channels[:MATCHED])
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: PaintingSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the painter."""
        batch = batch.flat()
        device = batch.depth_m.device
        self.features.to(device)
        segments = self.segments(batch)
        drawn = torch.rand(len(batch.look), 1, 1, device=device) < self.options.invented_probability
        batch = batch._replace(openings=batch.openings.masked_fill(drawn, torch.nan))
        window, pose = self._somewhere(segments)
        batch, used, tones = self._with_cars(batch, segments, drawn, window, pose)
        varied = torch.maximum(segments, used)[:, IN_USE].sum(1).clamp(max=1)
        # there, houses, cars, people and signs are as in use: not the image's
        segments, invented = used, drawn * varied
        inputs = self.inputs(batch, segments, tones, window, pose)
        batch, photographed = self._taught(batch, inputs)
        fake = painted = self.painted(batch, inputs)
        real = torch.where(batch.valid[:, None], batch.image, fake.detach())
        condition = torch.cat([segments, depth_code(batch.depth_m)[:, None]], 1)
        invented = twice(invented) * photographed
        counted = self._counted(batch, segments, invented, photographed)
        if self.options.augment_probability:
            real, fake, condition, counted = self._augmented(real, fake, condition, counted)
        with fast_arithmetic(device):
            with torch.no_grad():
                on_real = self.features(real.contiguous(memory_format=torch.channels_last))
            on_fake = self.features(fake.contiguous(memory_format=torch.channels_last))
        critic = self.networks["critic"]
        if self.options.adversarial:
            scores = zip(
                critic(condition, *on_real), critic(condition, *(part.detach() for part in on_fake)), strict=True
            )
            yield (
                "critic",
                _mean([hinge_critic(real_part.float(), fake_part.float()) for real_part, fake_part in scores]),
            )
        options = self.options
        pairs = [(real_part.float(), fake_part.float()) for real_part, fake_part in zip(on_real, on_fake, strict=True)]
        weights = [adaptive_avg_pool2d(counted[:, 1:2], real_part.shape[-2:]) for real_part, _ in pairs]
        perceptual = _mean(
            [((a - b).abs() * share).mean() / (a.std() + 1e-3) for (a, b), share in zip(pairs, weights, strict=True)]
        )
        expected = torch.lerp(real, fake.detach(), counted[:, 2:])
        terms = {
            "perceptual": perceptual,
            "pooled": mse_loss(pooled(fake), pooled(expected)),  # its best is the mean: for dark cars not the median
            "pixels": ((fake - real).abs() * counted[:, 1:2]).mean(),
        }
        terms |= self._of_classes(batch, segments, inputs, painted, invented)
        if options.statistics:
            terms["statistics"] = self.statistics(pairs[:MATCHED], counted[:, :1], batch.look)
        if options.adversarial:
            with frozen(critic):  # its gradients would be discarded
                terms["adversarial"] = _mean([hinge_generator(score.float()) for score in critic(condition, *on_fake)])
        self.logs = {name: term.detach() for name, term in terms.items()}
        yield "painter", torch.stack([self._weights[name] * term for name, term in terms.items()]).sum()

    def _of_classes(
        self, batch: PaintingSample, segments: Tensor, inputs: tuple[Tensor, Tensor], painted: Tensor, invented: Tensor
    ) -> dict[str, Tensor]:
        """Return the weighted ones of the losses that compare painted pixels with their classes."""
        options, terms = self.options, {}
        if options.unseen:
            visible = batch.valid & (invented < 0.5)
            terms["unseen"] = self._unseen(batch._replace(valid=visible), segments, inputs[0][:, TONES], painted)
        if options.streaks:
            terms["streaks"] = self._streaks(batch, inputs, painted)
        return terms

    @property
    def _weights(self) -> dict[str, float]:
        options = self.options
        return {
            "perceptual": options.perceptual,
            "pooled": options.pooled,
            "pixels": options.pixels,
            "unseen": options.unseen,
            "streaks": options.streaks,
            "statistics": options.statistics,
            "adversarial": options.adversarial,
        }

    def _taught(self, batch: PaintingSample, inputs: tuple[Tensor, Tensor]) -> tuple[PaintingSample, Tensor]:
        """The batch with the teacher's pictures where no camera looked, and of some crops altogether, in any look.

        So what is painted all around and in every look is learned from all frames.
        Returns with it (B, 2H, 2W) bool: where the image is not the teacher's.
        """
        if self.teacher is None:
            return batch, torch.ones_like(batch.valid)
        drawn = torch.rand(len(batch.look), device=batch.look.device) < self.options.teacher_probability
        look = torch.where(drawn, torch.randint_like(batch.look, len(self.looks)), batch.look)
        changed = (look != batch.look)[:, None, None]
        batch = batch._replace(
            look=look, tone=batch.tone * ~drawn[:, None], class_means=batch.class_means.masked_fill(changed, torch.nan)
        )
        taught = self.teacher(*framed(*inputs), *self._look_and_tone(batch)).float()
        photographed = batch.valid & ~drawn[:, None, None]
        image = torch.where(photographed[:, None], batch.image, taught)
        return batch._replace(image=image, valid=torch.ones_like(batch.valid)), photographed

    @staticmethod
    def _streaks(batch: PaintingSample, inputs: tuple[Tensor, Tensor], painted: Tensor) -> Tensor:
        """`streaks` on roads, which a photograph may have as well, and in panes, in which nothing is expected."""
        road, panes = (twice(inside(inputs[0][:, layer].float(), INSIDE_PX)) for layer in (ROAD, OPENINGS))
        image = batch.image * road[:, None]  # the openings of a photograph are elsewhere
        return streaks(painted, image, torch.maximum(road * batch.valid, panes))

    def _look_and_tone(self, batch: PaintingSample) -> tuple[Tensor, Tensor]:
        return torch.eye(len(self.looks), device=batch.look.device)[batch.look], batch.tone

    def _augmented(self, real: Tensor, fake: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        """The same DiffAugment of real and painted pictures, which all losses then compare, and of other layers.

        Layers on the coarser raster are enlarged.
        """
        augment = DiffAugment.drawn(len(fake), self.options.augment_probability)
        everywhere = torch.ones_like(fake[:, :1])
        sizes = [part.shape[1] for part in layers]
        large = [part if part.shape[2:] == fake.shape[2:] else twice(part) for part in layers]
        joined = augment.apply(fake, everywhere, torch.cat(large, 1))
        augmented = joined[:, 3:].detach().split(sizes, 1)
        return augment.apply(real, everywhere, everywhere[:, :0])[:, :3], joined[:, :3], *augmented

    def _counted(self, batch: PaintingSample, segments: Tensor, invented: Tensor, photographed: Tensor) -> Tensor:
        """Where the image is known, how much what is painted has to be equal to it there, and what is invented.

        (B, 3, 2H, 2W). A wall whose openings were invented has them elsewhere in a photograph.
        """
        walls = twice(segments[:, BUILDING] * batch.openings.isnan()) * photographed
        share = 1 - (1 - self.options.on_invented) * torch.maximum(invented, walls)
        return torch.stack([batch.valid.float(), share, invented], 1)

    @staticmethod
    def _unseen(batch: PaintingSample, segments: Tensor, tones: Tensor, painted: Tensor) -> Tensor:
        """How far pooled colours are from their classes' mean colours and tones, squared, where no camera looked.

        To this comes by how much single pixels are farther from them than SPREAD. The sky's are not known.
        (Without this loss a strip of bright dashes ran along the foot of the picture.)
        """
        has_mean = batch.class_means.isfinite().all(2)
        shares = segments * has_mean[..., None, None]
        expected = torch.einsum("bchw,bck->bkhw", shares, batch.class_means.nan_to_num(0))
        expected = expected + tones * shares.sum(1, keepdim=True)
        rows, columns = pooled(painted).shape[-2:]
        far = (painted - twice(expected)).abs() - SPREAD  # single bright pixels, which pooled colours forgive
        unseen = twice(shares.sum(1, keepdim=True)) * ~batch.valid[:, None]
        outliers = (far.clamp(min=0) * unseen).sum() / (3 * unseen.sum()).clamp(min=1)
        share, expected, valid = (
            adaptive_avg_pool2d(part, (rows, columns))
            for part in (shares.sum(1, keepdim=True), expected, batch.valid[:, None].float())
        )
        weight = share * (valid == 0)
        gap = (pooled(painted) * share - expected).square() * (valid == 0)
        return gap.sum() / (3 * weight.sum()).clamp(min=1) + outliers

    @torch.no_grad()
    def inputs(
        self, batch: PaintingSample, segments: Tensor, tones: Tensor, window: View, pose: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        """The painter's inputs for a batch, with these tones, and the scan as another sensor might have it."""
        channels = self._scanned(batch)
        scene = Scene.predicted(window, channels, segments, batch.depth_m, T_world_sensor=pose)
        return painter_inputs(scene, Hints(tones, batch.openings), self.unread)

    def _somewhere(self, segments: Tensor) -> tuple[View, np.ndarray]:
        """A random sector of the view as wide as the crops, at a random place in the noise."""
        pose = np.eye(4)
        pose[:3, 3] = np.random.uniform(0, 64, 3)  # noqa: NPY002 seeded by the loop, step by step
        return self.view.window(int(np.random.randint(self.view.columns)), segments.shape[3]), pose  # noqa: NPY002

    @torch.no_grad()
    def _with_cars(
        self, batch: PaintingSample, segments: Tensor, drawn: Tensor, window: View, pose: np.ndarray
    ) -> tuple[PaintingSample, Tensor, Tensor]:
        """The batch, its segments and its tones: where `drawn`, (B, 1, 1) bool, with whole cars and invented tones."""
        tones, depth_m, segments = self._tones(batch, segments), batch.depth_m.clone(), segments.clone()
        some = drawn.flatten()
        if bool(some.any()):
            device = segments.device  # thousands of small steps, which a CPU makes faster
            parts = (part[some].cpu() for part in (batch.channels, segments, depth_m))
            whole = with_cars(Scene.predicted(window, *parts, T_world_sensor=pose))
            segments[some], depth_m[some], invented = (part.to(device) for part in whole[:3])
            trees = (segments[some, VEGETATION] > 0.5)[:, None]  # in use they are in the sun elsewhere
            tones[some] = torch.where(invented.isnan() & trees, tones[some], invented)
        return batch._replace(depth_m=depth_m), segments, tones

    def _scanned(self, batch: PaintingSample) -> Tensor:
        """The scan's channels (B, 5, H, W), the remission of each crop as another sensor might have it, or none."""
        channels, options = batch.channels.clone(), self.options
        gain, drop_draw = torch.rand(2, len(channels), 1, 1, device=channels.device)
        channels[:, 4] *= 1 + options.remission_scale * (2 * gain - 1)
        channels[:, ::4] *= (drop_draw >= options.remission_drop_probability)[:, None]
        return channels

    @staticmethod
    def _tones(batch: PaintingSample, segments: Tensor) -> Tensor:
        """Tones (B, 3, H, W) of the images: a class's in the whole image, that of NEARBY's classes where it is known.

        NaN where a car's or a sign's is not: its paint is invented.
        """
        apart = batch.labels.new_tensor(list(NEARBY))
        tones = torch.einsum("bchw,bck->bkhw", segments, batch.class_tones.index_fill(1, apart, 0))
        lot = int(np.random.randint(3))  # noqa: NPY002
        colour, covered = avg_pool2d(batch.image, 2), avg_pool2d(batch.valid[:, None].float(), 2)[:, 0] == 1
        for class_id, reaches in NEARBY.items():
            mean, reach = batch.class_means[:, class_id, :, None, None], reaches[lot]
            visible = (batch.labels == class_id) & covered & mean.isfinite()[:, 0]
            parts = [(colour - mean).nan_to_num(0) * visible[:, None], visible[:, None].float()]
            nearby = avg_pool2d(torch.cat(parts, 1), 2 * reach + 1, 1, reach)
            whole = torch.nan if class_id in PAINTED else batch.class_tones[:, class_id, :, None, None]
            tone = torch.where(nearby[:, 3:] > 0, nearby[:, :3] / nearby[:, 3:], whole)
            share = segments[:, class_id, None]
            tones = tones + torch.where(share > 0.01, share * tone, 0)
        return tones

    def painted(self, batch: PaintingSample, inputs: tuple[Tensor, Tensor]) -> Tensor:
        """Pictures (B, 3, 2H, 2W) float32 in [-1, 1] of a batch."""
        painter = self.networks["painter"]
        if self.options.fixed_norms:
            fix_norms(painter)
        return painter(*framed(*inputs), *self._look_and_tone(batch)).float()

    def segments(self, batch: PaintingSample) -> Tensor:
        """Segments (B, 16, H, W) to paint: the translator's, sharpened at random, or by chance the ground truth."""
        samples, device = len(batch.look), batch.look.device
        power = 1 + (self.options.sharpest - 1) * torch.rand(samples, 1, 1, 1, device=device)
        chosen = torch.rand(samples, 1, 1, device=device) < self.options.ground_truth_probability
        labelled = (batch.labels != IGNORE) & chosen
        labels = one_hot_layers(batch.labels.where(labelled, 0), len(COMMON15))
        return torch.where(labelled[:, None], labels, sharpened(batch.segments, power))

    @torch.no_grad()
    def paint(self, index: int) -> tuple[Tensor, PaintingSample]:
        """A validation frame's crop painted from the scan alone: (3, 2H, 2W) in [-1, 1]; and the sample."""
        device = device_of(self.networks["painter"])
        sample = self.validation[index]
        single = PaintingSample(*(part[None].to(device) for part in sample)).flat()
        single = single._replace(tone=torch.zeros_like(single.tone))
        segments = sharpened(single.segments, 2.0)
        window, pose = self._somewhere(segments)
        scene = Scene.predicted(window, single.channels, segments, single.depth_m, T_world_sensor=pose)
        whole = with_cars(scene)
        scene = replace(scene, probabilities=whole.segments, depth_m=whole.depth_m)
        inputs = painter_inputs(scene, Hints(whole.tones), self.unread)
        return self.painted(single, inputs)[0].cpu(), sample

    def validate(self) -> dict[str, float]:
        """Mean distance of pooled colours in [0, 1]; no score, since that is not what is wanted: the latest counts."""
        gaps = []
        for index in range(min(6, len(self.validation))):
            fake, sample = self.paint(index)
            gap = (fake - sample.image[0]) * sample.valid[0]
            gaps.append(float(pooled(gap).abs().mean() / sample.valid[0].float().mean() / 2))
        return {"pooled": float(np.mean(gaps))}

    def preview(self) -> dict[str, np.ndarray]:
        """Ground truth above painted, for three validation frames, (H, W, 3) uint8."""
        rows = []
        for index in range(min(3, len(self.validation))):
            fake, sample = self.paint(index)
            rows += [sample.image[0] * sample.valid[0], fake]
        return {"picture": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the painter has to know: the raster it reads segments on."""
        return {"labels": None, "views": {"panorama": self.view.as_dict()}}


def _mean(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).mean()
