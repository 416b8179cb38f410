"""Losses: numbers worked by hand, the recorded ones, and agreement with slow definitions."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from golden_fill import sym
from golden_vectors import facts, recorded
from lidar2pano.losses import lovasz_softmax, supervised
from lidar2pano.losses.adversarial import critic_wasserstein, generator_wasserstein, gradient_penalty, hinge_critic
from lidar2pano.metrics.confusion import MeanIoU
from slow_definitions import lovasz_softmax_slowly


@pytest.fixture(params=["numpy", "device"])
def kernel(request, monkeypatch):
    """Both ways to compute it: the one for the CPU, and the one for other devices (run here on the CPU)."""
    if request.param == "device":
        monkeypatch.setattr(supervised, "_on_cpu", supervised._on_device)
    return request.param


def scores(classes: int, *shape: int, spread: float = 2.0) -> torch.Tensor:
    return (spread * torch.randn(shape[0], classes, *shape[1:])).softmax(1).requires_grad_()


def slope(loss: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    return torch.autograd.grad(loss, at)[0]


# --- Lovasz-Softmax -------------------------------------------------------------------------------------------------

# three pixels in a row; class 0 owns the first two, class 1 the third
TARGET = torch.tensor([[[0, 0, 1]]])
FIRST = [0.9, 0.6, 0.3]
# class 0: errors .4 (its own), .3 (not), .1 (its own) cost 1/2, 1/6, 1/3 each: .28333
# class 1: errors .4 (not), .3 (its own), .1 (not) cost 1/2, 1/2, 0: .35
WORKED = torch.tensor([FIRST, [1 - p for p in FIRST]])[None, :, None]


def test_lovasz_of_three_pixels(kernel):
    loss = lovasz_softmax(WORKED.requires_grad_(), TARGET)
    assert loss.item() == pytest.approx((0.28333333 + 0.35) / 2, abs=1e-6)
    assert slope(loss, WORKED).flatten().tolist() == pytest.approx([-1 / 6, -1 / 4, 1 / 12, 0, 1 / 4, -1 / 4], abs=1e-6)


def test_lovasz_of_hard_answers_is_one_minus_miou(kernel):
    target = torch.randint(5, (2, 20, 30))
    answers = torch.where(torch.rand(target.shape) < 0.4, torch.randint(5, target.shape), target)
    classes = MeanIoU(5)
    classes.update(answers, target, "")
    hard = nn.functional.one_hot(answers, 5).movedim(-1, 1).float()
    assert lovasz_softmax(hard, target).item() == pytest.approx(1 - classes.compute(), abs=1e-6)
    assert lovasz_softmax(nn.functional.one_hot(target, 5).movedim(-1, 1).float(), target) == 0


def untied(target: torch.Tensor, classes: int, reach: float) -> torch.Tensor:
    """Values in (0, 1), up to 0.25 higher where they should be, of which no two give a class the same error.

    They are (4k + 1) / 2^22, so that their errors and those from 1 are exact in float32 and differ; `reach` is the
    share of (0, 0.75) that they fill.
    """
    k = torch.stack([torch.randperm(int(reach * 0.75 * 2**20))[: target.numel()] for _ in range(classes)], 1)
    k = k.view(*target.shape, classes).movedim(-1, 1)
    own = target[:, None] == torch.arange(classes).view(1, -1, 1, 1)
    return ((4 * (k + own * 2**18) + 1) / 2**22).contiguous().requires_grad_()


@pytest.mark.parametrize("reach", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("ignore", [None, 0, 4])
def test_lovasz_agrees_with_its_definition(kernel, ignore, reach):
    target = torch.randint(6, (3, 23, 31))
    target[target == 2] = 3  # class 2 owns nothing
    probabilities = untied(target, 6, reach)
    loss = lovasz_softmax(probabilities, target, ignore=ignore)
    precise = probabilities.detach().double().requires_grad_()
    expected = lovasz_softmax_slowly(precise, target, ignore)
    assert loss.item() == pytest.approx(expected.item(), abs=2e-7)
    torch.testing.assert_close(slope(loss, probabilities), slope(expected, precise).float(), rtol=1e-5, atol=1e-10)


def test_lovasz_gradient_reaches_only_what_counts(kernel):
    target = torch.randint(4, (1, 16, 16))
    target[:, :4] = 255
    probabilities = scores(4, 1, 16, 16)
    gradient = slope(3 * lovasz_softmax(probabilities, target, ignore=255), probabilities)
    assert not gradient[:, :, :4].any()
    rest = probabilities.detach()[:, :, 4:].requires_grad_()
    torch.testing.assert_close(gradient[:, :, 4:], 3 * slope(lovasz_softmax(rest, target[:, 4:]), rest))


@pytest.mark.parametrize(("ignore", "dtype"), [(7, torch.uint8), (7, torch.int32)])
def test_lovasz_leaves_out_ids_that_are_ignored_or_no_class(kernel, ignore, dtype):
    target = torch.randint(6, (1, 16, 16))
    strange = target.clone().to(dtype)
    strange[:, 3:9], strange[:, 9], strange[:, 10] = 7, 200 if dtype == torch.uint8 else -1, 250
    probabilities = scores(9, 1, 16, 16)
    kept = torch.cat([torch.arange(3), torch.arange(11, 16)])
    expected = lovasz_softmax(probabilities[:, :, kept], target[:, kept])
    assert lovasz_softmax(probabilities, strange, ignore=ignore).item() == pytest.approx(expected.item(), abs=1e-6)


def test_lovasz_of_nothing_is_zero_and_has_a_graph(kernel):
    probabilities = scores(4, 2, 8, 8)
    target = torch.zeros(2, 8, 8, dtype=torch.int64)
    loss = lovasz_softmax(probabilities, target, ignore=0)
    loss.backward()
    assert loss == 0
    assert not probabilities.grad.any()


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_lovasz_of_half_precision_is_computed_in_float32(kernel, dtype, layout):
    target = torch.randint(5, (2, 16, 24))
    narrow = scores(5, 2, 16, 24).to(dtype).detach().to(memory_format=layout).requires_grad_()
    wide = narrow.detach().float().requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = lovasz_softmax(narrow, target)
    expected = lovasz_softmax(wide, target)
    assert loss.dtype == torch.float32
    assert loss == expected
    assert torch.equal(slope(loss, narrow), slope(expected, wide).to(dtype))


def test_lovasz_does_not_depend_on_threads():
    target, probabilities = torch.randint(8, (2, 40, 40)), scores(8, 2, 40, 40)
    before, answers = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            loss = lovasz_softmax(probabilities, target)
            answers.append((loss.item(), slope(loss, probabilities)))
    finally:
        torch.set_num_threads(before)
    assert answers[0][0] == answers[1][0]
    assert torch.equal(answers[0][1], answers[1][1])


@pytest.mark.parametrize("pixel", [(0, 0), (3, 4)])
def test_lovasz_shows_what_is_not_a_number(kernel, pixel):
    probabilities = scores(3, 1, 8, 8).detach()
    probabilities[0, 1][pixel] = torch.nan
    assert lovasz_softmax(probabilities, torch.randint(3, (1, 8, 8))).isnan()


def test_lovasz_refuses_what_it_cannot_mean():
    target = torch.zeros(1, 8, 8, dtype=torch.int64)
    with pytest.raises(ValueError, match="apply softmax first"):
        lovasz_softmax(torch.randn(1, 3, 8, 8), target)
    with pytest.raises(ValueError, match=r"got \(1, 3, 8, 8\) and \(1, 8, 9\)"):
        lovasz_softmax(torch.rand(1, 3, 8, 8), torch.zeros(1, 8, 9, dtype=torch.int64))


@pytest.mark.parity
@pytest.mark.parametrize(
    ("variant", "value", "settings"),
    [
        ("ignore0_present", "ignore0_present", {"ignore": 0}),
        ("noignore_present", "noignore_present", {}),
        ("ignore0_present_few", "ignore0_present_classes_0_to_5_only", {"ignore": 0}),
    ],
)
def test_lovasz_equals_the_recorded_one(golden, kernel, variant, value, settings):
    kept = recorded(golden, "lovasz")
    labels = kept["labels"].values.long()
    if value.endswith("0_to_5_only"):
        labels[labels > 5] = 3
    logits = sym("lovasz.logits", (2, 15, 24, 40), 3).requires_grad_()
    loss = lovasz_softmax(logits.softmax(1), labels, **settings)
    assert loss.item() == pytest.approx(facts(golden, "lovasz")[value], abs=2e-6)
    kept[f"grad_logits.{variant}"].assert_close(slope(loss, logits), 2e-7)


# --- generator and critic -------------------------------------------------------------------------------------------


def bowl(image: torch.Tensor) -> torch.Tensor:
    """Its slope is the image itself."""
    return image.square() / 2


def test_gradient_penalty_draws_epsilon_per_sample():
    real, fake = torch.zeros(100_000, 1), torch.ones(100_000, 1)  # x = 1 - epsilon: the penalty is E[epsilon^2]
    assert gradient_penalty(bowl, real, fake).item() == pytest.approx(1 / 3, abs=0.01)


@pytest.mark.parametrize(
    ("epsilon", "penalty"), [(1.0, 4.0), (0.0, 1.0), (0.25, 0.0625), (torch.tensor([1.0, 0.0]), 2.5)]
)
def test_gradient_penalty_where_epsilon_says(epsilon, penalty):
    real, fake = torch.tensor([[[[3.0]]]] * 2), torch.tensor([[[[0.0]]]] * 2)
    assert gradient_penalty(bowl, real, fake, epsilon=epsilon).item() == pytest.approx(penalty)


def test_gradient_penalty_is_of_each_sample_over_all_patches():
    real = torch.tensor([[[3.0, 4.0]], [[0.0, 1.0]]])  # slopes of length 5 and 1: ((5 - 1)^2 + 0) / 2
    assert gradient_penalty(bowl, real, torch.zeros_like(real), epsilon=1.0).item() == pytest.approx(8.0)


def test_gradient_penalty_teaches_the_critic_and_nothing_else():
    critic = nn.Sequential(nn.Conv2d(2, 3, 3), nn.Tanh())  # bent, so that its slope depends on the image
    real, fake = torch.rand(2, 2, 6, 6, requires_grad=True), torch.rand(2, 2, 6, 6, requires_grad=True)
    gradient_penalty(critic, real, 2 * fake).backward()
    assert critic[0].weight.grad.any()
    assert real.grad is None
    assert fake.grad is None


def test_gradient_penalty_of_a_flat_critic_has_a_gradient():
    weight = torch.zeros((), requires_grad=True)
    penalty = gradient_penalty(lambda image: weight * image, torch.rand(2, 1, 4, 4), torch.rand(2, 1, 4, 4))
    penalty.backward()
    assert penalty == 1
    assert weight.grad.isfinite()


def test_gradient_penalty_adds_up_a_million_slopes():
    size = (1, 15, 256, 512)
    critic = lambda image: 3 * image.sum() / image.numel() ** 0.5  # noqa: E731 its slope has length 3
    penalty = gradient_penalty(critic, torch.zeros(size), torch.ones(size))
    assert penalty.item() == pytest.approx(4, rel=1e-5)


def test_gradient_penalty_knows_no_autocast():
    critic = nn.Sequential(nn.Conv2d(2, 8, 3), nn.Tanh(), nn.Conv2d(8, 1, 3))
    real, fake = torch.rand(2, 2, 9, 9), torch.rand(2, 2, 9, 9)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        penalty = gradient_penalty(critic, real, fake, epsilon=0.5).item()
    expected = gradient_penalty(critic.double(), real.double(), fake.double(), epsilon=0.5).item()
    assert penalty == pytest.approx(expected, rel=1e-5)


def test_wasserstein_and_hinge_of_two_patches():
    real, fake = torch.tensor([2.0, 0.0]), torch.tensor([-3.0, 1.0])
    assert critic_wasserstein(real, fake) == -2.0  # -1 - 1
    assert generator_wasserstein(fake) == 1.0
    assert hinge_critic(real, fake) == 1.5  # (0 + 1) / 2 + (0 + 2) / 2
