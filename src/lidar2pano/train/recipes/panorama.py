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
