"""Recipes of other authors' networks: SalsaNext, SD-Net, vid2vid, and Pix2Pix and SC-UNET, the paper's baselines.

Rows of the paper's tables: "Pix2Pix" and "Pix2Pix -> Vid2Vid" are pix2pix-segments, "Pix2Pix - w/o SegMap" is
pix2pix-rgb, "SC-UNET" is scunet. How the authors fed them is unpublished; ours get what TITAN-Net gets.
"""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.options import (
    CameraColourOptions,
    CameraSegmentationOptions,
    Pix2PixColoursOptions,
    Pix2PixSegmentsOptions,
    SegmentationOptions,
    VideoOptions,
)
from lidar2pano.train.recipe import Data, Network, Optimizer, Recipe, Training, on_two_cores, vary
from lidar2pano.train.recipes.titan import HALF, NO_LIMIT


def salsanext() -> Recipe[SegmentationOptions]:
    """SalsaNext with its published schedule: 150 epochs, batch 24, SGD 0.01 with momentum 0.9, times 0.99 an epoch.

    Cortinhal, Tzelepis, Aksoy 2020, and salsanext.yml of its code, whose first epoch warms up (here the 797 steps of
    SemanticKITTI's 19,130 scans). Whole range images; class weights 1 / share, as there with shares of at least 0.001.
    """
    optimizer = Optimizer(
        algorithm="sgd", rate=0.01, betas=(0.9, 0.0), weight_decay=1e-4, schedule="exponential", final=0.99**150,
        warmup=797,
    )  # fmt: skip
    settings = {"classes": 20, "channels": 5}
    return Recipe(
        view="hdl64e",
        networks={"segmenter": Network(model="salsanext", settings=settings, optimizer=optimizer)},
        options=SegmentationOptions(
            columns=0, class_weight_exponent=1.0, class_weight_least=1e-3, class_weight_most=1e3
        ),
        training=Training(steps=NO_LIMIT, epochs=150, batch=24, accumulate=2, ema=0.0),
    )


def pix2pix_segments() -> Recipe[Pix2PixSegmentsOptions]:
    """Pix2Pix from range view and segments to the camera's segments; at full length with TITAN-Net's protocol.

    Cross-entropy discriminator and 100 times the absolute distance, Adam 2e-4, one pair a step (Isola et al. 2017,
    section 3.3); statistics of the batch at hand in evaluation too, as its test command runs. These are the numbers of
    the -mini form; at full length the baselines have TITAN-Net's protocol (`titan.papers_protocol`).
    """
    adam = Optimizer(algorithm="adam", rate=2e-4, betas=(0.5, 0.999), schedule="constant")
    settings = {"inputs": 25, "outputs": 15, "width": 64, "batch_statistics": True, "size": (376, 1241)}
    return Recipe(
        view="titan-front",
        networks={
            "translator": Network(model="pix2pix", settings=settings, optimizer=adam),
            "critic": Network(model="pix2pix-critic", settings={"channels": 40, "width": 64}, optimizer=adam),
        },
        options=Pix2PixSegmentsOptions(),
        training=Training(steps=100_000, batch=1, ema=0.0),
    )


def pix2pix_rgb() -> Recipe[Pix2PixColoursOptions]:
    """Pix2Pix from the range view to colours; at full length with TITAN-Net's protocol.

    The paper's words leave open whether its squared error took the place of Pix2Pix's own auxiliary loss here:
    `--set options.auxiliary=mse` makes it so.
    """
    recipe = vary(pix2pix_segments(), translator={"inputs": 5, "outputs": 3}, critic={"channels": 8})
    networks = {"renderer": recipe.networks["translator"], "critic": recipe.networks["critic"]}
    return replace(recipe, networks=networks, options=Pix2PixColoursOptions())


def pix2pix_mini(recipe: Recipe) -> Recipe:
    """Pix2Pix on images half as large, with half the channels and 512 columns of the range view."""
    (role,) = recipe.networks.keys() - {"critic"}
    small = vary(recipe, critic={"width": 32}, **{role: {"width": 32, "size": HALF}})
    return replace(on_two_cores(small, minutes=8.0, batch=1, ema=0.0), view="titan-front-512")


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


def sdnet() -> Recipe[CameraSegmentationOptions]:
    """SD-Net with the published settings (Tao et al. 2020, section 4; scripts/train_cityscapes.yml) where we have them.

    Two scales, crops of 1024 x 2048, one a GPU on eight GPUs, 0.4 of the auxiliary loss, 0.05 of each scale's own.
    Instead of SGD, region mutual information and class-uniform sampling: AdamW, Lovasz-Softmax, every image once
    an epoch. For KITTI's images set options.rows=352 and options.columns=1216.
    """
    width = {"width": 48, "stem": 64, "blocks": 4, "modules": (1, 4, 3), "context": 512}
    optimizer = Optimizer(rate=5e-4, weight_decay=1e-2, warmup=1000, clip=5.0)
    settings = {"classes": 19, "scales": (0.5, 1.0), **width}
    return Recipe(
        view="panorama",  # not used: the task reads no scan
        networks={"camera": Network(model="sdnet", settings=settings, optimizer=optimizer)},
        options=CameraSegmentationOptions(),
        training=Training(steps=65_000, batch=8),
    )


def sdnet_mini() -> Recipe:
    """A narrow SD-Net for some minutes of two CPU cores."""
    crops = {"rows": 256, "columns": 512, "scale_min": 0.7, "scale_max": 1.4}
    small = {"width": 16, "stem": 24, "blocks": 2, "modules": (1, 1, 1), "context": 96}
    recipe = vary(sdnet(), options=crops, camera=small)
    optimizer = Optimizer(rate=2e-3, weight_decay=1e-2, warmup=30, clip=5.0)
    recipe = replace(recipe, networks={"camera": replace(recipe.networks["camera"], optimizer=optimizer)})
    return on_two_cores(recipe, minutes=10.0, batch=4)


def vid2vid() -> Recipe[VideoOptions]:
    """vid2vid's one-scale street network with the published settings, on clips of the camera's images.

    Published (NVIDIA/vid2vid, train.py --loadSize 512 --fg): Adam 2e-4, least squares, feature matching, flow and
    coherence 10, two scales of two temporal discriminators, one clip a step, first images given; 20 epochs, in the
    second half of which the rate falls linearly (--niter 10 --niter_decay 10). 60,000 steps are 20 epochs of the 2,975
    clips of Cityscapes. Ours: classes of common-15 without instances' edges (1 is the car), and a window of the
    published size in images half the camera's size, as fine as half the panorama's raster. The perceptual loss needs
    options.vgg_weights. A third of the clips begins without previous images (published: --no_first_img, all or none),
    so that a stream can.
    """
    adam = Optimizer(algorithm="adam", rate=2e-4, betas=(0.5, 0.999), schedule="linear")
    blocks = {"downsamplings": 3, "blocks": (9, 3), "foreground": (1,), "batch_statistics": True}
    painter = {"channels": 16, "widths": (128,), **blocks}
    temporal = Network(model="vid2vid-temporal-critic", settings={"channels": 13, "width": 64}, optimizer=adam)
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="vid2vid", settings=painter, optimizer=adam),
            "critic": Network(model="vid2vid-image-critic", settings={"channels": 19, "width": 64}, optimizer=adam),
            "temporal_1": temporal,
            "temporal_3": temporal,
        },
        options=VideoOptions(),
        training=Training(steps=60_000, batch=1, ema=0.0, precision="32-true"),
    )


def vid2vid_mini() -> Recipe:
    """A narrow vid2vid on `kitti-mini` in some minutes of two CPU cores.

    Twelve frames of one drive follow each other; the others become clips under a window that pans. So the network
    learns to colour classes, to warp images along flows of a few pixels, and to keep still; not what parallax, traffic
    or other light look like, nor flows that a panning window does not have. In so few steps VGG's features are replaced
    by the pixels themselves and rates are higher. The flow loss, whose published weight would dominate the features
    that flow and image share, weighs less; so does the mask loss, which blurs images until flow is learned.
    """
    recipe = vid2vid()
    narrow = {"painter": {"widths": (16,), "blocks": (4, 3), "foreground": ()}}
    clips = {"clip_length": 5, "rows": 128, "columns": 384, "single_frame_splits": ("train", "val")}
    losses = {"flow": 1.0, "mask": 0.1, "pixels": 20.0}
    recipe = vary(
        recipe,
        options={**clips, **losses, "no_previous_probability": 0.5},
        **{role: narrow.get(role, {"width": 16}) for role in recipe.networks},
    )
    networks = {
        role: replace(network, optimizer=replace(network.optimizer, rate=5e-4, schedule="cosine"))
        for role, network in recipe.networks.items()
        if role != "temporal_3"
    }
    recipe = on_two_cores(recipe, minutes=12.0, batch=1)
    training = replace(recipe.training, precision="bf16-mixed")
    return replace(recipe, networks=networks, data=Data(train=("drive", "train"), val=("val",)), training=training)
