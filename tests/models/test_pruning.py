"""Pruned networks answer nearly as before, and refuse what is no narrower form of them."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d

from lidar2pano.demo import street
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import one_hot_layers, project
from lidar2pano.models import build, pruning
from lidar2pano.models.card import load
from lidar2pano.models.circular import CircularConv
from lidar2pano.models.families import weight_files
from lidar2pano.models.pruning import LAYERS, _fit, _sampled, pruned
from lidar2pano.models.scene_painter import framed
from lidar2pano.pipeline import card_view
from lidar2pano.recordings.drive_scans import read

WIDE = {
    "salsanext": {"classes": 6, "channels": 5, "widths": (16, 24, 32, 32)},
    "titan-pano": {"classes": 6, "conditions": 4, "widths": (16, 16, 24, 24, 32), "pyramid": 16, "dropout": 0.0},
    "scene-painter": {"looks": ("day", "evening"), "widths": (16, 24, 32, 12), "class_colours": True, "glass": True},
}
NARROW = {
    "salsanext": {**WIDE["salsanext"], "widths": (12, 16, 24, 24)},
    "titan-pano": {**WIDE["titan-pano"], "widths": (12, 12, 20, 20, 24), "pyramid": 12},
    "scene-painter": {**WIDE["scene-painter"], "widths": (12, 20, 28, 12), "colour_kernel": 1},
}


def smooth(*shape: int) -> Tensor:
    """Images as real ones are: neighbours are alike."""
    rows, columns = shape[2] + 4, shape[3] + 4
    return 3 * avg_pool2d(torch.randn(*shape[:2], rows, columns), 5, 1)


def inputs(name: str) -> tuple[Tensor, ...]:
    if name == "salsanext":
        return (smooth(1, 5, 32, 256),)
    if name == "titan-pano":
        return smooth(1, 5, 32, 256).abs() * 5, smooth(1, 4, 32, 256)
    return *framed(smooth(1, 31, 16, 128), smooth(1, 3, 32, 256)), torch.tensor([[0.3, 0.7]]), torch.zeros(1, 3)


def answers(network: nn.Module, given: tuple[Tensor, ...]) -> Tensor:
    with torch.inference_mode():
        answer = network(*given)
    return (answer[0] if isinstance(answer, tuple) else answer).float()


def network_with_statistics(name: str) -> nn.Module:
    """A network of random weights whose norms know what they read."""
    torch.manual_seed(0)
    network = build(name, **WIDE[name])
    for part in network.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.momentum = None  # the mean of all calls
            nn.init.uniform_(part.weight, 0.2, 1.5)
    with torch.no_grad():
        for _ in range(4):
            network.train()(*inputs(name))
    return network.eval()


def error(network: nn.Module, other: nn.Module, name: str) -> float:
    """Mean squared distance of answers on new inputs, as a share of their variance."""
    torch.manual_seed(9)
    given = inputs(name)
    one, two = answers(network, given), answers(other, given)
    return float((one - two).square().mean() / one.var())


@pytest.mark.parametrize("name", LAYERS)
def test_a_pruned_network_answers_more_as_before_than_slices_of_it(name, monkeypatch):
    network = network_with_statistics(name)
    given = [inputs(name) for _ in range(8)]
    smaller = pruned(name, network, NARROW[name], given)
    weights = [sum(each.numel() for each in one.parameters()) for one in (smaller, network)]
    assert weights[0] < 0.8 * weights[1] and not smaller.training
    monkeypatch.setattr(pruning, "_fit", lambda *_: None)
    sliced = pruned(name, network, NARROW[name], given)
    assert error(network, smaller, name) < 0.9 * error(network, sliced, name)


@pytest.mark.parametrize("name", LAYERS)
def test_a_network_that_keeps_all_its_channels_stays_as_it_is(name, monkeypatch):
    monkeypatch.setattr(pruning, "fast_arithmetic", lambda _: nullcontext())  # else bfloat16's roundings are fitted
    network = network_with_statistics(name)
    same = pruned(name, network, WIDE[name], [inputs(name)])
    assert error(network, same, name) < 1e-4


def test_a_released_translator_of_half_the_arithmetic_names_nearly_the_same_classes():
    network, card = load(weight_files("world")["translator"])
    view = card_view(Path(), card, "panorama")
    scan = read(street())
    image = project(scan, view)
    condition = one_hot_layers(image.spread(torch.zeros(len(scan), dtype=torch.int64))[None], 20)
    sectors = [
        (image.channels[None, ..., start : start + 256], condition[..., start : start + 256])
        for start in range(0, view.columns, 256)
    ]
    settings = {**card.settings, "widths": (16, 48, 96, 128, 192), "pyramid": 64}
    smaller = pruned("titan-pano", network, settings, sectors[1:])
    wanted, found = (answers(one, sectors[0]).argmax(1) for one in (network, smaller))
    assert (found == wanted).float().mean() > 0.85


@pytest.mark.parametrize("name", LAYERS)
def test_every_layer_with_weights_is_known(name):
    """Otherwise a narrower network could not be filled."""
    network = build(name, **WIDE[name])
    layers = list(LAYERS[name](network))
    known = {layer.name for layer in layers} | {layer.norm for layer in layers}
    whole = {"codes", "class_colours", "glass"}  # tables that have no channels
    found = {part for part, module in network.named_modules() if list(module.parameters(recurse=False))}
    assert found - whole == known - {""}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("salsanext", {"widths": (16, 24, 32, 48)}),
        ("salsanext", {"classes": 7}),
        ("scene-painter", {"class_colours": False, "glass": False}),
        ("scene-painter", {"colour_kernel": 5}),
    ],
)
def test_what_is_no_narrower_form_is_refused(name, changes):
    network = network_with_statistics(name)
    with pytest.raises(InputError, match="no narrower form"):
        pruned(name, network, {**WIDE[name], **changes}, [inputs(name)])


def test_networks_of_unknown_layers_are_refused():
    with pytest.raises(InputError, match="no layers of 'scunet'"):
        pruned("scunet", nn.Identity(), {}, [])


@pytest.mark.parametrize(("kernel", "stride", "dilation"), [(3, 1, 1), (3, 1, 2), (3, 2, 1), (1, 1, 1)])
def test_a_patch_is_what_a_convolution_reads(kernel, stride, dilation):
    torch.manual_seed(1)
    conv = CircularConv(3, 5, kernel, stride=stride, dilation=dilation).double()
    x = torch.randn(1, 3, 12, 40, dtype=torch.float64)
    with torch.no_grad():
        patches, answer = _sampled(conv, x, conv(x), 0)
        expected = patches.double() @ conv.weight.flatten(1).T + conv.bias
    assert torch.allclose(expected, answer.double(), atol=1e-5)


def test_a_layer_is_fitted_to_what_it_should_answer():
    torch.manual_seed(2)
    conv, wanted = nn.Conv2d(4, 3, 3), nn.Conv2d(4, 3, 3)
    patches = torch.randn(2000, 36)
    with torch.no_grad():
        target = patches @ wanted.weight.flatten(1).T + wanted.bias
        _fit(conv, patches, target)
        x = torch.randn(1, 4, 8, 8)
        assert torch.allclose(conv(x), conv2d(x, wanted.weight, wanted.bias), atol=0.02)
