"""Object-contextual representations: every pixel's class from its features and from what each class looks like here.

Paper     Yuan, Chen, Wang: Object-Contextual Representations for Semantic Segmentation, 2019 (arXiv:1909.11065),
          section 3.2; equation numbers below are its.
Upstream  as in `hrnet`; parameter names are the published ones.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn


class Objects(NamedTuple):
    """What OCR finds, on the raster of its features.

    logits     (B, classes, H, W): the answer.
    auxiliary  (B, classes, H, W): the first guess, by which pixels are gathered into classes.
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
        alike = torch.bmm(query.flatten(2).transpose(1, 2), key) * key.shape[1] ** -0.5  # (B, H W, K)
        weights = alike.softmax(2).to(value.dtype)
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

    context  channels of the features that classes are described by; keys are half as wide.
    dropout  share of the channels that training zeroes before the answer.
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
