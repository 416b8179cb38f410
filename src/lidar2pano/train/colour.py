"""Colours straight from the scan, without segments in between: options, tasks and recipes.

Rows of the paper's tables: "TITAN-Net - w/o SegMap" is titan-no-segments, "Pix2Pix - w/o SegMap" is pix2pix-rgb,
"SC-UNET" is scunet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from lidar2pano.data.camera_pairs import (
    CameraProjectionDataset,
    CameraProjectionSample,
    FrontViewDataset,
    FrontViewSample,
    SampleParts,
)
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import as_image
from lidar2pano.losses import pooled
from lidar2pano.losses.adversarial import pix2pix_updates, renamed, wasserstein_updates
from lidar2pano.metrics.frame_metrics import SSIM
from lidar2pano.scene.depth import depth_code
from lidar2pano.train.front import (
    AUXILIARY,
    HALF,
    FrontOptions,
    Pix2PixOptions,
    papers_protocol,
    pix2pix_losses,
    pix2pix_mini,
    pix2pix_segments,
    titan,
    titan_mini,
)
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, on_two_cores, vary
from lidar2pano.train.task import build_networks, device_of, image_size, range_view_card
from lidar2pano.views import VIEWS


@dataclass(frozen=True, kw_only=True)
class FrontColourOptions(TaskOptions):
    """Colours from the front view: weights of the squared error and of the WGAN's gradient penalty."""

    task = "front-colour"
    mse: float = 1.0
    gradient_penalty: float = 10.0


@dataclass(frozen=True, kw_only=True)
class CameraColourOptions(TaskOptions):
    """Colours from the scan projected into the camera (SC-UNET).

    mse   weight of the squared error;  size: rows and columns of the image.
    """

    task = "camera-colour"
    SIZES = ("size",)
    mse: float = 1.0
    size: tuple[int, int] = (376, 1241)


@dataclass(frozen=True, kw_only=True)
class Pix2PixColoursOptions(Pix2PixOptions):
    """Pix2Pix from the front view to colours."""

    task = "pix2pix-colours"


class ColourTask:
    """Shared data sets, scores and previews; subclasses have `updates`."""

    released = ("renderer",)
    options: Any

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.options, self.networks, self.view = recipe.options, build_networks(recipe), VIEWS[recipe.view]
        self.dataset, self.validation = (self.images(root, part) for part in (recipe.data.train, recipe.data.val))
        self.logs: dict[str, float | Tensor] = {}

    def images(self, root: Path, splits: tuple[str, ...]) -> FrontViewDataset | CameraProjectionDataset:
        """Frames of some splits with the camera's images: here with the front range view.

        The renderer's `size` is that of its image.
        """
        parts = SampleParts(labels=False, image=True)
        return FrontViewDataset(root, splits, self.view, image_size(self.networks["renderer"]), parts)

    def inputs(self, batch: FrontViewSample | CameraProjectionSample) -> Tensor:
        """The renderer's input (B, C, H, W) float32 for a batch."""
        return batch.lidar

    def render(self, index: int) -> tuple[Tensor, Tensor]:
        """A validation frame's image as the network makes it, and the camera's: (3, h, w) in [-1, 1] each."""
        network, sample = self.networks["renderer"], self.validation[index]
        inputs = self.inputs(sample._replace(lidar=sample.lidar[None])).to(device_of(network))
        with torch.inference_mode():
            return network(inputs)[0].float().cpu(), sample.image

    def validate(self) -> dict[str, float]:
        """Mean distance of pooled colours in [0, 1], whose negative is the score; and structural similarity."""
        distances, similarity = [], SSIM()
        for index in evenly_spaced(len(self.validation)):
            fake, colour = self.render(index)
            distances.append(pooled(fake - colour).abs().mean().item() / 2)
            similarity.update(as_image(fake), as_image(colour), str(index))
        distance = float(np.mean(distances))
        return {"score": -distance, "pooled_colour": distance, "ssim": similarity.compute()}

    def preview(self) -> dict[str, np.ndarray]:
        """Camera above renderer, for three validation frames, (H, W, 3) uint8."""
        rows: list[Tensor] = []
        for index in range(min(3, len(self.validation))):
            rows += reversed(self.render(index))
        return {"image": as_image(torch.cat(rows, 1))}

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """The view; there is no label set, since the output is colour."""
        return {"labels": None, **range_view_card(self.view)}


class FrontColour(ColourTask):
    """Trains a renderer by squared error and WGAN-GP, as TITAN-Net is; the critic is conditioned on the range view."""

    options: FrontColourOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the renderer."""
        updates = wasserstein_updates(
            lambda: self.networks["renderer"](batch.lidar).float(),
            self.networks["critic"],
            batch.image,
            batch.lidar,
            penalty_weight=self.options.gradient_penalty,
            auxiliary=lambda fake: self.options.mse * mse_loss(fake, batch.image),
            logs=self.logs,
        )
        return renamed(updates, "renderer")


class Pix2PixColours(ColourTask):
    """Trains Pix2Pix from the range view to the camera's image."""

    options: Pix2PixColoursOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The discriminator, then the renderer."""
        updates = pix2pix_updates(
            lambda: self.networks["renderer"](batch.lidar).float(),
            self.networks["critic"],
            batch.image,
            batch.lidar,
            *pix2pix_losses(self.options, batch.image),
            logs=self.logs,
        )
        return renamed(updates, "renderer")


class CameraColour(ColourTask):
    """Trains a renderer of the scan projected into the camera by squared error.

    Its setting `inputs`: 1 is remission, 2 is remission and range.
    """

    options: CameraColourOptions

    def __init__(self, recipe: Recipe, root: Path) -> None:
        super().__init__(recipe, root)
        self.channels = int(recipe.networks["renderer"].settings.get("inputs", 1))

    def images(self, root: Path, splits: tuple[str, ...]) -> CameraProjectionDataset:
        """Frames of some splits with the camera's images, the scan projected into it."""
        return CameraProjectionDataset(root, splits, self.options.size)

    def inputs(self, batch: FrontViewSample | CameraProjectionSample) -> Tensor:
        """The renderer's input (B, 1 or 2, h, w) float32 for a batch."""
        return camera_inputs(batch.lidar, self.channels)

    def updates(self, batch: CameraProjectionSample) -> Iterator[tuple[str, Tensor]]:
        """One update of the renderer."""
        fake = self.networks["renderer"](self.inputs(batch)).float()
        yield "renderer", self.options.mse * mse_loss(fake, batch.image)

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """The size of resized camera images."""
        rows, columns = self.options.size
        return {"labels": None, "views": {"camera": {"rows": rows, "columns": columns}}}


def camera_inputs(lidar: Tensor, channels: int) -> Tensor:
    """The first `channels` (1 or 2) of (B, 2, h, w): remission as it is, and range in the code of depths."""
    if channels == 1:
        return lidar[:, :1]
    if channels != 2:
        raise InputError(f"a scan in the camera has remission and range: inputs must be 1 or 2, not {channels}")
    return torch.stack([lidar[:, 0], depth_code(lidar[:, 1])], 1)


def without_segments(recipe: Recipe[FrontOptions], mse: float = 1.0) -> Recipe:
    """TITAN-Net from the range view straight to colours, with the squared error as its auxiliary loss.

    The critic is conditioned on the range view, since there are no segments to condition it on. In few steps the
    squared error teaches ten times less than Lovasz-Softmax, so the mini form gives it ten times the weight.
    """
    recipe = vary(
        recipe,
        translator={"classes": 3, "conditions": 0, "picture": True},
        critic={"image_channels": 3, "conditions": 5},
    )
    networks = {"renderer": recipe.networks["translator"], "critic": recipe.networks["critic"]}
    options = FrontColourOptions(mse=mse, gradient_penalty=recipe.options.gradient_penalty)
    return replace(recipe, networks=networks, options=options)


def pix2pix_rgb() -> Recipe[Pix2PixColoursOptions]:
    """Pix2Pix from the range view to colours; at full length with TITAN-Net's protocol.

    The paper's words leave open whether its squared error took the place of Pix2Pix's own auxiliary loss here:
    `--set options.auxiliary=mse` makes it so.
    """
    recipe = vary(pix2pix_segments(), translator={"inputs": 5, "outputs": 3}, critic={"channels": 8})
    networks = {"renderer": recipe.networks["translator"], "critic": recipe.networks["critic"]}
    return replace(recipe, networks=networks, options=Pix2PixColoursOptions())


def scunet() -> Recipe[CameraColourOptions]:
    """SC-UNET from the remission projected into the camera to colours, by squared error alone (Kim et al. 2020)."""
    adam = Optimizer(algorithm="adam", rate=1e-3, schedule="cosine")
    return Recipe(
        view="titan-front",
        networks={"renderer": Network(model="scunet", settings={"inputs": 1}, optimizer=adam)},
        options=CameraColourOptions(),
        training=Training(steps=50_000, batch=10, accumulate=5, ema=0.0),
    )


def scunet_mini() -> Recipe:
    """SC-UNET on images half as large."""
    return on_two_cores(vary(scunet(), options={"size": HALF}), minutes=8.0, batch=2, ema=0.99)


RECIPES: dict[str, Callable[[], Recipe]] = {
    "titan-no-segments": lambda: without_segments(titan()),
    "titan-no-segments-mini": lambda: without_segments(titan_mini(), mse=10 * AUXILIARY),
    "pix2pix-rgb": papers_protocol(pix2pix_rgb),
    "pix2pix-rgb-mini": lambda: pix2pix_mini(pix2pix_rgb()),
    "scunet": papers_protocol(scunet),
    "scunet-mini": scunet_mini,
}
