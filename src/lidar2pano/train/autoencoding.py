"""The autoencoder of street pictures, on photographs: options, task and recipes.

It learns pixels, their differences, frozen features and the latents of a teacher, if there is one; a critic on the
same features and on the latents teaches texture (Esser et al. 2021, VQGAN).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import l1_loss, mse_loss

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.data.photographs import FACTOR, PhotographCrop, PhotographDataset, as_signed
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import as_image
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.losses.adversarial import frozen, generator_wasserstein, hinge_critic
from lidar2pano.models.autoencoder import Autoencoder
from lidar2pano.models.frozen_features import LITE0, ImagenetFeatures
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, on_two_cores
from lidar2pano.train.task import build_networks, device_of

SCORED = 24  # photographs of the validation splits that are scored, evenly spaced
SEAM = 2 * FACTOR  # columns at either side of a crop that are not scored: the network meets the other end there


@dataclass(frozen=True, kw_only=True)
class AutoencodingOptions(TaskOptions):
    """The autoencoder of street pictures.

    size        of a crop, pixels, a multiple of 8.
    pixels, differences  weights of the mean absolute errors of pixels and of neighbours' differences.
    perceptual  weight of the mean absolute error of frozen features, each in units of its deviation.
    adversarial  weight of the hinge loss of the critic; 0: there is none.
    latents     folder of a teacher's latents of the photographs (runs/teacher_latents.py); "": none.
    teacher     weight of the mean squared distance from them.
    encoder     whether the encoder learns, too: no longer once a painter learns its latents.
    """

    task = "autoencoding"
    SIZES = ("size",)
    size: int = 128
    pixels: float = 1.0
    differences: float = 1.0
    perceptual: float = 0.1
    adversarial: float = 0.02
    latents: str = ""
    teacher: float = 0.3
    encoder: bool = True


class Autoencoding:
    """Trains an autoencoder; its score is the PSNR in dB of whole photographs."""

    released = ("autoencoder",)

    def __init__(self, recipe: Recipe[AutoencodingOptions], root: Path) -> None:
        self.options, self.networks = recipe.options, build_networks(recipe)
        cast("Autoencoder", self.networks["autoencoder"]).encoder.requires_grad_(recipe.options.encoder)
        is_textured = recipe.options.perceptual > 0 or recipe.options.adversarial > 0
        self.features = ImagenetFeatures.load(LITE0) if is_textured else None
        latents = Path(recipe.options.latents) if recipe.options.latents else None
        size = recipe.options.size
        if size <= 2 * SEAM:
            raise InputError(
                f"options.size={size}: a crop's outer {SEAM} columns do not count; take more than {2 * SEAM}"
            )
        self.dataset = PhotographDataset(root, recipe.data.train, size, latents)
        self.validation = PhotographDataset(root, recipe.data.val, size)
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: PhotographCrop) -> Iterator[tuple[str, Tensor]]:
        """The critic, if there is one, then the autoencoder."""
        options, inner = self.options, (..., slice(SEAM, -SEAM))
        pictures, latents = self.networks["autoencoder"](batch.image)
        real, made = batch.image[inner], pictures.float()[inner]
        gaps = {"pixels": l1_loss(made, real), "differences": difference_loss(made, real)}
        loss = options.pixels * gaps["pixels"] + options.differences * gaps["differences"]
        if batch.latents.shape[1]:
            cells = (..., slice(SEAM // FACTOR, -SEAM // FACTOR))
            gaps["latents"] = mse_loss(latents.float()[cells], batch.latents[cells])
            loss = loss + options.teacher * gaps["latents"]
        if self.features is not None:
            texture = Texture(self.features, made, real, latents[..., SEAM // FACTOR : -SEAM // FACTOR].detach())
            critic = self.networks["critic"]
            if options.adversarial:
                yield "critic", texture.critic_loss(critic)
                gaps["adversarial"] = texture.adversarial_loss(critic)
                loss = loss + options.adversarial * gaps["adversarial"]
            gaps["perceptual"] = texture.perceptual_loss()
            loss = loss + options.perceptual * gaps["perceptual"]
        self.logs = {name: gap.detach() for name, gap in gaps.items()}
        yield "autoencoder", loss

    def reconstructions(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield photographs of the validation splits and what becomes of them, (3, h, w) in [-1, 1] each."""
        network = self.networks["autoencoder"]
        for index in evenly_spaced(len(self.validation), SCORED):
            real = as_signed(self.validation.photograph(index))
            with torch.inference_mode():
                made = network(real[None].to(device_of(network)))[0][0].float().cpu()
            yield real, made.clamp(-1, 1)

    def validate(self) -> dict[str, float]:
        """Return the mean PSNR in dB, and the energy of pixel differences over the photographs'."""
        signal, energy = [], []
        for real, made in self.reconstructions():
            signal.append(-10 * float(mse_loss(made, real).div(4).log10()))
            energy.append(float(difference_energy(made) / difference_energy(real)))
        return {"score": float(np.mean(signal)), "psnr_db": float(np.mean(signal)), "energy": float(np.mean(energy))}

    def preview(self) -> dict[str, np.ndarray]:
        """Return a photograph above what becomes of it, (H, W, 3) uint8."""
        return {"image": as_image(torch.cat(next(self.reconstructions()), 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Return nothing: pictures in, pictures out."""
        return {}


class Texture:
    """Frozen features of pictures and of photographs, and what a critic is told of their scenes.

    made    (B, 3, H, W) about in [-1, 1];  latents: (B, C, h, w).
    real    (P, 3, H, W) in [-1, 1], of the P pictures in `paired`, (B,) bool; None: of all.
    """

    def __init__(
        self, features: ImagenetFeatures, made: Tensor, real: Tensor, latents: Tensor, paired: Tensor | None = None
    ) -> None:
        device = made.device
        features.to(device)
        with fast_arithmetic(device):
            with torch.no_grad():
                self.of_real = features(real.contiguous(memory_format=torch.channels_last))
            self.of_made = features(made.contiguous(memory_format=torch.channels_last))
        self.latents = latents.float()
        self.paired = torch.ones(len(made), dtype=torch.bool, device=device) if paired is None else paired

    def perceptual_loss(self) -> Tensor:
        """Return the mean absolute error of features, each depth in units of the real ones' deviation."""
        pairs = zip((part[self.paired] for part in self.of_made), self.of_real, strict=True)
        return _mean([l1_loss(made.float(), real.float()) / (real.float().std() + 1e-3) for made, real in pairs])

    def critic_loss(self, critic: nn.Module) -> Tensor:
        """Return the critic's hinge loss."""
        of_real = critic(self.latents[self.paired], *self.of_real)
        of_made = critic(self.latents, *(part.detach() for part in self.of_made))
        return _mean([hinge_critic(real.float(), made.float()) for real, made in zip(of_real, of_made, strict=True)])

    def adversarial_loss(self, critic: nn.Module) -> Tensor:
        """Return the loss of pictures that do not look real to the critic, whose gradients would be discarded."""
        with frozen(critic):
            return _mean([generator_wasserstein(score.float()) for score in critic(self.latents, *self.of_made)])


def _mean(losses: list[Tensor]) -> Tensor:
    return torch.stack(losses).mean()


def differences(picture: Tensor) -> tuple[Tensor, Tensor]:
    """Return the differences of neighbouring pixels of (..., H, W): in a row, and in a column."""
    return picture[..., 1:] - picture[..., :-1], picture[..., 1:, :] - picture[..., :-1, :]


def difference_loss(made: Tensor, real: Tensor) -> Tensor:
    """Return the mean absolute errors of both differences, summed."""
    across, down = (l1_loss(*pair) for pair in zip(differences(made), differences(real), strict=True))
    return across + down


def difference_energy(picture: Tensor) -> Tensor:
    """Return the mean absolute differences, summed: how much fine texture a picture has."""
    across, down = differences(picture)
    return across.abs().mean() + down.abs().mean()


def autoencoder() -> Recipe[AutoencodingOptions]:
    """The autoencoder; the teacher's latents join with `--set options.latents=FOLDER`."""
    optimizer = Optimizer(rate=1e-3, betas=(0.9, 0.99), warmup=100, clip=5.0)
    critic = Optimizer(algorithm="adam", rate=5e-4, betas=(0.0, 0.99), schedule="constant")
    return Recipe(
        view="panorama",
        networks={
            "autoencoder": Network(model="autoencoder", optimizer=optimizer),
            "critic": Network(model="projected-critic", settings={"conditions": 32}, optimizer=critic),
        },
        options=AutoencodingOptions(),
        training=Training(steps=60_000, batch=16),
    )


RECIPES: dict[str, Callable[[], Recipe]] = {
    "autoencoder": autoencoder,
    "autoencoder-mini": lambda: on_two_cores(autoencoder(), minutes=60, batch=8),
}
