"""The adversarial step on toys: who gets a gradient from whose loss, and what the losses are made of."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from lidar2pano.losses.adversarial import frozen, gradient_penalty, wasserstein_updates


class Critic(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.scores = nn.Sequential(nn.Conv2d(3, 4, 3), nn.LeakyReLU(0.2), nn.Conv2d(4, 1, 3))

    def forward(self, image: Tensor, condition: Tensor) -> Tensor:
        return self.scores(torch.cat([image, condition], 1))


@pytest.fixture
def toys():
    generator, critic = nn.Conv2d(2, 2, 1), Critic()
    z, real, condition = torch.randn(2, 2, 8, 8), torch.rand(2, 2, 8, 8), torch.rand(2, 1, 8, 8)
    return generator, critic, z, real, condition


def weights_and_gradients(*networks: nn.Module) -> list[Tensor | None]:
    return [weight.grad for network in networks for weight in network.parameters()]


def test_losses_are_the_papers(toys):
    generator, critic, z, real, condition = toys
    logs = {}
    auxiliary = lambda fake: 5 * fake.mean()  # noqa: E731
    updates = wasserstein_updates(lambda: generator(z), critic, real, condition, 7.0, auxiliary, 0.25, logs)
    fake = generator(z)
    distance = (critic(real, condition).mean() - critic(fake, condition).mean()).item()
    penalty = gradient_penalty(lambda image: critic(image, condition), real, fake, epsilon=0.25).item()
    name, loss = next(updates)
    assert name == "critic"
    assert loss.item() == pytest.approx(7 * penalty - distance, rel=1e-5)
    assert {key: value.item() for key, value in logs.items()} == pytest.approx(
        {"wasserstein": distance, "penalty": penalty}, rel=1e-5
    )
    with torch.no_grad():  # the critic moves, and the generator is trained by the one that has moved
        for weight in critic.parameters():
            weight.mul_(0.5)
    name, loss = next(updates)
    adversarial = -critic(fake, condition).mean().item()
    assert name == "generator"
    assert loss.item() == pytest.approx(adversarial + 5 * fake.mean().item(), rel=1e-5)
    assert logs["adversarial"].item() == pytest.approx(adversarial, rel=1e-5)
    assert logs["auxiliary"].item() == pytest.approx(5 * fake.mean().item(), rel=1e-5)
    assert not any(part.requires_grad for part in logs.values())
    assert next(updates, None) is None


def test_each_loss_teaches_one_network(toys):
    generator, critic, z, real, condition = toys
    updates = wasserstein_updates(lambda: generator(z), critic, real, condition)
    next(updates)[1].backward()
    assert weights_and_gradients(generator) == [None, None]
    assert all(gradient.any() for gradient in weights_and_gradients(critic)[:3])  # the last bias shifts both means
    critic.zero_grad()
    next(updates)[1].backward()
    assert weights_and_gradients(critic) == [None] * 4
    assert all(gradient.any() for gradient in weights_and_gradients(generator))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_the_critic_learns_again_however_the_step_ended(toys, turns):
    generator, critic, z, real, condition = toys
    critic.scores[0].bias.requires_grad_(False)  # what its owner froze stays frozen
    updates = wasserstein_updates(lambda: generator(z), critic, real, condition)
    learns = []
    for _ in range(turns):
        next(updates, None)
        learns.append([weight.requires_grad for weight in critic.parameters()])
    updates.close()
    learns.append([weight.requires_grad for weight in critic.parameters()])
    thawed = [True, False, True, True]
    assert learns == [thawed, [False] * 4, thawed][:turns] + [thawed]


def test_micro_batches_side_by_side_leave_the_critic_learning(toys):
    generator, critic, z, real, condition = toys
    turns = [wasserstein_updates(lambda: generator(z), critic, real, condition) for _ in range(2)]
    names = [[name for name, _ in both] for both in zip(*turns, strict=True)]
    for turn in turns:
        turn.close()
    assert names == [["critic", "critic"], ["generator", "generator"]]
    assert all(weight.requires_grad for weight in critic.parameters())


def test_frozen_thaws_after_an_error(toys):
    critic = toys[1]
    with pytest.raises(ZeroDivisionError), frozen(critic):
        _ = 1 / 0
    assert all(weight.requires_grad for weight in critic.parameters())


def test_a_generator_gives_a_fake_per_loss_and_may_give_the_same(toys):
    generator, critic, z, real, condition = toys
    graphs = []

    def forward() -> Tensor:
        fake = generator(z)
        graphs.append(fake.requires_grad)
        return fake

    for _, loss in wasserstein_updates(forward, critic, real, condition):
        loss.backward()
    assert graphs == [False, True]
    fresh = [weight.grad.clone() for weight in generator.parameters()]
    generator.zero_grad()
    fake = generator(z)
    for _, loss in wasserstein_updates(lambda: fake, critic, real, condition):
        loss.backward()
    torch.testing.assert_close([weight.grad for weight in generator.parameters()], fresh)


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_under_the_engine_that_trains(toys, precision):
    fabric = pytest.importorskip("lightning_fabric").Fabric(accelerator="cpu", devices=1, precision=precision)
    generator, critic, z, real, condition = toys
    bare = [{name: weight.clone() for name, weight in network.named_parameters()} for network in (generator, critic)]
    optimizers = {}
    generator, optimizers["generator"] = fabric.setup(generator, torch.optim.SGD(generator.parameters(), 0.1))
    critic, optimizers["critic"] = fabric.setup(critic, torch.optim.SGD(critic.parameters(), 0.1))
    for name, loss in wasserstein_updates(lambda: generator(z), critic, real, condition):
        assert loss.dtype == torch.float32
        optimizers[name].zero_grad()
        fabric.backward(loss)
        optimizers[name].step()
    for network, before in zip((generator, critic), bare, strict=True):
        assert any((weight != before[name]).any() for name, weight in network.module.named_parameters())
