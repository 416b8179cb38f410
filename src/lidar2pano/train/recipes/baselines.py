"""Recipes of what the paper compares TITAN-Net with: Pix2Pix and SC-UNET.

Rows of its tables: "Pix2Pix" and "Pix2Pix -> Vid2Vid" are pix2pix-segments, "Pix2Pix - w/o SegMap" is pix2pix-rgb,
"SC-UNET" is scunet. How the authors fed them is unpublished; ours get what TITAN-Net gets.
"""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores
from lidar2pano.train.recipes.titan import HALF


def pix2pix_segments() -> Recipe:
    """Pix2Pix from range view and segments to the camera's segments, with its published numbers.

    Cross-entropy critic and 100 times the absolute distance, Adam 2e-4, one pair a step (Isola et al. 2017, section
    3.3); statistics of the batch at hand in evaluation too, as its test command runs. The rate is constant (published:
    for the first half of the run, then linearly to zero).
    """
    adam = Optimizer(kind="adam", rate=2e-4, betas=(0.5, 0.999), schedule="constant")
    settings = {"inputs": 25, "outputs": 15, "width": 64, "batch_statistics": True, "size": (376, 1241)}
    return Recipe(
        name="pix2pix-segments",
        task="pix2pix-segments",
        view="titan-front",
        networks={
            "translator": Network(model="pix2pix", settings=settings, optimizer=adam),
            "critic": Network(model="pix2pix-critic", settings={"channels": 40, "width": 64}, optimizer=adam),
        },
        options={"rule": "vanilla", "guide": "l1", "weight": 100.0, "segmenter": ""},
        training=Training(steps=100_000, batch=1, ema=0.0),
    )


def pix2pix_segments_mini() -> Recipe:
    """Pix2Pix for segments, on pictures half as large and with half the channels, for two CPU cores."""
    return _mini(pix2pix_segments(), "translator")


def pix2pix_rgb() -> Recipe:
    """Pix2Pix from the range view to colours, with its published numbers as in pix2pix-segments.

    The paper's words leave open whether its squared error took the place of Pix2Pix's own guide here:
    `--set options.guide=mse` makes it so.
    """
    recipe = pix2pix_segments()
    networks = recipe.networks
    rgb = {**networks["translator"].settings, "inputs": 5, "outputs": 3}
    return replace(
        recipe,
        name="pix2pix-rgb",
        task="pix2pix-colours",
        networks={
            "renderer": replace(networks["translator"], settings=rgb),
            "critic": replace(networks["critic"], settings={"channels": 8, "width": 64}),
        },
        options={"rule": "vanilla", "guide": "l1", "weight": 100.0},
    )


def pix2pix_rgb_mini() -> Recipe:
    """Pix2Pix for colours, on pictures half as large and with half the channels, for two CPU cores."""
    return _mini(pix2pix_rgb(), "renderer")


def scunet() -> Recipe:
    """SC-UNET from the remission projected into the camera to colours, by squared error alone (Kim et al. 2020)."""
    adam = Optimizer(kind="adam", rate=1e-3, schedule="cosine")
    return Recipe(
        name="scunet",
        task="direct",
        view="titan-front",
        networks={"renderer": Network(model="scunet", settings={"inputs": 1}, optimizer=adam)},
        options={"evidence": "camera", "mse": 1.0, "size": (376, 1241)},
        training=Training(steps=50_000, batch=10, accumulate=5, ema=0.0),
    )


def scunet_mini() -> Recipe:
    """SC-UNET on pictures half as large, for two CPU cores."""
    recipe = scunet()
    training = on_two_cores(recipe.training, minutes=8.0, batch=2, ema=0.99)
    return replace(recipe, name="scunet-mini", options={**recipe.options, "size": HALF}, training=training)


def _mini(recipe: Recipe, role: str) -> Recipe:
    """Half the picture, half the channels, 512 columns of the range view."""
    halved = {"width": 32, "size": HALF}
    networks = {
        role: replace(recipe.networks[role], settings={**recipe.networks[role].settings, **halved}),
        "critic": replace(
            recipe.networks["critic"], settings={**recipe.networks["critic"].settings, "width": halved["width"]}
        ),
    }
    training = on_two_cores(recipe.training, minutes=8.0, batch=1, ema=0.0)
    return replace(recipe, name=f"{recipe.name}-mini", view="titan-front-512", networks=networks, training=training)
