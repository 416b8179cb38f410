"""Recipes of vid2vid, the paper's painter of films."""

from __future__ import annotations

from dataclasses import replace

from lidar2pano.train.recipe import Data, Network, Optimizer, Recipe, Training, on_two_cores


def vid2vid() -> Recipe:
    """vid2vid's one-scale street network with the published settings, on clips of the camera's pictures.

    Published (NVIDIA/vid2vid, train.py --loadSize 512 --fg): Adam 2e-4, least squares, feature matching, flow and
    coherence 10, two scales of two temporal critics, one clip a step, first pictures given. Ours: classes of common-15
    without instances' edges (1 is the car), half a cosine for the rate where theirs falls linearly in the second half,
    and a window of the published size in pictures half the camera's size, as fine as half the panorama's raster. The
    perceptual loss needs options.vgg. A third of the clips begins with nothing (published: --no_first_img, all or
    none), so that a stream can.
    """
    adam = Optimizer(kind="adam", rate=2e-4, betas=(0.5, 0.999), schedule="cosine")
    painter = {
        "channels": 16,
        "widths": (128,),
        "downsamplings": 3,
        "blocks": (9, 3),
        "foreground": (1,),
        "batch_statistics": True,
    }
    film = Network(model="vid2vid-temporal-critic", settings={"channels": 13, "width": 64}, optimizer=adam)
    return Recipe(
        name="vid2vid",
        task="video",
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="vid2vid", settings=painter, optimizer=adam),
            "critic": Network(model="vid2vid-image-critic", settings={"channels": 19, "width": 64}, optimizer=adam),
            "temporal_1": film,
            "temporal_3": film,
        },
        options={
            "field": "camera",
            "frames": 12,
            "rows": 160,
            "columns": 512,
            "stills": (),
            "blank": 0.33,
            "single": "",
            "features": 10.0,
            "flow": 10.0,
            "coherence": 10.0,
            "mask": 1.0,
            "perceptual": 10.0,
            "pixels": 0.0,
            "vgg": "",
        },
        training=Training(steps=60_000, batch=1, ema=0.0, precision="32-true"),
    )


def vid2vid_mini() -> Recipe:
    """A narrow vid2vid on `kitti-mini` in some minutes of two CPU cores.

    Twelve frames of one drive follow each other; the others become clips under a window that pans. So it learns to
    colour classes, to carry pictures along flows of a few pixels, and to keep still; not what parallax, traffic or
    other light look like, nor flows that a panning window does not have. In so few steps VGG's features are replaced
    by the pixels themselves, steps are longer, and the flow, whose published weight would rule the features that it
    shares with the picture, weighs less; so does the wish to keep what was there, which is a blur until flow is known.
    """
    recipe = vid2vid()
    narrow = {"painter": {"widths": (16,), "blocks": (4, 3), "foreground": ()}, "critic": {"width": 16}}
    networks = {
        role: replace(
            network,
            settings={**network.settings, **narrow.get(role, {"width": 16})},
            optimizer=replace(network.optimizer, rate=5e-4),
        )
        for role, network in recipe.networks.items()
        if role != "temporal_3"
    }
    ours = {"frames": 5, "rows": 128, "columns": 384, "stills": ("train", "val"), "blank": 0.5}
    weights = {"flow": 1.0, "mask": 0.1, "pixels": 20.0}
    return replace(
        recipe,
        name="vid2vid-mini",
        networks=networks,
        data=Data(train=("drive", "train"), val=("val",)),
        options={**recipe.options, **ours, **weights},
        training=replace(on_two_cores(recipe.training, minutes=12.0, batch=1), precision="bf16-mixed"),
    )
