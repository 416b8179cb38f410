"""Task: colours straight from the scan, without segments in between; the paper's "w/o SegMap" and SC-UNET."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, mse_loss

from lidar2pano.data.camera_rasters import CameraSample, CameraSamples
from lidar2pano.data.fronts import FrontSample, FrontSamples, Wanted
from lidar2pano.errors import InputError, closest
from lidar2pano.metrics.similarity import SSIM
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.train.adversarial import wasserstein_updates
from lidar2pano.train.front import called, image_size, range_view
from lidar2pano.train.painting import BROAD
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks
from lidar2pano.views import VIEWS

EVIDENCE = ("front", "camera")


class DirectColour:
    """Trains a renderer by squared error and, where the recipe has a critic, by WGAN-GP as TITAN-Net is.

    Options: evidence, what the renderer sees: "front", the range view (critic conditioned on it too), or "camera", the
    scan projected into the camera, as many of its channels as the renderer has inputs (1: remission; 2: and range);
    mse, weight of the squared error; penalty, lambda of the gradient penalty; size, rows and columns of the picture
    where the network has no such setting.
    """

    released = ("renderer",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.view, self.option = VIEWS[recipe.view], dict(recipe.options)
        self.evidence = str(self.option.get("evidence", "front"))
        if self.evidence not in EVIDENCE:
            raise InputError(f"options.evidence cannot be {self.evidence!r}{closest(self.evidence, EVIDENCE)}")
        self.networks = build_networks(recipe)
        self.inputs = int(recipe.networks["renderer"].settings.get("inputs", 1))
        self.size = image_size(recipe, "renderer")
        self.dataset = self._samples(root, recipe.data.train)
        self.validation = self._samples(root, recipe.data.val)
        self.logs: dict[str, float | Tensor] = {}

    def _samples(self, root: Path, splits: tuple[str, ...]) -> FrontSamples | CameraSamples:
        if self.evidence == "camera":
            return CameraSamples(root, splits, self.size)
        return FrontSamples(root, splits, self.view, self.size, Wanted(classes=False, colour=True))

    def seen(self, batch: FrontSample | CameraSample) -> Tensor:
        """What the renderer sees of a batch: (B, C, H, W) float32."""
        return batch.lidar if self.evidence == "front" else camera_evidence(batch.lidar, self.inputs)

    def updates(self, batch: FrontSample | CameraSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, if there is one, then the renderer."""
        seen, weight = self.seen(batch), float(self.option["mse"])

        def guide(fake: Tensor) -> Tensor:
            return weight * mse_loss(fake, batch.colour)

        if "critic" not in self.networks:
            yield "renderer", guide(self.networks["renderer"](seen).float())
            return
        updates = wasserstein_updates(
            lambda: self.networks["renderer"](seen).float(),
            self.networks["critic"],
            batch.colour,
            seen,
            penalty_weight=float(self.option["penalty"]),
            guide=guide,
            logs=self.logs,
        )
        yield from called(updates, "renderer")

    def render(self, index: int) -> tuple[Tensor, Tensor]:
        """A validation frame's picture as the network makes it, and the camera's: (3, h, w) in [-1, 1] each."""
        network, sample = self.networks["renderer"], self.validation[index]
        device = next(network.parameters()).device
        seen = self.seen(sample._replace(lidar=sample.lidar[None])).to(device)
        with torch.inference_mode():
            return network(seen)[0].float().cpu(), sample.colour

    def validate(self) -> dict[str, float]:
        """Mean distance of broad colours in [0, 1], whose negative is the score; and structural similarity."""
        distances, similarity = [], SSIM()
        for index in range(len(self.validation)):
            fake, colour = self.render(index)
            distances.append(avg_pool2d(fake - colour, BROAD).abs().mean().item() / 2)
            similarity.update(as_picture(fake), as_picture(colour), str(index))
        distance = float(np.mean(distances))
        return {"score": -distance, "broad_colour": distance, "ssim": similarity.compute()}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera above renderer, for three validation frames, (H, W, 3) uint8."""
        rows: list[Tensor] = []
        for index in range(min(3, len(self.validation))):
            rows += reversed(self.render(index))
        return {"picture": as_picture(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the renderer has to know: what it reads; it speaks no label set, it gives colours."""
        if self.evidence == "front":
            return {"labels": None, **range_view(self.view)}
        rows, columns = self.size  # what the camera's image is stretched to: the network has learned this resolution
        return {"labels": None, "views": {"camera": {"rows": rows, "columns": columns}}}


def as_picture(colour: Tensor) -> np.ndarray:
    """Colours (3, h, w) in [-1, 1] as a picture (h, w, 3) uint8."""
    return ((colour.movedim(0, 2) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).numpy()


def camera_evidence(lidar: Tensor, inputs: int) -> Tensor:
    """The first `inputs` channels (1 or 2) of (B, 2, h, w): remission as it is, and range in the code of depths."""
    if inputs == 1:
        return lidar[:, :1]
    if inputs != 2:
        raise InputError(f"a scan in the camera has remission and range: inputs must be 1 or 2, not {inputs}")
    return torch.stack([lidar[:, 0], depth_code(lidar[:, 1])], 1)
