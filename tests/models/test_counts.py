"""How many parameters and multiplications the networks have, against what is recorded of the published ones."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from lidar2pano.models import MODELS, build

Settings = dict[str, Any]
# A camera segmenter of few layers: what a scale costs is a share of the whole, and every layer is applied to each.
NARROW: Settings = {"width": 4, "stem": 8, "blocks": 1, "modules": (1, 1, 1), "context": 8}

# table of keys in tests/golden -> network, its settings, parameters
PARAMETERS: dict[str, tuple[str, Settings, int]] = {
    "salsanext": ("salsanext", {}, 6_711_572),
    "titan_g": ("titan", {}, 6_765_290),
    "titan_d": ("titan-critic", {}, 44_784_390),
    "pix2pix_unet256": ("pix2pix", {"inputs": 25, "outputs": 15}, 54_461_071),
    "pix2pix_patchgan": ("pix2pix-critic", {}, 2_768_705),
    "scunet_assumed": ("scunet", {}, 7_719_395),
    "hrnet_ocr_mscale_two": ("sdnet", {}, 72_143_430),
    "vid2vid_512_scale1": ("vid2vid", {"widths": (128,)}, 411_335_241),
    "vid2vid_2048_scale3": ("vid2vid", {}, 415_075_371),
    "vid2vid_1024_g1_scale3": ("vid2vid", {"downsamplings": 2}, 142_763_835),
    "vid2vid_single_512": ("vid2vid-single", {}, 45_693_699),
    "vid2vid_single_2048": ("vid2vid-single", {"width": 32, "downsamplings": 4, "enhancers": 1}, 182_852_355),
    "vid2vid_D_image": ("vid2vid-image-critic", {}, 5_606_786),
    "vid2vid_D_temporal": ("vid2vid-temporal-critic", {}, 5_553_538),
}
OURS = {
    "autoencoder",
    "latent-painter",
    "projected-critic",
    "titan-pano",
    "titan-next",
}  # nothing published to compare with

# network, inputs without the batch, 10^9 multiplications, as counted on the published networks
GMACS: list[tuple[str, list[tuple[int, ...]], float]] = [
    ("salsanext", [(5, 64, 2048)], 62.3),
    ("titan", [(5, 64, 512), (20, 64, 512)], 20.3),
    ("titan", [(5, 64, 2048), (20, 64, 2048)], 81.4),
]


def blank(network: str, settings: Settings) -> nn.Module:
    """A network without memory for its weights."""
    with torch.device("meta"):
        return build(network, **settings).eval()


def multiplications(network: nn.Module, shapes: list[tuple[int, ...]]) -> int:
    """Of one sample's forward pass, in convolutions and matrix products; nothing is computed."""
    inputs = [torch.empty(1, *shape, device="meta") for shape in shapes]
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(*inputs)
    return counter.get_total_flops() // 2


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_are_as_many_as_recorded(name: str) -> None:
    network, settings, expected = PARAMETERS[name]
    assert sum(weight.numel() for weight in blank(network, settings).parameters()) == expected


def test_every_published_network_is_counted() -> None:
    assert {network for network, _, _ in PARAMETERS.values()} | OURS == MODELS.keys()


@pytest.mark.parity
def test_the_table_is_the_recorded_one(golden: Path) -> None:
    heads = [path.read_text().partition("\n")[0] for path in golden.glob("*.keys.txt")]
    counts = dict(re.fullmatch(r"# (\w+): \d+ entries, (\d+) parameters.*", head).groups() for head in heads)
    assert {name: int(count) for name, count in counts.items()} == {
        name: expected for name, (_, _, expected) in PARAMETERS.items()
    }


@pytest.mark.parametrize(("network", "shapes", "expected"), GMACS)
def test_multiplications_are_as_many_as_documented(
    network: str, shapes: list[tuple[int, ...]], expected: float
) -> None:
    assert multiplications(blank(network, {}), shapes) / 1e9 == pytest.approx(expected, abs=0.05)


def test_a_third_scale_costs_the_camera_segmenter_what_is_documented() -> None:
    """4.2 times the multiplications of the default two scales; FACTS.md, section 2.4."""
    two, three = (
        multiplications(blank("sdnet", {"scales": scales, **NARROW}), [(3, 128, 256)])
        for scales in ((0.5, 1.0), (0.5, 1.0, 2.0))
    )
    assert three / two == pytest.approx(4.2, abs=0.05)


def test_multiplications_are_those_of_the_definition() -> None:
    network = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1, stride=2), nn.ConvTranspose2d(8, 2, 2, stride=2)).to("meta")
    expected = 3 * 8 * 9 * (8 * 16) + 8 * 2 * 4 * (8 * 16)  # per pixel of the smaller picture
    assert multiplications(network, [(3, 16, 32)]) == expected


def test_the_decoder_of_a_panorama_costs_less_than_a_hundred_gmac():
    decoder = blank("autoencoder", {}).decoder
    assert multiplications(decoder, [(32, 48, 576)]) < 100e9
