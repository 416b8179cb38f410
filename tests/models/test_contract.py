"""What every network of MODELS must do, whatever it is for."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.models import MODELS, build
from lidar2pano.models.blocks import CircularConv
from lidar2pano.models.card import Card, load, save
from lidar2pano.models.titan_pano import continued, evidence, with_rows
from lidar2pano.views import VIEWS


def _range_image(rows: int, columns: int) -> Tensor:
    """Two range images (2, 5, rows, columns), metres, a third of the pixels empty."""
    image = torch.randn(2, 5, rows, columns) * torch.tensor([0.0, 9, 9, 1, 0.2])[None, :, None, None]
    image[:, 0] = image[:, 1:4].norm(dim=1)
    return image * (torch.rand(2, 1, rows, columns) > 1 / 3)


def _one_hot(classes: int, rows: int, columns: int) -> Tensor:
    labels = torch.randint(classes, (2, rows, columns))
    return nn.functional.one_hot(labels, classes).permute(0, 3, 1, 2).float()


# network -> settings of a small instance, and inputs for a batch of two; every network of MODELS needs a row
SMALL: dict[str, tuple[dict[str, object], Callable[[], tuple[Tensor, ...]]]] = {
    "salsanext": ({"classes": 7}, lambda: (_range_image(32, 64) / 10,)),
    "titan": (
        {"classes": 6, "conditions": 4, "size": (24, 40)},
        lambda: (_range_image(32, 64) / 10, _one_hot(4, 32, 64)),
    ),
    "titan-critic": (
        {"image_channels": 6, "conditions": 4, "width": 4},
        lambda: (_one_hot(6, 96, 128), _one_hot(4, 16, 32)),
    ),
    "titan-pano": (
        {"classes": 6, "conditions": 4, "widths": (8, 12, 16, 20, 24), "pyramid": 8},
        lambda: (_range_image(32, 64), _one_hot(4, 32, 64)),
    ),
    "autoencoder": (
        {"latents": 6, "encoder": (4, 6, 8), "decoder": (4, 4, 6, 8)},
        lambda: (2 * torch.rand(2, 3, 24, 32) - 1,),
    ),
    "latent-painter": (
        {
            "looks": ["day", "evening"],
            "latents": 6,
            "autoencoder": ((4, 6, 8), (4, 4, 6, 8)),
            "mean": ((6, 8, 10), (1, 1, 1)),
            "flow": ((8, 10, 12), (1, 1, 1)),
            "code": 8,
        },
        lambda: (
            torch.randn(2, 26, 32, 64),
            torch.eye(2),
            torch.randn(2, 6, 8, 16),
            torch.tensor([0.2, 0.7]),
            torch.tensor([0.0, 0.25]),
            torch.ones(2),
            torch.randn(2, 7, 8, 16),
            torch.randn(2, 13),
        ),
    ),
    "projected-critic": (
        {"features": (4, 6, 8, 10), "conditions": 3, "mixed": 8, "width": 8},
        lambda: (torch.randn(2, 3, 64, 128), *(torch.randn(2, 2 * n + 4, 32 >> n, 64 >> n) for n in range(4))),
    ),
    "pix2pix": ({"inputs": 7, "outputs": 4, "width": 2, "depth": 6}, lambda: (torch.randn(2, 7, 64, 96),)),
    "pix2pix-critic": ({"channels": 7, "width": 4}, lambda: (torch.randn(2, 7, 64, 96),)),
    "scunet": ({"widths": (4, 6, 8, 10)}, lambda: (torch.rand(2, 1, 16, 24) * (torch.rand(2, 1, 16, 24) > 0.5),)),
    "titan-next": (
        {"classes": 6, "conditions": 4, "size": (24, 40), "width": 4},
        lambda: (_range_image(32, 64) / 10, _one_hot(4, 32, 64)),
    ),
    "sdnet": (
        {"classes": 6, "width": 4, "stem": 8, "blocks": 1, "modules": [1, 1, 1], "context": 16},
        lambda: (torch.randn(2, 3, 67, 101),),
    ),
    "vid2vid": (
        {"channels": 5, "widths": (8,), "downsamplings": 2, "blocks": (2, 1), "foreground": (1,)},
        lambda: (_one_hot(5, 96, 64).unflatten(2, (3, 32)).transpose(1, 2), 2 * torch.rand(2, 2, 3, 32, 64) - 1),
    ),
    "vid2vid-single": (
        {"classes": 5, "width": 8, "downsamplings": 2, "blocks": 2, "enhancers": 1, "local_blocks": 1},
        lambda: (_one_hot(5, 32, 64),),
    ),
    "vid2vid-image-critic": ({"channels": 7, "width": 8}, lambda: (torch.randn(2, 7, 64, 96),)),
    "vid2vid-temporal-critic": ({"channels": 6, "width": 8}, lambda: (torch.randn(2, 6, 64, 96),)),
}

# How many tensors the small instances answer, and the shape of the last; every network of MODELS needs a row.
ANSWERS: dict[str, tuple[int, tuple[int, ...]]] = {
    "salsanext": (1, (2, 7, 32, 64)),
    "titan": (1, (2, 6, 24, 40)),
    "titan-critic": (1, (2, 1, 1, 1)),
    "titan-next": (2, (2, 24, 40)),
    "titan-pano": (2, (2, 32, 64)),
    "autoencoder": (2, (2, 6, 3, 4)),
    "latent-painter": (2, (2, 6, 8, 16)),
    "projected-critic": (4, (2, 1, 8, 16)),
    "pix2pix": (1, (2, 4, 64, 96)),
    "pix2pix-critic": (1, (2, 1, 6, 10)),
    "scunet": (1, (2, 3, 16, 24)),
    "sdnet": (1, (2, 6, 67, 101)),
    "vid2vid": (4, (2, 3, 32, 64)),
    "vid2vid-single": (1, (2, 3, 32, 64)),
    "vid2vid-image-critic": (10, (2, 1, 7, 9)),
    "vid2vid-temporal-critic": (10, (2, 1, 7, 9)),
}

# Networks that close in azimuth -> columns of the input by whose multiples a turn changes nothing.
CIRCULAR = {"titan-pano": 16, "autoencoder": 8, "latent-painter": 16}

# Titan normalises each sample after every activation, which amplifies small errors (sixtyfold with fresh weights, here
# as in the published network); its answers are held to looser limits by this factor.
AMPLIFIES = {"titan": 5.0}

every_network = pytest.mark.parametrize("network", sorted(MODELS))


def _example(network: str) -> tuple[nn.Module, tuple[Tensor, ...]]:
    torch.manual_seed(0)
    settings, inputs = SMALL[network]
    return build(network, **settings).eval(), inputs()


def _tensors(out: Tensor | list | tuple) -> Iterator[Tensor]:
    if isinstance(out, Tensor):
        yield out
    else:
        for part in out:
            yield from _tensors(part)


def _run(model: nn.Module, inputs: tuple[Tensor, ...]) -> list[Tensor]:
    with torch.no_grad():
        return list(_tensors(model(*inputs)))


def test_every_network_has_an_example() -> None:
    assert SMALL.keys() == ANSWERS.keys() == MODELS.keys()


@every_network
def test_answers_have_the_promised_shapes(network: str) -> None:
    model, inputs = _example(network)
    answers = _run(model, inputs)
    assert (len(answers), tuple(answers[-1].shape)) == ANSWERS[network]
    assert {(len(out), out.dtype) for out in answers} == {(2, torch.float32)}


@every_network
def test_odd_sizes_are_taken_or_refused_with_the_size(network: str) -> None:
    model, inputs = _example(network)
    odd = tuple(x[..., :-3, :-5] if x.ndim > 2 else x for x in inputs)
    usual, size, odd_size = _run(model, inputs), inputs[0].shape[-2:], odd[0].shape[-2:]
    try:
        answers = _run(model, odd)
    except InputError as refusal:
        assert "\n" not in str(refusal)
        assert all(str(pixels) in str(refusal) for pixels in odd_size)
        return
    for before, out in zip(usual, answers, strict=True):
        assert out.isfinite().all()
        assert out.shape[0] == 2
        if before.shape[-2:] == size:
            assert out.shape[-2:] == odd_size


@every_network
def test_what_is_circular_says_so(network: str) -> None:
    model, _ = _example(network)
    assert (network in CIRCULAR) == any(isinstance(part, CircularConv) for part in model.modules())


@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("network", CIRCULAR)
def test_what_is_circular_turns_with_its_input(network: str, times: int) -> None:
    model, inputs = _example(network)
    turn, columns = times * CIRCULAR[network], inputs[0].shape[-1]
    turned = [out.roll(turn * out.shape[-1] // columns, -1) for out in _run(model, inputs)]
    rolled = (x.roll(turn * x.shape[-1] // columns, -1) if x.ndim > 2 else x for x in inputs)
    _assert_near(_run(model, tuple(rolled)), turned, 1e-4)


@every_network
def test_evaluation_is_deterministic_and_leaves_network_and_inputs_alone(network: str) -> None:
    model, inputs = _example(network)
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    given = [tensor.clone() for tensor in inputs]
    first, second = _run(model, inputs), _run(model, inputs)
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))
    assert all(torch.equal(model.state_dict()[key], tensor) for key, tensor in before.items())
    assert all(torch.equal(one, other) for one, other in zip(given, inputs, strict=True))
    assert all(tensor.isfinite().all() for tensor in first)


@every_network
def test_the_gradient_reaches_every_parameter(network: str) -> None:
    model, inputs = _example(network)
    sum((out * torch.randn_like(out)).sum() for out in _tensors(model.train()(*inputs))).backward()
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:  # random for good, as in the projected critic
            continue
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


@every_network
def test_gradients_of_a_batch_of_one_do_not_depend_on_the_layout(network: str) -> None:
    """With torch's own instance norm they do, on CPUs."""
    expected, gradient = _gradient(network, torch.contiguous_format), _gradient(network, torch.channels_last)
    assert (gradient - expected).norm() <= 0.1 * expected.norm()


def _gradient(network: str, layout: torch.memory_format) -> Tensor:
    """The gradient of all weights for the first sample, without chance, as one vector."""
    model, inputs = _example(network)
    for part in model.train().modules():
        if isinstance(part, nn.Dropout | nn.Dropout2d):
            part.p = 0.0
    answers = list(_tensors(model.to(memory_format=layout)(*(x[:1] for x in inputs))))
    torch.manual_seed(1)
    sum((out * torch.randn(out.shape)).sum() for out in answers).backward()
    return torch.cat([weight.grad.flatten() for weight in model.parameters() if weight.requires_grad])


@every_network
def test_what_is_saved_is_what_is_loaded(network: str, tmp_path: Path) -> None:
    model, inputs = _example(network)
    card = Card(network=network, settings=SMALL[network][0])
    save(tmp_path / "weights", model, card, torch.float32)
    again, _ = load(tmp_path / "weights", expect=network)
    assert all(torch.equal(one, other) for one, other in zip(_run(model, inputs), _run(again, inputs), strict=True))


@every_network
def test_half_precision_files_give_nearly_the_same_answer(network: str, tmp_path: Path) -> None:
    model, inputs = _example(network)
    save(tmp_path / "weights", model, Card(network=network, settings=SMALL[network][0]))
    again, _ = load(tmp_path / "weights")
    _assert_near(_run(again, inputs), _run(model, inputs), 0.02 * AMPLIFIES.get(network, 1.0))


@every_network
def test_samples_of_a_batch_do_not_know_each_other(network: str) -> None:
    model, inputs = _example(network)
    both = _run(model, inputs)
    alone = [_run(model, tuple(tensor[i : i + 1] for tensor in inputs)) for i in (0, 1)]
    joined = [torch.cat(pair) for pair in zip(*alone, strict=True)]
    _assert_near(joined, both, 1e-4)
    assert any(not torch.equal(out[0], out[1]) for out in both)


@every_network
def test_channels_last_and_bfloat16_give_nearly_the_same_answer(network: str) -> None:
    model, inputs = _example(network)
    plain = _run(model, inputs)
    model = model.to(memory_format=torch.channels_last)
    inputs = tuple(x.to(memory_format=torch.channels_last) if x.ndim == 4 else x for x in inputs)
    _assert_near(_run(model, inputs), plain, 1e-4)
    with torch.autocast("cpu", torch.bfloat16):
        _assert_near(_run(model, inputs), plain, 0.15 * AMPLIFIES.get(network, 1.0))


def _assert_near(ours: list[Tensor], theirs: list[Tensor], allowed: float) -> None:
    """The root mean square of the difference is at most `allowed` times the expected values' spread."""
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert one.shape == other.shape
        spread = other.std() if other.numel() > 1 else other.abs().max()
        assert (one.float() - other).square().mean().sqrt() <= allowed * spread


@pytest.mark.parametrize("network", ["salsanext", "titan", "titan-next"])
@pytest.mark.parametrize("shape", [(40, 64), (64, 40)])
def test_a_raster_that_cannot_be_halved_four_times_is_named(network: str, shape: tuple[int, int]) -> None:
    model = build(network)
    inputs = (torch.zeros(1, 5, *shape), torch.zeros(1, 20, *shape))[: 1 if network == "salsanext" else 2]
    with pytest.raises(InputError, match=f"{shape[0]} x {shape[1]} pixels: rows, columns must divide by 16"):
        model(*inputs)


def test_a_row_is_numbered_by_its_elevation():
    # the panorama's rows: 192 of (0.24 + 0.2836) / 192 each; a row's middle at tangent t has the number
    numbers = {
        0.24 - 0.5236 / 192 / 2: 1.0,
        -0.2836 + 0.5236 / 192 / 2: -1.0,
        0.44: 1 - 2 * ((0.24 - 0.44) * 192 / 0.5236 - 0.5) / 191,
        0.0: 1 - 2 * (0.24 * 192 / 0.5236 - 0.5) / 191,
    }
    half = VIEWS["panorama"].scaled(0.5)
    image = torch.rand(2, 5, 192, 32)
    assert with_rows(image, half) is image
    for view in (VIEWS["panorama-tall"].scaled(0.5), half.between(0.1, -0.8, 16)):
        tall = with_rows(torch.rand(2, 5, view.rows, 32), view)
        row = evidence(tall)[:, 4]
        assert torch.equal(row[:, :, :1].expand_as(row), row)
        pitch = (view.up - view.down) / view.rows
        for tangent, number in numbers.items():
            place = (view.up - tangent) / pitch - 0.5
            if 0 <= place <= view.rows - 1:
                before, after = row[0, int(place), 0], row[0, min(int(place) + 1, view.rows - 1), 0]
                assert torch.lerp(before, after, place % 1) == pytest.approx(number, abs=1e-5)
    tall = evidence(with_rows(torch.rand(1, 5, 400, 32), VIEWS["panorama-tall"].scaled(0.5)))[0, 4, 80:272]
    assert torch.allclose(tall, evidence(image)[0, 4], atol=1e-6)


def test_where_no_point_is_the_nearest_one_of_the_column_is_read() -> None:
    torch.manual_seed(0)
    channels = torch.rand(2, 5, 13, 9)
    channels[:, 3] = torch.rand(2, 13, 9) < 0.2
    channels[:, 3, :, 4] = 0
    channels[:, :3] *= channels[:, 3:4]
    classes = torch.nn.functional.one_hot(torch.randint(3, (2, 13, 9)), 3).movedim(3, 1).float()
    both = torch.cat([channels, classes], 1)
    joined = continued(channels, classes)
    assert torch.equal(joined[:, :8], both)
    for sample, row, column in itertools.product(range(2), range(13), range(9)):
        points = [r for r in range(13) if channels[sample, 3, r, column]]
        nearest = min(points, key=lambda r: (abs(r - row), -r), default=12)  # of equal ones the lower
        copied = both[sample, :, nearest, column].clone()
        copied[3] = 1 / (1 + abs(nearest - row)) if points else 0.0
        assert torch.allclose(joined[sample, 8:, row, column], copied)


@pytest.mark.parametrize("network", ["salsanext", "titan", "titan-next", "titan-pano", "pix2pix"])
def test_dropout_works_in_training_only(network: str) -> None:
    model, inputs = _example(network)
    for norm in model.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.momentum = 0.0
    one, other = _run(model.train(), inputs), _run(model, inputs)
    assert (one[0] - other[0]).abs().max() > 1e-3


def test_a_critic_takes_images_of_any_size_and_its_gradient_twice() -> None:
    critic = build("titan-critic", width=4)
    image = torch.rand(2, 15, 64, 90, requires_grad=True)
    scores = critic(image, torch.rand(2, 20, 16, 48))
    assert scores.shape == (2, 1, 1, 1)
    (slope,) = torch.autograd.grad(scores.sum(), image, create_graph=True)
    slope.square().sum().backward()
    assert all(layer.weight.grad.any() for layer in critic.model if isinstance(layer, nn.Conv2d))


def test_the_critic_learns_from_its_condition_in_half_precision() -> None:
    """Torch's own gradient of a dilated convolution of 30 channels is noise there, or NaN."""
    torch.manual_seed(1)
    critic = build("titan-critic", width=16).to(memory_format=torch.channels_last)
    image, condition = torch.rand(1, 15, 96, 160), torch.rand(1, 20, 32, 96)
    gradients = []
    for half in (False, True):
        critic.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            critic(image, condition).float().sum().backward()
        gradients.append([weight.grad.clone() for weight in critic.conv1.parameters()])
    for expected, gradient in zip(*gradients, strict=True):
        assert (gradient - expected).norm() <= 0.2 * expected.norm()
    with torch.autocast("cpu", torch.bfloat16):
        scores = critic(image.bfloat16(), condition.bfloat16())
    assert scores.isfinite().all(), "Fabric hands inputs over in half precision"


def test_unknown_names_and_settings_are_named() -> None:
    with pytest.raises(InputError, match="no network 'salsanex'; did you mean 'salsanext'"):
        build("salsanex")
    with pytest.raises(InputError, match="'salsanext' has no setting 'n_classes'; did you mean 'classes'"):
        build("salsanext", n_classes=3)
