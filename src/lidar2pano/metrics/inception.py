"""The Inception-v3 of FID, and its published weights, to be supplied by the user.

Szegedy et al. 2016 (arXiv:1512.00567), in the variant of TensorFlow's graph `inception-2015-12-05` that Heusel et al.
2017 took the third pooling's 2048 features of. The weights were ported to torch by M. Seitzer (pytorch-fid, Apache
2.0); parameters are named as there. Where it differs from the network of the paper:

* average pools do not count the border's zeros;
* the last block pools by maximum, the one before by average;
* batch norms have an epsilon of 0.001, and the classifier 1008 classes (it is in the file and not used here);
* images are resized to 299 x 299 as TensorFlow 1 does it: bilinear, corners aligned at the top left, no antialiasing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

from lidar2pano.bounded_files import sha256_of
from lidar2pano.errors import InputError
from lidar2pano.formats.torch_files import load_torch

SIDE, FEATURES, CLASSES = 299, 2048, 1008
SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"
FILE_NAMES = ("pt_inception-2015-12-05-6726825d.pth", "weights-inception-2015-12-05-6726825d.pth")  # the same bytes
ADDRESS = f"https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/{FILE_NAMES[0]}"
ABSENT = f"FID needs the weights of Inception-v3, which are not downloaded: fetch {ADDRESS}"
Branch = Sequence[tuple[str, int, tuple[int, int]]]  # see Mixed


def find_inception(path: Path | str | None = None) -> Path | None:
    """Return the file with Inception's weights: `path`, else one in torch hub's cache folder, else None.

    Nothing is downloaded. InputError when there is no file at `path`.
    """
    if path is not None:
        if not Path(path).is_file():
            raise InputError(f"{path}: no such file; {ABSENT}")
        return Path(path)
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    return next((cache / name for name in FILE_NAMES if (cache / name).is_file()), None)


def load_inception(path: Path, device: torch.device | str = "cpu", sha256: str = SHA256) -> Inception:
    """Return the network with the weights in `path`, in evaluation mode; InputError for any other file."""
    if (digest := sha256_of(path)) != sha256:
        raise InputError(f"{path}: is not the published file (SHA-256 {digest[:8]}..., not {sha256[:8]}...); {ABSENT}")
    network = Inception()
    network.load_state_dict(load_torch(path), strict=False)  # some files have no counters of batch norms
    return network.to(device).eval()


class Inception(nn.Module):
    """Images (B, 3, H, W) uint8 -> features (B, 2048) float32 of the last pooling."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = ConvNormAct(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = ConvNormAct(32, 32, 3)
        self.Conv2d_2b_3x3 = ConvNormAct(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = ConvNormAct(64, 80, 1)
        self.Conv2d_4a_3x3 = ConvNormAct(80, 192, 3)
        self.Mixed_5b, self.Mixed_5c, self.Mixed_5d = at_35(192, 32), at_35(256, 64), at_35(288, 64)
        self.Mixed_6a = to_17(288)
        self.Mixed_6b, self.Mixed_6c, self.Mixed_6d, self.Mixed_6e = map(at_17, (128, 160, 160, 192))
        self.Mixed_7a = to_8()
        self.Mixed_7b, self.Mixed_7c = at_8(1280, _average_pooled), at_8(2048, _max_pooled)
        self.fc = nn.Linear(FEATURES, CLASSES)

    def forward(self, images: Tensor) -> Tensor:
        """Features of images of any size."""
        x = (resized(images.to(self.fc.weight), SIDE) - 128) / 128
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(max_pool2d(x, 3, 2)))
        x = self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(max_pool2d(x, 3, 2))))
        x = self.Mixed_6e(self.Mixed_6d(self.Mixed_6c(self.Mixed_6b(self.Mixed_6a(x)))))
        return self.Mixed_7c(self.Mixed_7b(self.Mixed_7a(x))).mean((2, 3))


def resized(x: Tensor, side: int) -> Tensor:
    """(B, C, H, W) float -> (B, C, side, side), bilinear as in TensorFlow 1: pixel i samples i * H / side."""
    for dim in (2, 3):
        length = x.shape[dim]
        place = torch.arange(side, dtype=x.dtype, device=x.device) * (length / side)
        near = place.floor().long().clamp(max=length - 1)
        share = (place - near).view(-1, *(1,) * (3 - dim))
        x = torch.lerp(x.index_select(dim, near), x.index_select(dim, (near + 1).clamp(max=length - 1)), share)
    return x


class ConvNormAct(nn.Module):
    """Convolution without bias, batch norm, ReLU."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int | tuple[int, int],
        stride: int = 1,
        padding: int | tuple[int, int] = 0,
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H', W')."""
        return self.bn(self.conv(x)).relu()


def _average_pooled(x: Tensor) -> Tensor:
    return avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)


def _strided_pooled(x: Tensor) -> Tensor:
    return max_pool2d(x, 3, 2)


def _max_pooled(x: Tensor) -> Tensor:
    return max_pool2d(x, 3, stride=1, padding=1)


class Mixed(nn.Module):
    """Branches side by side: (B, inputs, H, W) -> (B, sum of the branches' outputs, H', W').

    branches  of each its layers (published name, outputs, kernel), one after another; the last one's name may be two,
              layers beside each other.
    pool      before the last branch;  pooled: outputs of its convolution, 0 for none.
    strided   whether the raster is halved, by the last layer of each branch.
    """

    def __init__(
        self, inputs: int, branches: Sequence[Branch], pool: Callable[[Tensor], Tensor], pooled: int, strided: bool
    ) -> None:
        super().__init__()
        self.names, self.pool = [[name.split() for name, _, _ in branch] for branch in branches], pool
        for branch in branches:
            wide = inputs
            for place, (names, outputs, kernel) in enumerate(branch, 1):
                for name, size in zip(names.split(), (kernel, (kernel[1], kernel[0])), strict=False):
                    padding = (0, 0) if strided and place == len(branch) else (size[0] // 2, size[1] // 2)
                    stride = 2 if strided and place == len(branch) else 1
                    self.add_module(name, ConvNormAct(wide, outputs, size, stride=stride, padding=padding))
                wide = outputs
        self.branch_pool = ConvNormAct(inputs, pooled, 1) if pooled else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H', W')."""
        ends: list[Tensor] = []
        for branch in self.names:
            inner = [x]
            for names in branch:
                inner = [self.get_submodule(name)(inner[0]) for name in names]
            ends += inner
        return torch.cat([*ends, self.branch_pool(self.pool(x))], 1)


ONE, THREE, FIVE, ACROSS, DOWN = (1, 1), (3, 3), (5, 5), (1, 7), (7, 1)  # kernels: rows, columns


def at_35(inputs: int, pooled: int) -> Mixed:
    """Return a block at 35 x 35 (figure 5 of the paper), of 224 + pooled outputs."""
    double = [("branch3x3dbl_1", 64, ONE), ("branch3x3dbl_2", 96, THREE), ("branch3x3dbl_3", 96, THREE)]
    five = [("branch5x5_1", 48, ONE), ("branch5x5_2", 64, FIVE)]
    return Mixed(inputs, [[("branch1x1", 64, ONE)], five, double], _average_pooled, pooled, strided=False)


def to_17(inputs: int) -> Mixed:
    """Return the block from 35 x 35 to 17 x 17 (figure 10), of 480 + inputs outputs."""
    double = [("branch3x3dbl_1", 64, ONE), ("branch3x3dbl_2", 96, THREE), ("branch3x3dbl_3", 96, THREE)]
    return Mixed(inputs, [[("branch3x3", 384, THREE)], double], _strided_pooled, 0, strided=True)


def at_17(inner: int) -> Mixed:
    """Return a block at 17 x 17 (figure 6), kernels of 7 as rows and columns, of 768 outputs."""
    seven = [("branch7x7_1", inner, ONE), ("branch7x7_2", inner, ACROSS), ("branch7x7_3", 192, DOWN)]
    double = [("branch7x7dbl_1", inner, ONE), ("branch7x7dbl_2", inner, DOWN), ("branch7x7dbl_3", inner, ACROSS)]
    double += [("branch7x7dbl_4", inner, DOWN), ("branch7x7dbl_5", 192, ACROSS)]
    return Mixed(768, [[("branch1x1", 192, ONE)], seven, double], _average_pooled, 192, strided=False)


def to_8() -> Mixed:
    """Return the block from 17 x 17 to 8 x 8, of 1280 outputs."""
    three = [("branch3x3_1", 192, ONE), ("branch3x3_2", 320, THREE)]
    seven = [("branch7x7x3_1", 192, ONE), ("branch7x7x3_2", 192, ACROSS), ("branch7x7x3_3", 192, DOWN)]
    return Mixed(768, [three, [*seven, ("branch7x7x3_4", 192, THREE)]], _strided_pooled, 0, strided=True)


def at_8(inputs: int, pool: Callable[[Tensor], Tensor]) -> Mixed:
    """Return a block at 8 x 8 (figure 7), two of whose branches end in two, of 2048 outputs."""
    three = [("branch3x3_1", 384, ONE), ("branch3x3_2a branch3x3_2b", 384, (1, 3))]
    double = [("branch3x3dbl_1", 448, ONE), ("branch3x3dbl_2", 384, THREE)]
    double.append(("branch3x3dbl_3a branch3x3dbl_3b", 384, (1, 3)))
    return Mixed(inputs, [[("branch1x1", 320, ONE)], three, double], pool, 192, strided=False)
