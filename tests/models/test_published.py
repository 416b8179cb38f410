"""The networks of TITAN-Net against recorded runs of the published code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from golden_fill import assert_weights_as_recorded, fill, key_rows, one_hot, randint, sym
from golden_vectors import Recorded, recorded
from lidar2pano.models import build

# network -> file in the golden folder, gain of the fill rule, parameters; MANIFEST.md, section 2
RECORDED = {
    "salsanext": ("salsanext", 1.2, 6_711_572),
    "titan": ("titan_g", 1.0, 6_765_290),
    "titan-critic": ("titan_d", 1.4, 44_784_390),
}
# Absolute tolerances. MANIFEST.md gives 1e-4 for probabilities and the critic's scores, 5e-4 for titan at 64x2048.
# It gives none for titan's logits: the instance norm on its one-channel merges amplifies rounding, and the recorded
# float32 logits (standard deviation 1.2) are themselves 2e-4 away from a float64 run.
TOLERANCE = {"salsanext": 1e-4, "titan": 1e-4, "titan-2048": 5e-4, "titan-critic": 1e-4, "titan-logits": 1e-3}


def with_fill_rule(network: str) -> nn.Module:
    """`network` in evaluation mode, with the weights of the fill rule."""
    model = build(network).eval()
    model.load_state_dict(fill(model.state_dict(), RECORDED[network][1]))
    return model


def inputs(network: str, columns: int = 256) -> tuple[Tensor, ...]:
    """What the recorded run was given."""
    if network == "salsanext":
        return (sym("input.x", (1, 5, 64, columns), 2),)
    condition = one_hot(randint("input.cond", (1, 64, columns), 20), 20)
    if network == "titan":
        return sym("input.z", (1, 5, 64, columns), 2), condition
    return one_hot(randint("input.a", (1, 376, 1241), 15), 15), condition


def compared(golden: Path, network: str) -> dict[str, tuple[Tensor, Recorded]]:
    """Our tensor and the recorded one, by what they are."""
    model, kept = with_fill_rule(network), recorded(golden, RECORDED[network][0])
    with torch.inference_mode():
        if network == "salsanext":
            logits = model(*inputs(network))
            pairs = {"logits": (logits, kept["out.logits"]), "softmax": (logits.softmax(1), kept["out.output"])}
        elif network == "titan-critic":
            merged = model.conv1(inputs(network)[1])
            pairs = {
                "scores": (model(*inputs(network)), kept["out.output"]),
                "condition": (merged, kept["out.cond_conv1"]),
            }
        else:
            wide = recorded(golden, "titan_g_2048")
            raster, raster_2048 = model.raster(*inputs(network)), model.raster(*inputs(network, 2048))
            pairs = {
                "softmax": (_published_image(raster)[:, :, ::8, ::8], kept["out.prob_s8"]),
                "z": (model.project_z(inputs(network)[0]), kept["out.project_z"]),
                "condition": (model.project_cond(inputs(network)[1]), kept["out.project_cond"]),
                "logits": (raster, kept["out.logits_preresize"]),
                "2048": (_published_image(raster_2048)[:, :, ::8, ::8], wide["out.prob_s8"]),
                "2048 logits": (raster_2048[:, :, ::4, ::8], wide["out.logits_preresize_s4"]),
            }
    return pairs


def _published_image(raster: Tensor) -> Tensor:
    return interpolate(raster, (376, 1241), mode="bilinear", align_corners=True).softmax(1)


def tolerance(network: str, what: str) -> float:
    """Absolute tolerance for one entry of `compared`."""
    if network == "titan" and what != "softmax":
        return TOLERANCE["titan-2048" if what == "2048" else "titan-logits"]
    return TOLERANCE[network]


@pytest.mark.parity
@pytest.mark.parametrize("network", RECORDED)
def test_outputs_are_the_published_ones(golden: Path, network: str) -> None:
    for what, (ours, theirs) in compared(golden, network).items():
        theirs.assert_close(ours, tolerance(network, what), what)


@pytest.mark.parity
def test_titan_forward_is_the_resized_raster(golden: Path) -> None:
    model, kept = with_fill_rule("titan"), recorded(golden, "titan_g")
    with torch.inference_mode():
        logits = model(*inputs("titan"))
    assert logits.shape == (1, 15, 376, 1241)
    kept["out.prob_s8"].assert_close(logits.softmax(1)[:, :, ::8, ::8], 1e-4)
    argmax = kept["out.argmax"]
    assert (argmax.of(logits.argmax(1)) == argmax.values).float().mean() > 0.999


@pytest.mark.parity
@pytest.mark.parametrize("network", RECORDED)
def test_keys_shapes_and_fill_are_the_published_ones(golden: Path, network: str) -> None:
    rows = key_rows(golden, RECORDED[network][0])
    state = with_fill_rule(network).state_dict()
    assert sorted(state) == sorted(row[0] for row in rows)
    assert_weights_as_recorded(state, rows)


@pytest.mark.parametrize("network", RECORDED)
def test_parameters_are_as_many_as_published(network: str) -> None:
    with torch.device("meta"):
        model = build(network)
    assert sum(parameter.numel() for parameter in model.parameters()) == RECORDED[network][2]


@pytest.mark.parity
@pytest.mark.parametrize("network", RECORDED)
def test_every_layer_gives_what_the_published_one_gave(golden: Path, network: str) -> None:
    taps = json.loads((golden / f"{RECORDED[network][0]}.taps.json").read_text())
    model, found = with_fill_rule(network), {}
    layers = dict(model.named_modules())
    for name in taps:  # summed up at once, since the next activation works in place
        layers[name].register_forward_hook(lambda _, __, out, name=name: found.update({name: _summary(out)}))
    with torch.inference_mode():
        model(*inputs(network))
    assert found.keys() == taps.keys()
    allowed = TOLERANCE["titan-logits" if network == "titan" else network]
    for name, (row,) in taps.items():
        shape, numbers = found[name]
        assert shape == row["shape"], name
        theirs = [row["mean"], row["std"], *row["first"], *row["last"]]
        np.testing.assert_allclose(numbers, theirs, atol=allowed, rtol=0, err_msg=name)


def _summary(out: Tensor | tuple[Tensor, ...]) -> tuple[list[int], list[float]]:
    out = out[0] if isinstance(out, tuple) else out
    flat = out.flatten().double()
    return list(out.shape), [flat.mean().item(), flat.std().item(), *flat[:4].tolist(), *flat[-2:].tolist()]


def test_training_drops_the_channels_that_the_published_networks_drop() -> None:
    with torch.device("meta"):
        shares = {
            network: {name: part.p for name, part in build(network).named_modules() if isinstance(part, nn.Dropout2d)}
            for network in ("salsanext", "titan")
        }
    none = {"resBlock1.dropout", *(f"upBlock4.dropout{i}" for i in (1, 2, 3))}
    assert {name for name, share in shares["salsanext"].items() if share == 0} == none
    none |= {"upResBlock1.dropout", *(f"upBlock1.dropout{i}" for i in (1, 2, 3))}
    assert {name for name, share in shares["titan"].items() if share == 0} == none
    assert {share for of in shares.values() for share in of.values()} == {0, 0.2}
