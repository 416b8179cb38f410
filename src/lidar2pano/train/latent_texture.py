"""The latent painter's last stage: pictures of few steps that a critic cannot tell from photographs.

Flow and decoder learn together through all steps of a picture, which starts from noise (adversarial distillation: Sauer
et al. 2023, arXiv:2311.17042): frozen features and colours of the photograph, the distribution of features in patches
of each class, and a projected critic. The loss of the flow stays, so that more steps remain possible. Scenes without a
photograph, of simulated towns, are painted as photographs as well, so that other sensors and places are known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate, mse_loss

from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import Patches, PatchStatistics, pooled
from lidar2pano.losses.adversarial import DiffAugment
from lidar2pano.models.autoencoder import FACTOR
from lidar2pano.models.frozen_features import LITE0, ImagenetFeatures
from lidar2pano.models.latent_painter import CLASSES, CONDITIONS, FOLD, MEASUREMENT, REMISSION, STRIDE, Clues
from lidar2pano.train.autoencoding import Texture
from lidar2pano.train.latent_frames import LatentSample, PicturedFrames
from lidar2pano.train.latent_painting import LatentPainting, LatentPaintingOptions, latent_painter, masked_error
from lidar2pano.train.recipe import Network, Optimizer, Recipe, on_two_cores

MATCHED = (24, 40, 112)  # channels of the depths of features whose distributions are matched
PHOTOGRAPH = 0  # number of the look of photographs


@dataclass(frozen=True, kw_only=True)
class LatentTextureOptions(LatentPaintingOptions):
    """The latent painter's texture; further options as of the latent painter.

    flow         weight of the loss of the flow.
    perceptual   weight of the mean absolute error of frozen features, each in units of its deviation.
    pooled       weight of the squared error of colours, means of 4 x 4 pixels; also above and below the photograph.
                 Without a photograph: of their change from one painting of the scene to another.
    held         weight of the squared error of pixels between two paintings of a scene from the same noise, of a
                 sensor that has turned by some pixels and measures other points.
    statistics   weight of the distance of patches' features from the distribution of their class in photographs.
    adversarial  weight of the hinge loss of the critic.
    augment_probability  of each kind of DiffAugment, of painted and real pictures alike.
    unpaired_probability  of a simulated sample to be painted as a photograph, and of any other picture to be shown to
                 the critic without its scene: patches and critic alone judge the former (cf. Richter et al. 2023,
                 Enhancing photorealism enhancement).
    """

    task = "latent-texture"
    mean: bool = False
    shortcut: float = 0.0
    absent_probability: float = 0.0
    flow: float = 1.0
    perceptual: float = 2.0
    pooled: float = 6.0
    held: float = 6.0
    statistics: float = 4.0
    adversarial: float = 0.6
    augment_probability: float = 0.4
    unpaired_probability: float = 0.5


class LatentTexture(LatentPainting):
    """Trains a latent painter's flow and decoder on pictures of its `steps`; its score is the flow's."""

    frames = PicturedFrames
    options: LatentTextureOptions

    def __init__(self, recipe: Recipe[LatentTextureOptions], root: Path) -> None:
        super().__init__(recipe, root)
        self.painter.decoder.requires_grad_()
        self.features = ImagenetFeatures.load(LITE0)
        self.memory = PatchStatistics(MATCHED, len(self.painter.looks) * len(COMMON15))

    def updates(self, batch: LatentSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the painter."""
        options = self.options
        loss = options.flow * self.flow_loss(batch)
        paired = self._paired(batch.look)
        batch = as_photographs(batch, ~paired)
        clues = self.clues(batch, self.painter.decoder.normalised(batch.latents))
        noise = torch.randn_like(batch.latents)
        made = self.painted(batch, noise, clues)
        repeats = paired | (torch.rand(len(made), device=made.device) < 0.5)
        anew = self._painted_anew(batch, noise, clues, repeats)
        still = repeats & ~clues.photograph[:, -1].any(2).any(1)
        terms = {
            "pooled": options.pooled * self._pooled_loss(made, anew, batch, paired),
            "held": options.held * masked_error(made, anew, still[:, None, None].expand_as(batch.shown)),
        }
        real = torch.where(batch.shown[:, None], batch.picture, made.detach())
        augment = DiffAugment.drawn(len(made), options.augment_probability)
        shown = batch.shown[:, None]
        layers = torch.cat([shown, torch.ones_like(shown), interpolate(batch.conditions, scale_factor=2.0)], 1)
        real = augment.apply(real, layers[:, :0])
        made, shown, whole, conditions = augment.apply(made, layers).split((3, 1, 1, CONDITIONS), 1)
        conditions = conditions.detach()
        told = paired & (torch.rand(len(made), device=made.device) >= options.unpaired_probability)
        texture = Texture(self.features, made, real[paired], conditions * told[:, None, None, None], paired)
        critic = self.networks["critic"]
        yield "critic", texture.critic_loss(critic)
        groups = self._groups(conditions, batch.look)
        real_patches = Patches([part.float() for part in texture.of_real], shown[paired], groups[paired])
        patches = Patches([part.float() for part in texture.of_made], whole, groups)
        terms |= {
            "perceptual": options.perceptual * texture.perceptual_loss(),
            "statistics": options.statistics * self.memory(real_patches, patches),
            "adversarial": options.adversarial * texture.adversarial_loss(critic),
        }
        self.logs |= {name: term.detach() for name, term in terms.items()}
        yield "painter", loss + torch.stack(list(terms.values())).sum()

    def _paired(self, look: Tensor) -> Tensor:
        """Return the samples (B,) bool to be judged beside their own pictures: all photographs, and at least one."""
        drawn = torch.rand(len(look), device=look.device) >= self.options.unpaired_probability
        paired = (look == PHOTOGRAPH) | drawn
        return paired | ~paired.any()

    def _groups(self, conditions: Tensor, look: Tensor) -> Tensor:
        """Return shares (B, looks x classes, H, W) of classes in looks, from conditions (B, CONDITIONS, H, W)."""
        shares = self.shares(look)[:, :, None, None, None] * conditions[:, None, CLASSES]
        return shares.flatten(1, 2)

    def _pooled_loss(self, made: Tensor, anew: Tensor, batch: LatentSample, paired: Tensor) -> Tensor:
        """Return the squared error of pooled colours; above and below what a camera shows, its last pixels count.

        (Where nothing counted, the rows at the foot became a bright strip.) A sample without a photograph has for its
        goal another painting of the same scene: colours that hang on noise, or on pixels, flicker in a drive.
        """
        columns = batch.shown.any(1, keepdim=True)[:, None]
        goal = torch.where(columns, batch.picture, made.detach())
        return mse_loss(pooled(made), pooled(torch.where(paired[:, None, None, None], goal, anew)))

    @torch.no_grad()
    def _painted_anew(self, batch: LatentSample, noise: Tensor, clues: Clues, repeats: Tensor) -> Tensor:
        """Return pictures as of a sensor that has turned by some pixels and measures half of the points.

        The noise of `repeats` (B,) bool turns with the sensor, as in a drive; that of all other samples is new.
        """
        turn = int(torch.randint(STRIDE, ()))
        conditions = batch.conditions.roll(turn, -1)
        kept = torch.rand_like(conditions[:, :1]) < 0.5
        conditions[:, MEASUREMENT.start : REMISSION + 1] *= kept
        turned = noise.roll(round(turn / FOLD), -1)
        turned = torch.where(repeats[:, None, None, None], turned, torch.randn_like(noise))
        return self.painted(batch._replace(conditions=conditions), turned, clues).roll(-turn * (FACTOR // FOLD), -1)

    def painted(self, batch: LatentSample, noise: Tensor, clues: Clues) -> Tensor:
        """Return pictures (B, 3, 2H, 2W) float32, about in [-1, 1], from noise and clues."""
        conditions = batch.conditions.contiguous(memory_format=torch.channels_last)
        with fast_arithmetic(conditions.device):
            latents = self.painter.latents_of(conditions, self.shares(batch.look), noise, clues)
            return self.painter.decoder(latents).float()


def as_photographs(batch: LatentSample, chosen: Tensor) -> LatentSample:
    """Return a batch whose chosen samples (B,) bool have the look of photographs, and nothing of their pictures."""
    kept = ~chosen
    return batch._replace(
        coverage=batch.coverage & kept[:, None, None],
        look=torch.where(kept, batch.look, PHOTOGRAPH),
        style=batch.style * kept[:, None],
        palette=batch.palette * kept[:, None, None],
        shown=batch.shown & kept[:, None, None],
    )


def latent_texture() -> Recipe[LatentTextureOptions]:
    """The texture of a latent painter, which starts from the weights of `latent-painter`."""
    plain = latent_painter()
    optimizer = Optimizer(rate=3e-4, betas=(0.5, 0.99), weight_decay=0.01, warmup=50, clip=5.0)
    critic = Optimizer(algorithm="adam", rate=5e-4, betas=(0.0, 0.99), schedule="constant")
    return Recipe(
        view=plain.view,
        scale=plain.scale,
        networks={
            "painter": replace(plain.networks["painter"], optimizer=optimizer),
            "critic": Network(model="projected-critic", settings={"conditions": CONDITIONS}, optimizer=critic),
        },
        options=LatentTextureOptions(columns=192),
        training=plain.training,
    )


RECIPES: dict[str, Callable[[], Recipe]] = {
    "latent-texture": latent_texture,
    "latent-texture-mini": lambda: on_two_cores(latent_texture(), minutes=90, batch=4, ema=0.995),
}
