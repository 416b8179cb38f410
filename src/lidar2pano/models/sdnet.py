"""SD-Net, the paper's camera segmenter: HRNet and OCR at several scales, joined by learned attention.

Papers    Tao, Sapra, Catanzaro: Hierarchical Multi-Scale Attention for Semantic Segmentation, 2020 (arXiv:2005.10821),
          section 3.1, equation 1.
          HRNet: Wang et al.: Deep High-Resolution Representation Learning for Visual Recognition, 2019
          (arXiv:1908.07919), section 3 (HRNetV2).
          OCR: Yuan, Chen, Wang: Object-Contextual Representations for Semantic Segmentation, 2019 (arXiv:1909.11065),
          section 3.2; equations 2 to 5 below are its.
Upstream  https://github.com/NVIDIA/semantic-segmentation, commit 7726b14 (code BSD-3; the authors' weights were
          trained on Cityscapes, non-commercial), which has HRNet from
          https://github.com/HRNet/HRNet-Semantic-Segmentation (MIT). Reimplemented here; parameter names are the
          published ones.
Deviates  from the published code in two points: it takes and gives tensors instead of dictionaries, and training
          returns logits, of which `train.camera_segmentation` makes the loss.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu_

from lidar2pano.errors import InputError

BRANCHES = 4  # rasters at 1/4, 1/8, 1/16 and 1/32 of the picture
EXPANSION = 4  # how many times as wide as its middle a bottleneck ends


def resized(x: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """(B, C, h, w) -> (B, C, *size), bilinear, corners not aligned; x itself if nothing changes."""
    return x if x.shape[-2:] == tuple(size) else interpolate(x, size, mode="bilinear", align_corners=False)


def conv_norm(inputs: int, outputs: int, size: int = 3, stride: int = 1, act: bool = True) -> nn.Sequential:
    """Convolution without bias, batch norm and, unless `act` is false, ReLU."""
    parts = [nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*parts, *([nn.ReLU(inplace=True)] if act else []))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut: (B, channels, H, W) -> the same."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        self.conv2, self.bn2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) -> (B, channels, H, W)."""
        inner = relu_(self.bn1(self.conv1(x)))
        return relu_(self.bn2(self.conv2(inner)).add_(x))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 beside a shortcut: (B, inputs, H, W) -> (B, 4 middle, H, W)."""

    def __init__(self, inputs: int, middle: int) -> None:
        super().__init__()
        outputs = EXPANSION * middle
        self.conv1, self.bn1 = nn.Conv2d(inputs, middle, 1, bias=False), nn.BatchNorm2d(middle)
        self.conv2, self.bn2 = nn.Conv2d(middle, middle, 3, padding=1, bias=False), nn.BatchNorm2d(middle)
        self.conv3, self.bn3 = nn.Conv2d(middle, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = nn.Identity() if inputs == outputs else conv_norm(inputs, outputs, 1, act=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, 4 middle, H, W)."""
        inner = relu_(self.bn1(self.conv1(x)))
        inner = relu_(self.bn2(self.conv2(inner)))
        return relu_(self.bn3(self.conv3(inner)).add_(self.downsample(x)))


class Exchange(nn.Module):
    """Blocks on every raster, then each raster becomes the sum of all: pooled by convolutions, or stretched.

    Takes and gives a list of (B, widths[i], H / 2^i, W / 2^i).
    """

    def __init__(self, widths: tuple[int, ...], blocks: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList([nn.Sequential(*(BasicBlock(width) for _ in range(blocks))) for width in widths])
        self.fuse_layers = nn.ModuleList(
            [
                nn.ModuleList([_carry(source, target, widths) for source in range(len(widths))])
                for target in range(len(widths))
            ]
        )

    def forward(self, rasters: list[Tensor]) -> list[Tensor]:
        """Sum all rasters' contributions to each raster."""
        rasters = [branch(raster) for branch, raster in zip(self.branches, rasters, strict=True)]
        return [relu_(self._sum(rasters, target)) for target in range(len(rasters))]

    def _sum(self, rasters: list[Tensor], target: int) -> Tensor:
        size, carry = rasters[target].shape[-2:], self.fuse_layers[target]
        total = rasters[0].clone() if target == 0 else carry[0](rasters[0])  # pyright: ignore[reportIndexIssue]
        for source in range(1, len(rasters)):
            total.add_(resized(carry[source](rasters[source]), size))  # pyright: ignore[reportIndexIssue]
        return total


def _carry(source: int, target: int, widths: tuple[int, ...]) -> nn.Module:
    """From one raster to the width, and downwards also to the size, of another."""
    if source == target:
        return nn.Identity()
    if source > target:
        return conv_norm(widths[source], widths[target], 1, act=False)
    halvings = [conv_norm(widths[source], widths[source], stride=2) for _ in range(target - source - 1)]
    return nn.Sequential(*halvings, conv_norm(widths[source], widths[target], stride=2, act=False))


class HRNet(nn.Module):
    """HRNetV2: (B, 3, H, W) -> (B, 15 width, H / 4, W / 4), sizes rounded up.

    width    channels of the finest raster; each coarser one has twice as many.
    stem     channels before the rasters part, at 1/2 and 1/4.
    blocks   blocks per raster of an exchange, and bottlenecks before the rasters part.
    modules  exchanges of two, three and four rasters.
    """

    def __init__(
        self, width: int = 48, stem: int = 64, blocks: int = 4, modules: tuple[int, int, int] = (1, 4, 3)
    ) -> None:
        super().__init__()
        widths = tuple(width << branch for branch in range(BRANCHES))
        self.channels = sum(widths)
        self.conv1, self.bn1 = nn.Conv2d(3, stem, 3, 2, 1, bias=False), nn.BatchNorm2d(stem)
        self.conv2, self.bn2 = nn.Conv2d(stem, stem, 3, 2, 1, bias=False), nn.BatchNorm2d(stem)
        wide = EXPANSION * stem
        self.layer1 = nn.Sequential(*(Bottleneck(wide if number else stem, stem) for number in range(blocks)))
        self.transition1 = nn.ModuleList(
            [conv_norm(wide, widths[0]), nn.Sequential(conv_norm(wide, widths[1], stride=2))]
        )
        self.transition2, self.transition3 = (
            nn.ModuleList(
                [
                    *(nn.Identity() for _ in range(branches)),
                    nn.Sequential(conv_norm(widths[branches - 1], widths[branches], stride=2)),
                ]
            )
            for branches in (2, 3)
        )
        self.stage2, self.stage3, self.stage4 = (
            nn.Sequential(*(Exchange(widths[:branches], blocks) for _ in range(number)))
            for branches, number in zip((2, 3, 4), modules, strict=True)
        )

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, 15 width, H / 4, W / 4): all rasters, stretched to the finest."""
        x = relu_(self.bn1(self.conv1(images)))
        x = self.layer1(relu_(self.bn2(self.conv2(x))))
        rasters = self.stage2([transition(x) for transition in self.transition1])
        del x  # the widest of all
        rasters = self.stage3(_one_more(rasters, self.transition2))
        rasters = self.stage4(_one_more(rasters, self.transition3))
        finest = rasters[0]
        return torch.cat([resized(raster, finest.shape[-2:]).to(finest.dtype) for raster in rasters], 1)


def _one_more(rasters: list[Tensor], transition: nn.ModuleList) -> list[Tensor]:
    """The rasters, and one of half the size from the coarsest of them."""
    return [branch(raster) for branch, raster in zip(transition, [*rasters, rasters[-1]], strict=True)]


class Objects(NamedTuple):
    """Output of OCR, on the raster of its features.

    logits     (B, classes, H, W): the answer.
    auxiliary  (B, classes, H, W): the first guess, for gathering pixels into classes.
    features   (B, context, H, W): each pixel's with its classes' context.
    """

    logits: Tensor
    auxiliary: Tensor
    features: Tensor


def _norm_act(channels: int) -> nn.Sequential:
    return nn.Sequential(nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


def _transform(*widths: int) -> nn.Sequential:
    """1x1 convolutions without bias from width to width, each with norm and ReLU."""
    parts: list[nn.Module] = []
    for inputs, outputs in zip(widths, widths[1:], strict=False):
        parts += [nn.Conv2d(inputs, outputs, 1, bias=False), _norm_act(outputs)]
    return nn.Sequential(*parts)


def gather(features: Tensor, guess: Tensor) -> Tensor:
    """Of each class the mean of all pixels' features, weighted by the softmax over pixels of its guess (equation 2).

    features  (B, C, H, W);  guess (B, K, H, W).
    Returns (B, C, K, 1).
    """
    shares = guess.flatten(2).softmax(2).to(features.dtype)
    return torch.bmm(features.flatten(2), shares.transpose(1, 2))[..., None]


class ObjectContext(nn.Module):
    """A pixel's context: the classes' features, weighted by how alike pixel and class are (equations 3 to 5)."""

    def __init__(self, channels: int, keys: int) -> None:
        super().__init__()
        self.f_pixel = _transform(channels, keys, keys)
        self.f_object = _transform(channels, keys, keys)
        self.f_down = _transform(channels, keys)
        self.f_up = _transform(keys, channels)

    def forward(self, features: Tensor, classes: Tensor) -> Tensor:
        """Features (B, C, H, W) and classes (B, C, K, 1) -> context (B, C, H, W)."""
        query = self.f_pixel(features)
        key, value = self.f_object(classes)[..., 0], self.f_down(classes)[..., 0]  # (B, keys, K)
        similarity = torch.bmm(query.flatten(2).transpose(1, 2), key) * key.shape[1] ** -0.5  # (B, H W, K)
        weights = similarity.softmax(2).to(value.dtype)
        context = torch.bmm(weights, value.transpose(1, 2)).transpose(1, 2)  # (B, keys, H W)
        return self.f_up(context.reshape(query.shape))


class Distribution(nn.Module):
    """Features with their context beside them, mixed: (B, C, H, W) and (B, C, K, 1) -> (B, C, H, W)."""

    def __init__(self, channels: int, keys: int, dropout: float) -> None:
        super().__init__()
        self.object_context_block = ObjectContext(channels, keys)
        self.conv_bn_dropout = nn.Sequential(*_transform(2 * channels, channels), nn.Dropout2d(dropout))

    def forward(self, features: Tensor, classes: Tensor) -> Tensor:
        """Features (B, C, H, W) and classes (B, C, K, 1) -> (B, C, H, W)."""
        return self.conv_bn_dropout(torch.cat([self.object_context_block(features, classes), features], 1))


class Ocr(nn.Module):
    """The head over a trunk's features: (B, inputs, H, W) -> Objects.

    context  channels of the classes' features; keys are half as wide.
    dropout  share of zeroed channels before the output, in training.
    """

    def __init__(self, inputs: int, classes: int, context: int = 512, dropout: float = 0.05) -> None:
        super().__init__()
        self.conv3x3_ocr = nn.Sequential(nn.Conv2d(inputs, context, 3, padding=1), _norm_act(context))
        self.ocr_distri_head = Distribution(context, context // 2, dropout)
        self.cls_head = nn.Conv2d(context, classes, 1)
        self.aux_head = nn.Sequential(nn.Conv2d(inputs, inputs, 1), _norm_act(inputs), nn.Conv2d(inputs, classes, 1))

    def forward(self, features: Tensor) -> Objects:
        """(B, inputs, H, W) -> Objects on the same raster."""
        guess = self.aux_head(features)
        features = self.conv3x3_ocr(features)
        features = self.ocr_distri_head(features, gather(features, guess))
        return Objects(self.cls_head(features), guess, features)


class ScalePrediction(NamedTuple):
    """Prediction of one scale, at the size of its own picture.

    logits     (B, classes, h, w).
    auxiliary  (B, classes, h / 4, w / 4): OCR's first guess, still on its own raster.
    attention  (B, 1, h, w) in [0, 1]: how far this scale is to be believed against the larger ones.
    """

    logits: Tensor
    auxiliary: Tensor
    attention: Tensor


class Answers(NamedTuple):
    """Output in training, all of it logits (B, classes, H, W).

    joint      of all scales;  auxiliary: of all scales, OCR's first guess.
    each       of every scale by itself, in falling order.
    """

    joint: Tensor
    auxiliary: Tensor
    each: tuple[Tensor, ...]


class SdNet(nn.Module):
    """Class logits of pictures of any size. The defaults are the published network.

    scales   sizes of the picture, as factors; 1.0 must be among them.
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

        scales  in place of the network's own; without 1.0 among them: InputError.
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
        """Predict pictures (B, 3, h, w) at this size alone, everything in float32."""
        objects = self.ocr(self.backbone(images))
        attention = self.scale_attn(objects.features)
        size = images.shape[-2:]
        return ScalePrediction(
            resized(objects.logits.float(), size), objects.auxiliary.float(), resized(attention.float(), size)
        )


def joined(larger: Tensor | None, logits: Tensor, attention: Tensor, target: torch.Size) -> Tensor:
    """Blend by equation 1: one scale by its attention, and for the rest the `larger` ones together.

    larger     (B, K, ...) of the larger scales, None for the largest;  logits (B, K, h, w), attention (B, 1, h, w).
    target     size (H, W) of the picture: the larger scales come down to this scale, but never below the target;
               smaller ones are stretched to it (attended logits and attention each, as published).
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
