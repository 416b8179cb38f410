"""SD-Net, the paper's camera segmenter: HRNet and OCR at several scales, joined by learned attention.

Paper     Tao, Sapra, Catanzaro: Hierarchical Multi-Scale Attention for Semantic Segmentation, 2020 (arXiv:2005.10821),
          section 3.1, equation 1.
Upstream  https://github.com/NVIDIA/semantic-segmentation, commit 7726b14 (code BSD-3; the authors' weights were
          trained on Cityscapes, non-commercial). Reimplemented here; parameter names are the published ones.
Deviates  from the published code in two points: it takes and gives tensors instead of dictionaries, and training
          returns logits, of which `train.camera_segmentation` makes the loss.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.models.hrnet import HRNet, resized
from lidar2pano.models.ocr import Ocr


class ScalePrediction(NamedTuple):
    """What one scale sees, at the size of its own picture.

    logits     (B, classes, h, w).
    auxiliary  (B, classes, h / 4, w / 4): OCR's first guess, still on its own raster.
    attention  (B, 1, h, w) in [0, 1]: how far this scale is to be believed against the larger ones.
    """

    logits: Tensor
    auxiliary: Tensor
    attention: Tensor


class Answers(NamedTuple):
    """What training needs, all of it logits (B, classes, H, W).

    joint      of all scales;  auxiliary: of all scales, OCR's first guess.
    each       of every scale by itself, in falling order.
    """

    joint: Tensor
    auxiliary: Tensor
    each: tuple[Tensor, ...]


class SdNet(nn.Module):
    """Class logits of pictures of any size. The defaults are the published network.

    scales   sizes of the picture that are looked at, as factors; 1.0 must be among them.
    width, stem, blocks, modules   as in HRNet;  context: as in Ocr.
    """

    def __init__(  # noqa: PLR0913
        self,
        classes: int = 19,
        scales: Sequence[float] = (0.5, 1.0),
        width: int = 48,
        stem: int = 64,
        blocks: int = 4,
        modules: Sequence[int] = (1, 4, 3),
        context: int = 512,
    ) -> None:
        super().__init__()
        self.scales = falling(scales)
        two, three, four = modules
        self.backbone = HRNet(width, stem, blocks, (two, three, four))
        self.ocr = Ocr(self.backbone.channels, classes, context)
        middle = context // 2
        self.scale_attn = nn.Sequential(
            OrderedDict(
                conv0=nn.Conv2d(context, middle, 3, padding=1, bias=False),
                bn0=nn.BatchNorm2d(middle),
                re0=nn.ReLU(inplace=True),
                conv1=nn.Conv2d(middle, middle, 3, padding=1, bias=False),
                bn1=nn.BatchNorm2d(middle),
                re1=nn.ReLU(inplace=True),
                conv2=nn.Conv2d(middle, 1, 1, bias=False),
                sig=nn.Sigmoid(),
            )
        )

    def forward(self, images: Tensor, scales: Sequence[float] | None = None) -> Tensor | Answers:
        """Logits (B, classes, H, W) of normalised pictures (B, 3, H, W); in training mode `Answers`.

        scales  to look at instead of those that the network was made with; without 1.0 among them: InputError.
        """
        size = images.shape[-2:]
        joint, auxiliary, each = None, None, []
        for scale in self.scales if scales is None else falling(scales):
            scale_prediction = self.look(resized(images, scaled(size, scale)))
            joint = joined(joint, scale_prediction.logits, scale_prediction.attention, size)
            if self.training:
                guess = resized(scale_prediction.auxiliary, scale_prediction.logits.shape[-2:])
                auxiliary = joined(auxiliary, guess, scale_prediction.attention, size)
                each.append(resized(scale_prediction.logits, size))
        assert joint is not None
        return Answers(joint, auxiliary, tuple(each)) if auxiliary is not None else joint

    def look(self, images: Tensor) -> ScalePrediction:
        """What the pictures (B, 3, h, w) are at this size alone, everything in float32."""
        found = self.ocr(self.backbone(images))
        attention = self.scale_attn(found.features)
        size = images.shape[-2:]
        return ScalePrediction(
            resized(found.logits.float(), size), found.auxiliary.float(), resized(attention.float(), size)
        )


def joined(larger: Tensor | None, logits: Tensor, attention: Tensor, target: torch.Size) -> Tensor:
    """Equation 1: what one scale says where it is believed, and elsewhere what the `larger` ones said together.

    larger     (B, K, ...) of the larger scales, None for the largest;  logits (B, K, h, w), attention (B, 1, h, w).
    target     size (H, W) of the picture: the larger scales come down to this scale, but never below the target, to
               which smaller ones are stretched (attended logits and attention each, as published).
    """
    if larger is None:
        return logits
    size = logits.shape[-2:] if logits.shape[-1] >= target[1] and logits.shape[-2] >= target[0] else target
    believed = resized(attention, size)
    return resized(attention * logits, size) + (1 - believed) * resized(larger, size)


def scaled(size: torch.Size, scale: float) -> tuple[int, int]:
    """Rows and columns of a picture of `size` at `scale`, rounded down as published, at least one."""
    return max(int(size[0] * scale), 1), max(int(size[1] * scale), 1)


def falling(scales: Sequence[float]) -> tuple[float, ...]:
    """The scales from large to small; InputError unless they are positive, each once, with 1.0 among them."""
    if 1.0 not in scales or min(scales) <= 0 or len(set(scales)) != len(scales):
        raise InputError(f"scales {list(scales)} cannot be: name positive factors, each once, with 1.0 among them")
    return tuple(sorted((float(scale) for scale in scales), reverse=True))
