"""The Inception-v3 of FID, and its published weights, to be supplied by the user.

Szegedy et al. 2016 (arXiv:1512.00567), in the variant of TensorFlow's graph `inception-2015-12-05` that Heusel et al.
2017 took the third pooling's 2048 features of. The weights were ported to torch by M. Seitzer (pytorch-fid, Apache
2.0); parameters are named as in that file. Where it differs from the network of the paper:

* average pools do not count the border's zeros;
* the last block pools by maximum, the one before by average;
* batch norms have an epsilon of 0.001, and the classifier 1008 classes (it is in the file and not used here);
* images are resized to 299 x 299 as TensorFlow 1 does it: bilinear, corners aligned at the top left, no antialiasing.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
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


def load_inception(path: Path | str, device: torch.device | str = "cpu", sha256: str = SHA256) -> Inception:
    """Return the network with the weights in `path`, in evaluation mode; InputError for any other file."""
    try:
        digest = sha256_of(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {ABSENT}") from None
    if digest != sha256:
        raise InputError(f"{path}: is not the published file (SHA-256 {digest[:8]}..., not {sha256[:8]}...); {ABSENT}")
    network = Inception()
    network.load_published(_read(path), str(path))
    return network.to(device).eval()


def _read(path: Path | str) -> Mapping[str, Tensor]:
    try:
        state = load_torch(path)
    except (pickle.UnpicklingError, EOFError, RuntimeError, ValueError):
        state = None
    if not isinstance(state, Mapping):
        raise InputError(f"{path}: holds no weights; {ABSENT}")
    return state


class Inception(nn.Module):
    """Images (B, 3, H, W) uint8 -> features (B, 2048) float32 of the last pooling."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = ConvNormAct(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = ConvNormAct(32, 32, 3)
        self.Conv2d_2b_3x3 = ConvNormAct(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = ConvNormAct(64, 80, 1)
        self.Conv2d_4a_3x3 = ConvNormAct(80, 192, 3)
        self.Mixed_5b = InceptionA(192, 32)
        self.Mixed_5c = InceptionA(256, 64)
        self.Mixed_5d = InceptionA(288, 64)
        self.Mixed_6a = InceptionB(288)
        self.Mixed_6b = InceptionC(768, 128)
        self.Mixed_6c = InceptionC(768, 160)
        self.Mixed_6d = InceptionC(768, 160)
        self.Mixed_6e = InceptionC(768, 192)
        self.Mixed_7a = InceptionD(768)
        self.Mixed_7b = InceptionE(1280, max_pool=False)
        self.Mixed_7c = InceptionE(2048, max_pool=True)
        self.fc = nn.Linear(FEATURES, CLASSES)

    def load_published(self, state: Mapping[str, Tensor], source: str) -> None:
        """Load published weights, every one; `source` begins the InputError for unfit tensors."""
        # batch-norm counters are not used in evaluation, and not every file has them
        theirs = {key: value for key, value in state.items() if not key.endswith(".num_batches_tracked")}
        ours = {key: value for key, value in self.state_dict().items() if not key.endswith(".num_batches_tracked")}
        if wrong := sorted(theirs.keys() ^ ours.keys()):
            raise InputError(f"{source}: {len(wrong)} tensors too many or too few, the first {wrong[0]!r}; {ABSENT}")
        for key, value in theirs.items():
            if value.shape != ours[key].shape:
                raise InputError(f"{source}: {key!r} has shape {list(value.shape)}; {ABSENT}")
        self.load_state_dict(theirs, strict=False)

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
        *,
        stride: int = 1,
        padding: int | tuple[int, int] = 0,
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H', W')."""
        return self.bn(self.conv(x)).relu()


def _horizontal(inputs: int, outputs: int) -> ConvNormAct:
    return ConvNormAct(inputs, outputs, (1, 7), padding=(0, 3))


def _vertical(inputs: int, outputs: int) -> ConvNormAct:
    return ConvNormAct(inputs, outputs, (7, 1), padding=(3, 0))


def _average_pooled(x: Tensor) -> Tensor:
    return avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)


class InceptionA(nn.Module):
    """The blocks at 35 x 35 (figure 5 of the paper): (B, inputs, H, W) -> (B, 224 + pooled, H, W)."""

    def __init__(self, inputs: int, pooled: int) -> None:
        super().__init__()
        self.branch1x1 = ConvNormAct(inputs, 64, 1)
        self.branch5x5_1 = ConvNormAct(inputs, 48, 1)
        self.branch5x5_2 = ConvNormAct(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = ConvNormAct(inputs, 64, 1)
        self.branch3x3dbl_2 = ConvNormAct(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = ConvNormAct(96, 96, 3, padding=1)
        self.branch_pool = ConvNormAct(inputs, pooled, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Four branches side by side."""
        five = self.branch5x5_2(self.branch5x5_1(x))
        three = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch1x1(x), five, three, self.branch_pool(_average_pooled(x))], 1)


class InceptionB(nn.Module):
    """From 35 x 35 to 17 x 17 (figure 10): (B, inputs, H, W) -> (B, 480 + inputs, (H - 1) / 2, (W - 1) / 2)."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.branch3x3 = ConvNormAct(inputs, 384, 3, stride=2)
        self.branch3x3dbl_1 = ConvNormAct(inputs, 64, 1)
        self.branch3x3dbl_2 = ConvNormAct(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = ConvNormAct(96, 96, 3, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """Three branches side by side."""
        three = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch3x3(x), three, max_pool2d(x, 3, 2)], 1)


class InceptionC(nn.Module):
    """The blocks at 17 x 17 (figure 6), kernels of 7 as rows and columns: (B, inputs, H, W) -> (B, 768, H, W)."""

    def __init__(self, inputs: int, inner: int) -> None:
        super().__init__()
        self.branch1x1 = ConvNormAct(inputs, 192, 1)
        self.branch7x7_1 = ConvNormAct(inputs, inner, 1)
        self.branch7x7_2 = _horizontal(inner, inner)
        self.branch7x7_3 = _vertical(inner, 192)
        self.branch7x7dbl_1 = ConvNormAct(inputs, inner, 1)
        self.branch7x7dbl_2 = _vertical(inner, inner)
        self.branch7x7dbl_3 = _horizontal(inner, inner)
        self.branch7x7dbl_4 = _vertical(inner, inner)
        self.branch7x7dbl_5 = _horizontal(inner, 192)
        self.branch_pool = ConvNormAct(inputs, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Four branches side by side."""
        seven = self.branch7x7_3(self.branch7x7_2(self.branch7x7_1(x)))
        twice = self.branch7x7dbl_3(self.branch7x7dbl_2(self.branch7x7dbl_1(x)))
        twice = self.branch7x7dbl_5(self.branch7x7dbl_4(twice))
        return torch.cat([self.branch1x1(x), seven, twice, self.branch_pool(_average_pooled(x))], 1)


class InceptionD(nn.Module):
    """From 17 x 17 to 8 x 8: (B, inputs, H, W) -> (B, 512 + inputs, (H - 1) / 2, (W - 1) / 2)."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.branch3x3_1 = ConvNormAct(inputs, 192, 1)
        self.branch3x3_2 = ConvNormAct(192, 320, 3, stride=2)
        self.branch7x7x3_1 = ConvNormAct(inputs, 192, 1)
        self.branch7x7x3_2 = _horizontal(192, 192)
        self.branch7x7x3_3 = _vertical(192, 192)
        self.branch7x7x3_4 = ConvNormAct(192, 192, 3, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """Three branches side by side."""
        seven = self.branch7x7x3_3(self.branch7x7x3_2(self.branch7x7x3_1(x)))
        three = self.branch3x3_2(self.branch3x3_1(x))
        return torch.cat([three, self.branch7x7x3_4(seven), max_pool2d(x, 3, 2)], 1)


class InceptionE(nn.Module):
    """The blocks at 8 x 8 (figure 7), two branches, each ends in two: (B, inputs, H, W) -> (B, 2048, H, W)."""

    def __init__(self, inputs: int, *, max_pool: bool) -> None:
        super().__init__()
        self.max_pool = max_pool
        self.branch1x1 = ConvNormAct(inputs, 320, 1)
        self.branch3x3_1 = ConvNormAct(inputs, 384, 1)
        self.branch3x3_2a = ConvNormAct(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3_2b = ConvNormAct(384, 384, (3, 1), padding=(1, 0))
        self.branch3x3dbl_1 = ConvNormAct(inputs, 448, 1)
        self.branch3x3dbl_2 = ConvNormAct(448, 384, 3, padding=1)
        self.branch3x3dbl_3a = ConvNormAct(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3dbl_3b = ConvNormAct(384, 384, (3, 1), padding=(1, 0))
        self.branch_pool = ConvNormAct(inputs, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Six branches side by side."""
        three = self.branch3x3_1(x)
        twice = self.branch3x3dbl_2(self.branch3x3dbl_1(x))
        pooled = max_pool2d(x, 3, stride=1, padding=1) if self.max_pool else _average_pooled(x)
        branches = [self.branch1x1(x), self.branch3x3_2a(three), self.branch3x3_2b(three)]
        branches += [self.branch3x3dbl_3a(twice), self.branch3x3dbl_3b(twice), self.branch_pool(pooled)]
        return torch.cat(branches, 1)
