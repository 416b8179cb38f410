"""Recipes of our own chain: `titan-pano` and the painter."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores


def titan_pano() -> Recipe:
    """Our translator, trained in panorama coordinates at half the raster."""
    return Recipe(
        name="titan-pano",
        task="panorama",
        view="panorama",
        scale=0.5,
        networks={
            "translator": Network(
                model="titan-pano",
                settings={"classes": 16, "conditions": 20},
                optimizer=Optimizer(rate=2e-3, weight_decay=1e-2, warmup=50, clip=5.0),
            )
        },
        options={"columns": 576, "lovasz": 1.0, "depth": 2.0, "rarity": 0.5, "segmenter": ""},
        training=Training(steps=20_000, batch=4),
    )


def titan_pano_mini() -> Recipe:
    """TITAN-pano as `kitti-mini` was released."""
    recipe = titan_pano()
    return replace(recipe, name="titan-pano-mini", training=on_two_cores(recipe.training, minutes=24.0, batch=4))


def painter() -> Recipe:
    """Our painter: colour from segments, depth and remission, against a patch critic."""
    adam = Optimizer(kind="adam", rate=4e-4, betas=(0.5, 0.999), schedule="cosine")
    return Recipe(
        name="painter",
        task="painting",
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="painter", settings={"classes": 16}, optimizer=adam),
            "critic": Network(model="patch-critic", settings={"channels": 20, "width": 32}, optimizer=adam),
        },
        options={
            "columns": 256,
            "jitter": 130,
            "adversarial": 1.0,
            "features": 10.0,
            "broad": 20.0,
            "pixels": 2.0,
            "trust": 0.5,
            "augment": 0.0,
            "translator": "",
            "segmenter": "",
        },
        training=Training(steps=50_000, batch=2),
    )


def painter_mini() -> Recipe:
    """The painter as `kitti-mini` was released."""
    recipe = painter()
    return replace(recipe, name="painter-mini", training=on_two_cores(recipe.training, minutes=26.0, batch=2))


def scene_painter() -> Recipe:
    """The scene painter: colour from segments and the shape of things, against heads on frozen features."""
    return Recipe(
        name="scene-painter",
        task="scene-painting",
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(
                model="scene-painter",
                settings={"looks": ["day", "overcast", "autumn", "evening"], "look": "day"},
                optimizer=Optimizer(kind="adam", rate=1e-3, betas=(0.5, 0.99), warmup=50, clip=5.0),
            ),
            "critic": Network(
                model="projected-critic",
                optimizer=Optimizer(kind="adam", rate=5e-4, betas=(0.0, 0.99), schedule="constant"),
            ),
        },
        options={
            "columns": 448,
            "perceptual": 2.0,
            "pooled": 2.0,
            "pixels": 0.5,
            "adversarial": 0.35,
            "trust": 0.6,
            "sharpest": 4.0,
            "simulated": 0.5,
            "frozen": 0.0,
            "look": "",
            "cache": "painting-frames",
            "translator": "",
            "segmenter": "",
        },
        training=Training(steps=50_000, batch=8),
    )


def scene_painter_mini() -> Recipe:
    """The scene painter for two CPU cores."""
    recipe = scene_painter()
    training = on_two_cores(recipe.training, minutes=35.0, batch=2, ema=0.99)
    return replace(recipe, name="scene-painter-mini", training=training)
