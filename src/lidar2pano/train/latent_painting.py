"""The latent painter: options, task and recipes.

The mean of the latents is learned by squared errors, the flow by conditional flow matching (Lipman et al. 2023), both
on pixels in view of a camera. Long steps are learned from two of half their length (Frans et al. 2024).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import as_image
from lidar2pano.models.autoencoder import Autoencoder
from lidar2pano.models.card import load
from lidar2pano.models.latent_painter import (
    CLASSES,
    GEOMETRY,
    MEASUREMENT,
    Clues,
    LatentPainter,
    class_shares,
    expected_latents,
    photograph_of,
)
from lidar2pano.pipeline import Pipeline, load_part, load_segmenter
from lidar2pano.train.latent_frames import LatentFrames, LatentSample
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, on_two_cores
from lidar2pano.train.task import build_networks, device_of
from lidar2pano.views import VIEWS

GROUPS = (CLASSES, GEOMETRY, MEASUREMENT)
LENGTHS = (1, 2, 4)  # long steps are 1/1, 1/2 and 1/4; the shortest is learned from two instant ones of 1/8
SCORED = 12  # sectors of the validation splits that are scored, evenly spaced
TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # at which the flow is scored
MEASURED_ON = 48  # sectors, evenly spaced, whose latents' mean and deviation are taken out
SHOWN = 3  # sectors in a preview


@dataclass(frozen=True, kw_only=True)
class LatentPaintingOptions(TaskOptions):
    """The latent painter.

    columns      width of a crop on the scene's raster, a multiple of 16.
    segmenter, translator   weight files of the networks that make the scenes.
    autoencoder  weight file of the latents; a painter that goes on (`networks.painter.start`) has its own.
    cache        folder of the sectors, some 3 MB each; "": the folder .lidar2pano of their data set. They are made
                 once: where a data set's files change, remove its sectors.
    free_probability    of a sample whose flow is given nothing of the scene, for guidance.
    style_probability   of a sample to be given a style, of some columns of its photograph.
    given_probability   of one of those to be given the latents of some columns as well.
    absent_probability  of each group of conditions to be absent from a sample.
    remission_octaves   of half of the samples: largest change of remission's level, as of another make of sensor.
    shortcut     share of the samples of a batch for long steps.
    mean         whether the mean network learns as well; it begins to overfit long before the flow is done.
    """

    task = "latent-painting"
    SIZES = ("columns",)
    columns: int = 320
    autoencoder: str = ""
    segmenter: str = ""
    translator: str = ""
    cache: str = ""
    free_probability: float = 0.12
    style_probability: float = 0.5
    given_probability: float = 0.5
    absent_probability: float = 0.1
    remission_octaves: float = 3.0
    shortcut: float = 0.25
    mean: bool = True


class Noisy(NamedTuple):
    """Latents on their way from noise, (B, L, h, w), their time and the length of the step (B,), and the velocity."""

    latents: Tensor
    time: Tensor
    step: Tensor
    velocity: Tensor


class LatentPainting:
    """Trains a latent painter; its score is the negative loss on the validation splits."""

    released = ("painter",)
    frames: type[LatentFrames] = LatentFrames

    def __init__(self, recipe: Recipe[LatentPaintingOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view].scaled(recipe.scale), recipe.options
        start = recipe.networks["painter"].start
        for name in ("segmenter", "translator", *(() if start else ("autoencoder",))):
            if not getattr(recipe.options, name):
                raise InputError(f"recipe {recipe.name!r} needs --set options.{name}=FILE")
        self.networks = build_networks(recipe)
        self.painter = cast("LatentPainter", self.networks["painter"])
        self.painter.mean.requires_grad_(recipe.options.mean)
        if not start:
            self._code_as(cast("Autoencoder", load(Path(recipe.options.autoencoder), expect="autoencoder")[0]))
        device = torch.device("cpu")
        segmenter, _ = load_segmenter(Path(recipe.options.segmenter), device)
        translator, _ = load_part(Path(recipe.options.translator), device, expect="titan-pano")
        pipeline = Pipeline(
            segmenter=segmenter, translator=translator, painter=self.painter, view=self.view, device=device
        )
        networks = (recipe.options.segmenter, recipe.options.translator)
        self.dataset, self.validation = (
            self.frames(
                root,
                splits,
                pipeline,
                copy.deepcopy(self.painter.encoder),  # it stays on the CPU
                networks,
                self.painter.looks,
                recipe.options.columns,
                recipe.options.cache,
            )
            for splits in (recipe.data.train, recipe.data.val)
        )
        self.dataset.octaves = recipe.options.remission_octaves
        self.logs: dict[str, float | Tensor] = {}
        if not start:
            self._measure_scale()

    def _code_as(self, autoencoder: Autoencoder) -> None:
        """Give the painter the autoencoder's encoder and decoder."""
        try:
            self.painter.encoder.load_state_dict(autoencoder.encoder.state_dict())
            self.painter.decoder.decoder.load_state_dict(autoencoder.decoder.state_dict())
        except RuntimeError:
            raise InputError(
                f"options.autoencoder: {self.options.autoencoder} was trained with other settings than the painter's"
                " latents, encoder and decoder; change one of them"
            ) from None

    def _measure_scale(self) -> None:
        """Give the painter the scale of the latents in the training sectors."""
        sectors = [self.dataset.encoded(index) for index in evenly_spaced(len(self.dataset), MEASURED_ON)]
        latents = torch.cat([sector.latents[:, sector.coverage].float() for sector in sectors], 1)
        if not latents.shape[1]:
            raise InputError("data.train: no camera sees anything of its scans; name splits with calibrated images")
        cast("Tensor", self.painter.decoder.scale).copy_(torch.stack([latents.mean(1), latents.std(1).clamp(min=1e-6)]))

    def updates(self, batch: LatentSample) -> Iterator[tuple[str, Tensor]]:
        """One update of mean and flow."""
        yield "painter", self.flow_loss(batch)

    def flow_loss(self, batch: LatentSample) -> Tensor:
        """Return the loss of the flow, and of the mean if it learns; `logs` has both."""
        conditions, samples = self._with_absent(batch.conditions), len(batch.look)
        conditions = conditions.contiguous(memory_format=torch.channels_last)
        shares = self.shares(batch.look)
        latents = self.painter.decoder.normalised(batch.latents)
        noisy = self._noisy(latents)
        kept = (torch.rand(samples, device=conditions.device) >= self.options.free_probability).float()
        clues = self.clues(batch, latents)
        if taught := round(self.options.shortcut * samples):
            part = slice(taught)
            long = self._long(conditions[part], shares[part], latents[part], Clues(*(tensor[part] for tensor in clues)))
            noisy = Noisy(*(torch.cat([head, whole[taught:]]) for head, whole in zip(long, noisy, strict=True)))
            kept = torch.cat([torch.ones_like(kept[part]), kept[taught:]])
        mean, velocity = self.networks["painter"](
            conditions, shares, noisy.latents, noisy.time, noisy.step, kept, *clues
        )
        losses = {
            "mean": masked_error(mean, latents, batch.coverage),
            "flow": masked_error(velocity, noisy.velocity, batch.coverage),
        }
        self.logs = {name: loss.detach() for name, loss in losses.items()}
        return losses["mean"] + losses["flow"] if self.options.mean else losses["flow"]

    def shares(self, look: Tensor) -> Tensor:
        """Return the shares (B, looks) of looks (B,), one each."""
        return torch.eye(len(self.painter.looks), device=look.device)[look]

    def clues(self, batch: LatentSample, latents: Tensor) -> Clues:
        """Return clues of normalised latents: a style for some samples, and some columns for some of these."""
        samples, columns, options = len(latents), latents.shape[-1], self.options
        has_style, has_part = torch.rand(2, samples, device=latents.device) < torch.tensor(
            [[options.style_probability], [options.given_probability]], device=latents.device
        )
        ends = torch.randint(columns, (2, samples, 1), device=latents.device).sort(0).values
        number = torch.arange(columns, device=latents.device)
        chosen = (ends[0] <= number) & (number <= ends[1]) & (has_style & has_part)[:, None]
        mask = (batch.coverage & chosen[:, None])[:, None].to(latents.dtype)
        mean, deviation = cast("Tensor", self.painter.decoder.scale)
        count = batch.palette[..., -1:]
        sums = torch.cat([(batch.palette[..., :-1] - count * mean) / deviation, count], 2)
        sums = sums * (has_style & self.painter.palette)[:, None, None]
        photograph = photograph_of(latents, mask, expected_latents(sums), class_shares(batch.conditions))
        spread, present = batch.style[:, len(mean) : -1] / deviation, batch.style[:, -1:]
        style = torch.cat([(batch.style[:, : len(mean)] - mean) / deviation * present, spread, present], 1)
        return Clues(photograph, style * has_style[:, None])

    def _with_absent(self, conditions: Tensor) -> Tensor:
        """Return conditions of which some groups are absent."""
        conditions = conditions.clone()
        for group in GROUPS:
            absent = torch.rand(len(conditions), device=conditions.device) < self.options.absent_probability
            conditions[:, group] *= ~absent[:, None, None, None]
        return conditions

    @staticmethod
    def _noisy(latents: Tensor) -> Noisy:
        """Return latents at random times, most of them in the middle, and the instant velocity."""
        noise, time = torch.randn_like(latents), torch.sigmoid(torch.randn(len(latents), device=latents.device))
        return Noisy(
            torch.lerp(noise, latents, time[:, None, None, None]), time, torch.zeros_like(time), latents - noise
        )

    @torch.no_grad()
    def _long(self, conditions: Tensor, shares: Tensor, latents: Tensor, clues: Clues) -> Noisy:
        """Return latents at the beginning of long steps, and the mean velocity of two steps of half the length."""
        samples, device = len(latents), latents.device
        number = torch.tensor(LENGTHS, device=device)[torch.randint(len(LENGTHS), (samples,), device=device)]
        step = 1 / number
        time = (torch.rand(samples, device=device) * number).floor() * step
        start = torch.lerp(torch.randn_like(latents), latents, time[:, None, None, None])
        half = step / 2
        first = self._half_step(conditions, shares, start, time, half, clues)
        middle = start + half[:, None, None, None] * first
        second = self._half_step(conditions, shares, middle, time + half, half, clues)
        return Noisy(start, time, step, (first + second) / 2)

    def _half_step(  # noqa: PLR0913, PLR0917 the inputs of a network
        self, conditions: Tensor, shares: Tensor, noisy: Tensor, time: Tensor, half: Tensor, clues: Clues
    ) -> Tensor:
        """Return the velocity of a learned step; the guided instant one if the step is shorter than all of them."""
        network, samples = self.networks["painter"], len(noisy)
        instant = half < 1 / max(LENGTHS)
        step, kept = torch.where(instant, 0.0, half), torch.ones_like(time)
        twice = [torch.cat([part, part]) for part in (conditions, shares, noisy, time, step)]
        _, velocity = network(*twice, torch.cat([kept, 0 * kept]), *(torch.cat([part, part]) for part in clues))
        conditioned, free = velocity.float().split(samples)
        weight = torch.where(instant, self.painter.guidance, 1.0)
        return torch.lerp(free, conditioned, weight[:, None, None, None])

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the masked errors of mean and flow, with the same noise each time; the score is their negative sum."""
        network, device = self.networks["painter"], device_of(self.painter)
        losses = []
        for index in evenly_spaced(len(self.validation), SCORED):
            sample = LatentSample(*(part[None].to(device) for part in self.validation[index]))
            latents = self.painter.decoder.normalised(sample.latents)
            noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(index)).to(device)
            shares = self.shares(sample.look)
            unit = torch.ones(1, device=device)
            for time in TIMES:
                noisy = torch.lerp(noise, latents, time)
                mean, velocity = network(
                    sample.conditions, shares, noisy, time * unit, 0 * unit, unit, *Clues.empty(latents)
                )
                parts = ((mean, latents), (velocity, latents - noise))
                losses.append([float(masked_error(made, real, sample.coverage)) for made, real in parts])
        mean_loss, flow_loss = np.mean(losses, 0).tolist()
        return {"score": -(mean_loss + flow_loss), "mean": mean_loss, "flow": flow_loss}

    @torch.no_grad()
    def preview(self) -> dict[str, np.ndarray]:
        """Return photographs, below each the decoded mean and a picture, (H, W, 3) uint8."""
        device, rows, best = device_of(self.painter), [], self.painter.variant("best", 0)
        for index in evenly_spaced(len(self.validation), SHOWN):
            sample = self.validation[index]
            conditions = sample.conditions[None].to(device)
            shares = self.shares(sample.look[None].to(device))
            noise = torch.randn(1, *sample.latents.shape, generator=torch.Generator().manual_seed(index)).to(device)
            latents = self.painter.decoder.normalised(sample.latents[None].to(device))
            mean = self.painter.mean(conditions, shares).float()
            parts = (latents, mean, best.latents_of(conditions, shares, noise))
            rows += [self.painter.decoder(part)[0].float().clamp(-1, 1).cpu() for part in parts]
        return {"picture": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Return the raster of the painter's scenes."""
        return {"labels": None, "views": {"panorama": self.view.as_dict()}}


def masked_error(made: Tensor, real: Tensor, coverage: Tensor) -> Tensor:
    """Return the mean squared error of (B, L, h, w) over the coverage (B, h, w) bool; 0 without any."""
    error = (made.float() - real.float()).square().mean(1) * coverage
    return error.sum() / coverage.sum().clamp(min=1)


def latent_painter() -> Recipe[LatentPaintingOptions]:
    """The latent painter on the autoencoder's latents."""
    settings = {"looks": ("photograph", "day", "overcast", "autumn", "evening"), "palette": True}
    optimizer = Optimizer(rate=1e-3, betas=(0.9, 0.99), weight_decay=0.01, warmup=100, clip=1.0)
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={"painter": Network(model="latent-painter", settings=settings, optimizer=optimizer)},
        options=LatentPaintingOptions(),
        training=Training(steps=40_000, batch=64),
    )


RECIPES: dict[str, Callable[[], Recipe]] = {
    "latent-painter": latent_painter,
    "latent-painter-mini": lambda: on_two_cores(latent_painter(), minutes=120, batch=4),
}
