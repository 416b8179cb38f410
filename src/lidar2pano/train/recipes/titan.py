"""Recipes of TITAN-Net as the paper has it, and of its follow-up TITAN-Next."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores

HALF = (188, 620)  # rows, columns: half of KITTI's images
GUIDE = 1000.0  # how much more guides weigh in recipes for minutes on a CPU


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

    Batch, columns and picture are the paper's only at a cost of minutes a step on a CPU, and a step more often teaches
    more: the picture is half as large here and the critic a quarter as wide. The guide weighs GUIDE times as much and
    the translator learns twenty times as fast: measured in its weights, the critic's slope was two hundred times that
    of Lovasz-Softmax, so that with the paper's sum only the critic would teach in the few hundred steps of a CPU.
    """
    recipe = titan()
    translator, critic = recipe.networks["translator"], recipe.networks["critic"]
    return replace(
        recipe,
        name="titan-mini",
        view="titan-front-512",
        networks={
            "translator": replace(
                translator,
                settings={**translator.settings, "size": HALF},
                optimizer=replace(translator.optimizer, rate=2e-3, schedule="cosine"),
            ),
            "critic": replace(critic, settings={**critic.settings, "width": 16}),
        },
        options={**recipe.options, "lovasz": GUIDE},
        training=on_two_cores(recipe.training, minutes=24.0, batch=1, ema=0.0),
    )


def titan_next() -> Recipe:
    """TITAN-Next (Cortinhal and Aksoy 2023) with TITAN-Net's numbers: feature pyramid, depth head, 512 columns.

    Guides weigh 0.1 each, as in what its authors made public; the true depth is the LiDAR's own (theirs is not
    described), and their further guides (similarity and smoothness of depth, entropy of the prediction) are left out.
    """
    recipe = titan()
    translator, critic = recipe.networks["translator"], recipe.networks["critic"]
    return replace(
        recipe,
        name="titan-next",
        task="front-depth",
        view="titan-front-512",
        networks={
            "translator": replace(translator, model="titan-next", settings={**translator.settings, "width": 64}),
            "critic": replace(critic, settings={**critic.settings, "image_channels": 16}),
        },
        options={"penalty": 10.0, "lovasz": 0.1, "entropy": 0.1, "depth": 0.1, "segmenter": ""},
    )


def titan_next_mini() -> Recipe:
    """TITAN-Next as `titan-mini`, with half the channels; its guides weigh as much as there."""
    recipe, small = titan_next(), titan_mini()
    translator, critic = small.networks["translator"], small.networks["critic"]
    return replace(
        recipe,
        name="titan-next-mini",
        networks={
            "translator": replace(translator, model="titan-next", settings={**translator.settings, "width": 32}),
            "critic": replace(critic, settings={**critic.settings, "image_channels": 16}),
        },
        options={**recipe.options, "lovasz": GUIDE, "entropy": GUIDE / 10, "depth": GUIDE},
        training=small.training,
    )
