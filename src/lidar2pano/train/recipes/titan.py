"""Recipes of TITAN-Net as the paper has it."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores


def titan() -> Recipe:
    """TITAN-Net with the paper's numbers: WGAN-GP (lambda 10) and Lovasz-Softmax, Adam 1e-4, batch 10."""
    adam = Optimizer(kind="adam", rate=1e-4, betas=(0.5, 0.999), schedule="constant")
    return Recipe(
        name="titan",
        task="front",
        view="titan-front",
        networks={
            "translator": Network(model="titan", settings={"classes": 15, "conditions": 20}, optimizer=adam),
            "critic": Network(model="titan-critic", settings={"image_channels": 15, "conditions": 20}, optimizer=adam),
        },
        options={"penalty": 10.0, "lovasz": 1.0, "segmenter": ""},
        training=Training(steps=50_000, batch=10, accumulate=10, ema=0.0, precision="32-true"),
    )


def titan_mini() -> Recipe:
    """TITAN-Net the paper's way on `kitti-mini`, for as long as `titan-pano-mini`; one pair a step, 512 columns.

    Batch and columns are the paper's only at a cost of minutes a step on a CPU; a step more often teaches more.
    """
    recipe = titan()
    return replace(
        recipe,
        name="titan-mini",
        view="titan-front-512",
        training=on_two_cores(recipe.training, minutes=24.0, batch=1, ema=0.0),
    )
