"""Recipes of SalsaNext, the LiDAR segmenter."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Data, Network, Optimizer, Recipe, Training, on_two_cores


def salsanext() -> Recipe:
    """SalsaNext on LiDAR labels: cross-entropy weighted by rarity, and Lovasz-Softmax."""
    return Recipe(
        name="salsanext",
        task="segmentation",
        view="hdl64e",
        networks={
            "segmenter": Network(
                model="salsanext",
                settings={"classes": 20, "channels": 5},
                optimizer=Optimizer(rate=3e-3, weight_decay=1e-2, warmup=50, clip=5.0),
            )
        },
        options={
            "columns": 1024,
            "turn_deg": 180.0,
            "chance": 0.5,
            "remission": 0.0,
            "rings": 0.0,
            "lovasz": 1.0,
            "rarity": 0.5,
            "dropout": True,
        },
        training=Training(steps=20_000, batch=2),
    )


def salsanext_mini() -> Recipe:
    """SalsaNext as `kitti-mini` was released: all labelled scans at hand, some minutes of two CPU cores.

    Streets run along x in so small a set, and little time is left for rare classes.
    """
    recipe = salsanext()
    return replace(
        recipe,
        name="salsanext-mini",
        options={**recipe.options, "turn_deg": 20.0, "rarity": 0.3},
        data=Data(train=("train", "labelled")),
        training=on_two_cores(recipe.training, minutes=22.0, batch=2),
    )
