"""Recipes of SD-Net, the camera's segmenter."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores


def sdnet() -> Recipe:
    """SD-Net with the published settings (Tao et al. 2020, section 4; scripts/train_cityscapes.yml) where we have them.

    Two scales, crops of 1024 x 2048, one a GPU on eight GPUs, 0.4 of the auxiliary loss, 0.05 of each scale's own.
    Instead of SGD, region mutual information and class-uniform sampling: AdamW, Lovasz-Softmax, every picture once
    an epoch. For KITTI's pictures set options.rows=352 and options.columns=1216.
    """
    return Recipe(
        name="sdnet",
        task="camera-segmentation",
        view="panorama",  # not read: no scan takes part
        networks={
            "camera": Network(
                model="sdnet",
                settings={
                    "classes": 19,
                    "scales": (0.5, 1.0),
                    "width": 48,
                    "stem": 64,
                    "blocks": 4,
                    "modules": (1, 4, 3),
                    "context": 512,
                },
                optimizer=Optimizer(rate=5e-4, weight_decay=1e-2, warmup=1000, clip=5.0),
            )
        },
        options={
            "rows": 1024,
            "columns": 2048,
            "smallest": 0.5,
            "largest": 2.0,
            "jitter": 0.25,
            "lovasz": 1.0,
            "auxiliary": 0.4,
            "each": 0.05,
        },
        training=Training(steps=65_000, batch=8),
    )


def sdnet_mini() -> Recipe:
    """A narrow SD-Net for some minutes of two CPU cores."""
    recipe = sdnet()
    camera = recipe.networks["camera"]
    small = {"width": 16, "stem": 24, "blocks": 2, "modules": (1, 1, 1), "context": 96}
    optimizer = Optimizer(rate=2e-3, weight_decay=1e-2, warmup=30, clip=5.0)
    return replace(
        recipe,
        name="sdnet-mini",
        networks={"camera": replace(camera, settings={**camera.settings, **small}, optimizer=optimizer)},
        options={**recipe.options, "rows": 256, "columns": 512, "smallest": 0.7, "largest": 1.4},
        training=on_two_cores(recipe.training, minutes=10.0, batch=4),
    )
