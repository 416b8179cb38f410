"""A smaller encoder for a painter, taught by its own: options, task and recipes.

Cameras beside a scan are read through it; mean, flow and decoder stay as they are. It learns the latents that the
painter's own encoder has for photographs, and for these at half their size (cf. Hinton et al. 2015, distillation).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, mse_loss

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.data.photographs import FACTOR, PhotographCrop, PhotographDataset, as_signed
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import as_image
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.models.card import load
from lidar2pano.models.latent_painter import LatentPainter
from lidar2pano.train.latent_painting import latent_painter
from lidar2pano.train.recipe import Optimizer, Recipe, TaskOptions, Training, on_two_cores
from lidar2pano.train.task import build_networks, device_of
from lidar2pano.views import VIEWS

SCORED = 24  # photographs of the validation splits that are scored, evenly spaced
WIDTHS = ((16, 32, 64), (16, 32, 64, 128))  # half of the encoder's own; a quarter of its arithmetic


@dataclass(frozen=True, kw_only=True)
class EncodingOptions(TaskOptions):
    """The smaller encoder of a painter.

    painter  weight file of the painter; its settings are the network's but for its encoder's widths.
    size     of a crop, pixels, a multiple of 16.
    """

    task = "encoding"
    SIZES = ("size",)
    painter: str = ""
    size: int = 192


class Encoding:
    """Trains the encoder of a painter; its score is the negative loss on the validation splits."""

    released = ("painter",)
    methods = ("encode",)

    def __init__(self, recipe: Recipe[EncodingOptions], root: Path) -> None:
        options = recipe.options
        if not options.painter:
            raise InputError(f"recipe {recipe.name!r} needs --set options.painter=FILE")
        if options.size % (2 * FACTOR):
            raise InputError(f"options.size={options.size}: must be a multiple of {2 * FACTOR}")
        self.view, self.networks = VIEWS[recipe.view].scaled(recipe.scale), build_networks(recipe)
        teacher = cast("LatentPainter", load(Path(options.painter), expect="latent-painter")[0])
        painter = cast("LatentPainter", self.networks["painter"])
        weights = {name: weight for name, weight in teacher.state_dict().items() if not name.startswith("encoder.")}
        fault = InputError(f"options.painter: {options.painter} was trained with other settings than the network's")
        if painter.palette != teacher.palette:
            raise fault
        try:
            painter.load_state_dict({**weights, **painter.encoder.state_dict(prefix="encoder.")})
        except RuntimeError:
            raise fault from None
        self.teacher = teacher.requires_grad_(False)
        painter.requires_grad_(False)
        painter.encoder.requires_grad_()
        self.dataset, self.validation = (
            PhotographDataset(root, splits, options.size) for splits in (recipe.data.train, recipe.data.val)
        )
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: PhotographCrop) -> Iterator[tuple[str, Tensor]]:
        """One update of the encoder."""
        losses = [self.loss(pictures) for pictures in (batch.image, avg_pool2d(batch.image, 2))]
        yield "painter", torch.stack(losses).mean()

    def loss(self, pictures: Tensor) -> Tensor:
        """Return the mean squared distance of normalised latents of pictures (B, 3, H, W) from the teacher's."""
        pictures = pictures.contiguous(memory_format=torch.channels_last)
        self.teacher.to(pictures.device)
        with fast_arithmetic(pictures.device):
            with torch.no_grad():
                goal = self.teacher.encode(pictures)
            return mse_loss(cast("LatentPainter", self.networks["painter"]).encode(pictures), goal)

    def _photographs(self, most: int) -> Iterator[Tensor]:
        """Yield photographs of the validation splits, evenly spaced, (1, 3, h, w) in [-1, 1]."""
        for index in evenly_spaced(len(self.validation), most):
            yield as_signed(self.validation.photograph(index))[None].to(device_of(self.networks["painter"]))

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the loss of whole photographs; the score is its negative."""
        loss = float(np.mean([float(self.loss(picture)) for picture in self._photographs(SCORED)]))
        return {"score": -loss, "latents": loss}

    @torch.no_grad()
    def preview(self) -> dict[str, np.ndarray]:
        """Return a photograph decoded from latents of the painter's own encoder, below from the smaller one's."""
        painters = (self.teacher, cast("LatentPainter", self.networks["painter"]))
        picture = next(self._photographs(1))
        rows = [painter.decoder(painter.encode(picture))[0].float().clamp(-1, 1).cpu() for painter in painters]
        return {"picture": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Return the raster of the painter's scenes."""
        return {"labels": None, "views": {"panorama": self.view.as_dict()}}


def latent_encoder() -> Recipe[EncodingOptions]:
    """The smaller encoder of a painter, the last stage of a family."""
    plain = latent_painter()
    painter = plain.networks["painter"]
    optimizer = Optimizer(rate=2e-3, betas=(0.9, 0.99), warmup=100, clip=1.0)
    return Recipe(
        view=plain.view,
        scale=plain.scale,
        networks={
            "painter": replace(painter, settings={**painter.settings, "autoencoder": WIDTHS}, optimizer=optimizer)
        },
        options=EncodingOptions(),
        training=Training(steps=20_000, batch=32),
    )


RECIPES: dict[str, Callable[[], Recipe]] = {
    "latent-encoder": latent_encoder,
    "latent-encoder-mini": lambda: on_two_cores(latent_encoder(), minutes=20, batch=8),
}
