"""Recipes of our own chain: SalsaNext, TITAN-pano and the scene painter, and the forms in which families are released.

Released families (runs/release.sh) learn from real and simulated frames together: the street world's towns join with
`--set data.train=train,WORLD:all`. They show rare classes and all directions, real frames how things look. A split
named twice counts twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from lidar2pano.train.options import PanoramaOptions, ScenePaintingOptions, SegmentationOptions
from lidar2pano.train.recipe import Data, Network, Optimizer, Recipe, Training, on_two_cores, vary


def salsanext(channels: int = 5) -> Recipe[SegmentationOptions]:
    """SalsaNext on LiDAR labels: cross-entropy with class weights, and Lovasz-Softmax. 6 channels: with roughness."""
    optimizer = Optimizer(rate=3e-3, weight_decay=1e-2, warmup=50, clip=5.0)
    settings = {"classes": 20, "channels": channels}
    return Recipe(
        view="hdl64e",
        networks={"segmenter": Network(model="salsanext", settings=settings, optimizer=optimizer)},
        options=SegmentationOptions(),
        training=Training(steps=20_000, batch=2),
    )


def salsanext_mini() -> Recipe:
    """SalsaNext as `kitti-mini` was released: all labelled scans, some minutes of two CPU cores.

    Streets run along x in so small a set, and little time is left for rare classes.
    """
    recipe = vary(salsanext(), options={"rotation_deg": 20.0, "class_weight_exponent": 0.3})
    return replace(on_two_cores(recipe, minutes=22.0, batch=2), data=Data(train=("train", "labelled")))


def titan_pano() -> Recipe[PanoramaOptions]:
    """Our translator, trained in panorama coordinates at half the raster."""
    optimizer = Optimizer(rate=2e-3, weight_decay=1e-2, warmup=50, clip=5.0)
    settings = {"classes": 16, "conditions": 20}
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={"translator": Network(model="titan-pano", settings=settings, optimizer=optimizer)},
        options=PanoramaOptions(),
        training=Training(steps=20_000, batch=4),
    )


def scene_painter() -> Recipe[ScenePaintingOptions]:
    """The scene painter: colour from segments and the shape of things, against heads on frozen features."""
    painter = Optimizer(algorithm="adam", rate=1e-3, betas=(0.5, 0.99), warmup=10, clip=5.0)
    critic = Optimizer(algorithm="adam", rate=5e-4, betas=(0.0, 0.99), schedule="constant")
    unread = ("building", "vegetation", "fence")
    settings = {"looks": ("day", "overcast", "autumn", "evening"), "look": "day", "unread": unread}
    settings |= {"bilinear": True, "glass": True, "sun": False}
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="scene-painter", settings=settings, optimizer=painter),
            "critic": Network(model="projected-critic", optimizer=critic),
        },
        options=ScenePaintingOptions(
            columns=320,
            adversarial=0.6,
            augment_probability=0.4,
            simulated_probability=0.3,
            remission_scale=0.3,
            remission_drop_probability=0.15,
        ),
        training=Training(steps=50_000, batch=8),
    )


def release_segmenter() -> Recipe:
    """SalsaNext that reads roughness, without dropout, which lowers scores in short runs.

    Some scans have fewer beams or no remission.
    """
    augmentation = {"rotation_deg": 20.0, "augment_probability": 0.3, "ring_drop_probability": 0.3}
    remission = {"remission_scale": 0.3, "remission_drop_probability": 0.2}
    options = {**augmentation, **remission, "class_weight_exponent": 0.3, "dropout": False}
    return _release(salsanext(channels=6), "segmenter", 2e-3, options)


def release_translator() -> Recipe:
    """TITAN-pano with half as much weight again on Lovasz-Softmax."""
    return _release(titan_pano(), "translator", 2e-3, {"lovasz": 1.5})


def fast_segmenter() -> Recipe:
    """`release_segmenter` with less than half of the arithmetic: narrower, taught by a wide one (options.teacher)."""
    return vary(release_segmenter(), segmenter={"widths": (32, 48, 64, 128)}, options={"rotation_deg": 180.0})


def fast_translator() -> Recipe:
    """`release_translator` with half of the arithmetic, taught by a wide one."""
    return vary(release_translator(), translator={"widths": (16, 48, 96, 128, 192), "pyramid": 64})


def fast_painter() -> Recipe:
    """`scene_painter` with a third of the arithmetic, taught by a wide one, whose norms' statistics it has."""
    settings = {"widths": (16, 32, 80, 16), "colour_kernel": 1, "sharp": 4.0, "class_colours": False}
    return vary(scene_painter(), painter=settings, options={"fixed_norms": True})


def _release(recipe: Recipe, role: str, rate: float, options: Mapping[str, Any]) -> Recipe:
    """`recipe` with other options, another rate for the network `role`, and a GPU's batch."""
    network = recipe.networks[role]
    optimizer = replace(network.optimizer, rate=rate)
    return replace(
        vary(recipe, options=options),
        networks={**recipe.networks, role: replace(network, optimizer=optimizer)},
        training=replace(recipe.training, batch=16, workers=12),
    )
