"""VGG-19 up to relu5_1: the layers that perceptual losses compare (Simonyan and Zisserman 2015, configuration E)."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.formats.torch_files import load_torch

WIDTHS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 256, 0, 512, 512, 512, 512, 0, 512)  # 0: the image is halved
TAPS = (1, 6, 11, 20, 29)  # relu1_1, relu2_1, relu3_1, relu4_1, relu5_1


class Vgg19(nn.Module):
    """The features; parameter names are those of torchvision's file."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in WIDTHS:
            if not width:
                layers.append(nn.MaxPool2d(2))
                continue
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        self.features = nn.Sequential(*layers)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W) in [-1, 1], taken as it is (so does vid2vid's code) -> five layers' features."""
        found = []
        for place, layer in enumerate(self.features):
            image = layer(image)
            if place in TAPS:
                found.append(image)
        return found


def read_vgg(path: Path | str) -> Vgg19:
    """The network from torchvision's vgg19-*.pth, fixed; a file that holds anything else raises InputError."""
    network = Vgg19()
    try:
        found = load_torch(path)
        network.load_state_dict({key: found[key] for key in network.state_dict()})
    except Exception:  # a broken or hostile file can break torch's restricted reader anywhere
        raise InputError(f"{path} holds no weights of VGG-19; give torchvision's vgg19-dcbb9e9d.pth") from None
    return network.requires_grad_(False).eval()
