"""SD-Net against the recorded run of the published network, and its parts against their slow definitions."""

from __future__ import annotations

import gc
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from golden_fill import assert_weights_as_recorded, fill, key_rows, sym
from golden_vectors import recorded
from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.sdnet import ObjectContext, ScalePrediction, SdNet, gather

FILE, GAIN, PARAMETERS = "hrnet_ocr_mscale_two", 0.85, 72_143_430  # MANIFEST.md, section 2
TOLERANCE = 1e-4
NOT_LAYERS = {"backbone.relu", "ocr.ocr_gather_head"}  # modules without weights there, functions here
TINY = {"classes": 5, "width": 4, "stem": 4, "blocks": 1, "modules": (1, 1, 1), "context": 8}


@pytest.fixture(scope="module")
def published(golden: Path):
    """The network with the weights of the fill rule, in evaluation mode."""
    model = build("sdnet").eval()
    model.load_state_dict(fill(model.state_dict(), GAIN))
    yield model
    del model
    gc.collect()


@pytest.fixture(scope="module")
def record(published: SdNet, golden: Path) -> tuple[dict[str, Tensor], dict[str, list]]:
    """Our outputs by the names of the recorded ones, and every recorded layer's outputs at 1.0 and then at 0.5."""
    names, layers = json.loads((golden / f"{FILE}.taps.json").read_text()).keys() - NOT_LAYERS, {}
    modules, predictions, hooks = dict(published.named_modules()), [], []
    for name in names:  # summed up at once, since what comes after works in place
        layers[name] = []
        hooks.append(modules[name].register_forward_hook(lambda _, __, out, n=name: layers[n].append(_summary(out))))
    look = published.look
    published.look = lambda images: predictions.append(look(images)) or predictions[-1]
    with torch.inference_mode():
        joint = published(sym("input.images", (1, 3, 128, 256), 2))
    del published.look
    for hook in hooks:
        hook.remove()
    full, half = predictions
    outputs = {"pred": joint, "pred_10x": full.logits, "pred_05x": half.logits, "attn_05x": half.attention}
    return outputs, layers


def _summary(out: Any) -> tuple[list[int], list[float]]:
    out = out if isinstance(out, Tensor) else out[0]
    flat = out.flatten().double()
    return list(out.shape), [flat.mean().item(), flat.std().item(), *flat[:4].tolist(), *flat[-2:].tolist()]


@pytest.mark.parity
@pytest.mark.parametrize("name", ["pred", "pred_10x", "pred_05x", "attn_05x"])
def test_outputs_are_the_published_ones(record, golden: Path, name: str) -> None:
    recorded(golden, FILE)[f"out.{name}"].assert_close(record[0][name], TOLERANCE)


@pytest.mark.parity
def test_every_layer_gives_what_the_published_one_gave(record, golden: Path) -> None:
    taps = json.loads((golden / f"{FILE}.taps.json").read_text())
    for name in taps.keys() - NOT_LAYERS:
        for (shape, numbers), row in zip(record[1][name], reversed(taps[name]), strict=True):  # theirs: 0.5 first
            assert shape == row["shape"], name
            theirs = [row["mean"], row["std"], *row["first"], *row["last"]]
            np.testing.assert_allclose(numbers, theirs, atol=TOLERANCE, rtol=0, err_msg=name)


@pytest.mark.parity
def test_keys_shapes_and_fill_are_the_published_ones(published: SdNet, golden: Path) -> None:
    rows = key_rows(golden, FILE)
    state = published.state_dict()
    assert sorted(state) == sorted(row[0] for row in rows)
    assert_weights_as_recorded(state, rows)


def test_parameters_are_as_many_as_published() -> None:
    with torch.device("meta"):
        model = build("sdnet")
    assert sum(parameter.numel() for parameter in model.parameters()) == PARAMETERS


def tiny(**settings: object) -> SdNet:
    """A small network in evaluation mode, filled so that attention differs from pixel to pixel."""
    model = build("sdnet", **TINY, **settings)
    assert isinstance(model, SdNet)
    model.load_state_dict(fill(model.state_dict(), 2.0))
    return model.eval()


def stretched(x: Tensor, size: tuple[int, int]) -> Tensor:
    return interpolate(x, size, mode="bilinear", align_corners=False)


def looks(model: SdNet, images: Tensor, scales: tuple[float, ...]) -> dict[float, ScalePrediction]:
    """What the network sees of pictures resized by torch itself."""
    resize = {"mode": "bilinear", "align_corners": False, "recompute_scale_factor": True}
    return {scale: model.look(interpolate(images, scale_factor=scale, **resize)) for scale in scales}


@pytest.mark.parametrize("size", [(45, 70), (64, 96), (33, 51)])
def test_four_scales_are_joined_as_the_published_formula_says(size: tuple[int, int]) -> None:
    """p = a1.5 p1.5 + (1 - a1.5) down(p2); p = a1 p1 + (1 - a1) down(p); p = up(a.5 p.5) + (1 - up(a.5)) p."""
    model, images = tiny(scales=(1.0, 0.5, 2.0, 1.5)), torch.randn(1, 3, *size)
    with torch.inference_mode():
        predictions = looks(model, images, (2.0, 1.5, 1.0, 0.5))
        middle = (int(size[0] * 1.5), int(size[1] * 1.5))
        joint, one = predictions[2.0].logits, predictions[1.5]
        joint = one.attention * one.logits + (1 - one.attention) * stretched(joint, middle)
        one = predictions[1.0]
        joint = one.attention * one.logits + (1 - one.attention) * stretched(joint, size)
        one = predictions[0.5]
        joint = stretched(one.attention * one.logits, size) + (1 - stretched(one.attention, size)) * joint
        assert predictions[0.5].attention.std() > 0.01  # or it could not be distinguished from any other weight
        torch.testing.assert_close(model(images), joint, atol=1e-5, rtol=0)


def test_scales_of_a_call_stand_in_for_those_of_the_network() -> None:
    model, images = tiny(scales=(1.0,)), torch.randn(1, 3, 40, 56)
    with torch.inference_mode():
        assert torch.equal(model(images), model.look(images).logits)
        other = model(images, (1.0, 0.5))
        assert not torch.equal(other, model(images))
        model.scales = (1.0, 0.5)
        assert torch.equal(other, model(images))


@pytest.mark.parametrize("scales", [(0.5,), (), (1.0, 1.0), (1.0, 0.0), (1.0, -0.5)])
def test_scales_that_cannot_be_are_refused(scales: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"scales \[.*\] cannot be: name positive factors"):
        build("sdnet", **TINY, scales=scales)
    with pytest.raises(InputError, match="cannot be"):
        tiny()(torch.zeros(1, 3, 8, 8), scales)


@pytest.mark.parametrize("size", [(1, 1), (7, 33), (61, 30)])
def test_images_of_any_size_are_answered_at_their_size(size: tuple[int, int]) -> None:
    with torch.inference_mode():
        logits = tiny()(torch.randn(2, 3, *size), (0.5, 1.0, 2.0))
    assert logits.shape == (2, TINY["classes"], *size) and logits.isfinite().all()


def test_training_gets_the_joint_the_auxiliary_and_each_scales_answer() -> None:
    model, images, size = tiny(), torch.randn(2, 3, 40, 56), (40, 56)
    with torch.no_grad():
        expected, predictions = model(images), looks(model, images, (0.5, 1.0))
        model.training = True  # itself alone: norms and dropout stay as in evaluation
        answers = model(images)
    torch.testing.assert_close(answers.joint, expected)
    half, full = predictions[0.5], predictions[1.0]
    torch.testing.assert_close(answers.each, (full.logits, stretched(half.logits, size)))
    guess = half.attention * stretched(half.auxiliary, (20, 28))
    auxiliary = stretched(full.auxiliary, size) * (1 - stretched(half.attention, size)) + stretched(guess, size)
    torch.testing.assert_close(answers.auxiliary, auxiliary, atol=1e-5, rtol=1e-5)


def test_training_drops_channels_before_the_answer_only() -> None:
    with torch.device("meta"):
        drops = {name: part.p for name, part in build("sdnet").named_modules() if isinstance(part, nn.Dropout2d)}
    assert drops == {"ocr.ocr_distri_head.conv_bn_dropout.2": 0.05}


def test_a_class_is_the_mean_of_all_pixels_weighted_by_its_guess() -> None:
    features, guess = torch.randn(2, 4, 3, 5), 2 * torch.randn(2, 6, 3, 5)
    expected = torch.zeros(2, 4, 6, 1)
    for b, k in np.ndindex(2, 6):
        weight = guess[b, k].exp()
        for c in range(4):
            expected[b, c, k, 0] = (features[b, c] * weight).sum() / weight.sum()
    torch.testing.assert_close(gather(features, guess), expected)


def test_context_is_what_the_classes_say_to_each_pixel() -> None:
    block = ObjectContext(6, 4).eval()
    features, classes = torch.randn(2, 6, 3, 5), 3 * torch.randn(2, 6, 7, 1)
    with torch.inference_mode():
        query, key, value = block.f_pixel(features), block.f_object(classes), block.f_down(classes)
        mixed = torch.zeros(2, 4, 3, 5)
        for b, i, j in np.ndindex(2, 3, 5):
            alike = [(query[b, :, i, j] @ key[b, :, k, 0]) / 4**0.5 for k in range(7)]
            for k, weight in enumerate(torch.stack(alike).softmax(0)):
                mixed[b, :, i, j] += weight * value[b, :, k, 0]
        torch.testing.assert_close(block(features, classes), block.f_up(mixed))
        assert block.f_up(mixed).std() > 0.01
