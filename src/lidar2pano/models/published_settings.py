"""How published networks were built, read from the names and shapes of their weights.

Each function takes a table of shapes by key and gives keyword arguments for `build`. They believe what they are told:
whether every key and shape fits is checked afterwards, against the network that they describe. A key that they need
and do not find raises KeyError.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES_IDS

Shapes = Mapping[str, tuple[int, ...]]
CAR = CITYSCAPES_IDS.id_of("car")  # the one class that published street networks paint apart


def sdnet(shapes: Shapes) -> dict[str, Any]:
    """SD-Net: classes and sizes; it looks at the scales that it was made with, 0.5 and 1."""
    modules = [_count(shapes, rf"backbone\.stage{stage}\.\d+\.branches\.0\.0\.conv1\.weight") for stage in (2, 3, 4)]
    return {
        "classes": shapes["ocr.cls_head.weight"][0],
        "width": shapes["backbone.stage2.0.branches.0.0.conv1.weight"][0],
        "stem": shapes["backbone.conv1.weight"][0],
        "blocks": _count(shapes, r"backbone\.stage2\.0\.branches\.0\.\d+\.conv1\.weight"),
        "modules": modules,
        "context": shapes["ocr.conv3x3_ocr.0.weight"][0],
    }


def vid2vid(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's generator, keys of scale n behind "n.".

    Norms use the statistics of what they are given, since the published test program never leaves training mode. What
    is painted apart is the car, the only choice published for streets; other label sets than Cityscapes' ids with such
    a branch raise InputError.
    """
    inputs, previous = shapes["0.model_down_seg.1.weight"][1], shapes["0.model_down_img.1.weight"][1]
    frames = previous // 3 + 1
    apart = any(key.startswith("0.indv_") for key in shapes)
    if inputs % frames or previous % 3:
        raise InputError(f"{inputs} label and {previous} picture channels are not those of whole frames")
    if apart and inputs // frames not in (len(CITYSCAPES_IDS), len(CITYSCAPES_IDS) + 1):
        raise InputError(
            f"it paints some of its {inputs // frames} label channels apart and does not say which; only networks of"
            f" Cityscapes' {len(CITYSCAPES_IDS)} ids can be imported with such a branch"
        )
    scales = 1 + max(int(key.partition(".")[0]) for key in shapes if key[:1].isdigit())
    blocks = [
        _count(shapes, rf"{branch}\.\d+\.conv_block\.1\.weight")
        for branch in (r"0\.model_down_seg", r"0\.model_res_img", r"1\.model_up_img")
    ]
    return {
        "channels": inputs // frames,
        "widths": [shapes[f"{scale}.model_down_seg.1.weight"][0] for scale in range(scales)],
        "downsamplings": _convolutions(shapes, r"0\.model_down_seg\.\d+\.weight") - 1,
        "blocks": [blocks[0] + blocks[1], blocks[2]],
        "foreground": [CAR] if apart else [],
        "frames": frames,
        "batch_statistics": True,
    }


def vid2vid_single(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's first-frame network; its norms, too, use the statistics of what they are given."""
    enhancers = _count(shapes, r"model\d+_1\.1\.weight")
    finest = shapes[f"model{enhancers}_1.1.weight" if enhancers else "model.1.weight"]
    layers = _convolutions(shapes, r"model\.\d+\.weight")  # one, as many down as up, and without enhancers a head
    return {
        "classes": finest[1],
        "width": finest[0],
        "downsamplings": (layers - 1) // 2,
        "blocks": _count(shapes, r"model\.\d+\.conv_block\.1\.weight"),
        "enhancers": enhancers,
        "local_blocks": _count(shapes, r"model1_2\.\d+\.conv_block\.1\.weight"),
        "batch_statistics": True,
    }


def vid2vid_critic(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's critics of pictures and of clips."""
    scales = _count(shapes, r"scale\d+_layer0\.0\.weight")
    width, channels = shapes[f"scale{scales - 1}_layer0.0.weight"][:2]  # the last one sees the whole picture
    layers = _count(shapes, r"scale0_layer\d+\.0\.weight") - 2
    return {"channels": channels, "width": width, "layers": layers, "scales": scales}


def pix2pix(shapes: Shapes) -> dict[str, Any]:
    """Pix2Pix' U-Net. Batch norms use the statistics of the batch, as the published test command does.

    Convolutions have a bias before instance norms only.
    """
    width, inputs = shapes["model.model.0.weight"][:2]
    instance = "model.model.0.bias" in shapes
    return {
        "inputs": inputs,
        "outputs": shapes["model.model.3.weight"][1],
        "width": width,
        "depth": 1 + _count(shapes, r"model\.model\.1(\.model\.3)*\.model\.1\.weight"),
        "norm": "instance" if instance else "batch",
        "batch_statistics": not instance,
    }


def pix2pix_critic(shapes: Shapes) -> dict[str, Any]:
    """Pix2Pix' PatchGAN."""
    width, channels = shapes["model.0.weight"][:2]
    layers = _convolutions(shapes, r"model\.\d+\.weight") - 2
    return {
        "channels": channels,
        "width": width,
        "layers": layers,
        "norm": "instance" if "model.2.bias" in shapes else "batch",
    }


def fixed(shapes: Shapes) -> dict[str, Any]:  # noqa: ARG001 whatever they are
    """A network that is published in one size only."""
    return {}


def _count(shapes: Shapes, pattern: str) -> int:
    """How many keys are of a pattern."""
    return sum(re.fullmatch(pattern, key) is not None for key in shapes)


def _convolutions(shapes: Shapes, pattern: str) -> int:
    """How many weights with four dimensions have keys of a pattern."""
    return _count({key: shape for key, shape in shapes.items() if len(shape) == 4}, pattern)
