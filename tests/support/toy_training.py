"""Two small tasks that train in milliseconds; also a program: toy_training.py TASK OUT DEVICES PAUSE_S NAME=VALUE..."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.data.frames import SampleIndex
from lidar2pano.models import MODELS
from lidar2pano.train.checkpoint import load_checkpoint
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, override
from lidar2pano.train.task import build_networks
from lidar2pano.train.tasks import TASKS

SIZE = 6


class ToyOptions(TaskOptions):
    task = "toy"


class ToyGanOptions(TaskOptions):
    task = "toy-gan"


class Sample(NamedTuple):
    """image (3, H, W) and noisy (3, H, W) float; after collation with a leading B."""

    image: Tensor
    noisy: Tensor
    name: str


class NoisyImages:
    """Eleven images whose noise is the draw's own."""

    def __len__(self) -> int:
        return 11

    def __getitem__(self, draw: SampleIndex) -> Sample:
        image = np.random.default_rng(draw.index).normal(size=(3, SIZE, SIZE)).astype(np.float32)
        noise = np.random.default_rng(draw.seed).normal(size=image.shape).astype(np.float32)
        return Sample(torch.from_numpy(image), torch.from_numpy(image + 0.3 * noise), str(draw.index))


class ToyNetwork(nn.Module):
    """Two convolutions, optionally with statistics and dropout in between."""

    def __init__(self, outputs: int = 3, norm: bool = True, dropout: float = 0.1) -> None:
        super().__init__()
        middle = nn.BatchNorm2d(4) if norm else nn.Identity()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 4, 3, padding=1), middle, nn.Tanh(), nn.Dropout(dropout), nn.Conv2d(4, outputs, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class Denoise:
    """One network, one loss. `before_step` is called with the count of `updates` so far; `scores` override scores."""

    released = ("generator",)
    before_step: Callable[[int], None] | None = None
    scores: ClassVar[list[float]] = []

    def __init__(self, recipe: Recipe, root: Path) -> None:
        self.networks = build_networks(recipe)
        self.dataset = NoisyImages()
        self.logs: dict[str, float | Tensor] = {}
        self.calls = 0

    def begin(self) -> None:
        """Count, and let the test interfere."""
        if type(self).before_step:
            type(self).before_step(self.calls)
        self.calls += 1

    def updates(self, batch: Sample) -> Iterator[tuple[str, Tensor]]:
        self.begin()
        yield "generator", (self.networks["generator"](batch.noisy) - batch.image).square().mean()

    def preview(self) -> dict[str, np.ndarray]:
        return {"grey": np.full((4, 5, 3), 128, np.uint8)}

    def validate(self) -> dict[str, float]:
        if self.scores:
            return {"score": self.scores.pop(0)}
        samples = [self.dataset[SampleIndex(index, 99)] for index in range(4)]
        noisy, clean = (torch.stack([getattr(one, name) for one in samples]) for name in ("noisy", "image"))
        with torch.inference_mode():
            return {"score": -(self.networks["generator"](noisy) - clean).square().mean().item()}

    def card(self, network: str) -> dict[str, Any]:
        return {"labels": None, "licence": "none"}


class Gan(Denoise):
    """Two networks: a critic with a gradient penalty, called three times, then the generator against it."""

    def updates(self, batch: Sample) -> Iterator[tuple[str, Tensor]]:
        self.begin()
        critic = self.networks["critic"]
        fake = self.networks["generator"](batch.noisy)
        between = ((batch.image + fake.detach()) / 2).requires_grad_()
        (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
        penalty = (slope.flatten(1).norm(dim=1) - 1).square().mean()
        yield "critic", critic(fake.detach()).mean() - critic(batch.image).mean() + 10 * penalty
        self.logs = {"penalty": penalty.detach()}
        yield "generator", (fake - batch.image).square().mean() - critic(fake).mean()


def toy_recipe(task: str, **training: Any) -> Recipe:
    """A recipe of a toy task: 12 steps of 4 pictures."""
    settings = {"steps": 12, "batch": 4, "workers": 0, "precision": "32-true", "ema": 0.9} | training
    adam = Optimizer(algorithm="adam", rate=1e-2, warmup=3, clip=1.0)
    generator = Network(model="toy", settings={"outputs": 3, "norm": True, "dropout": 0.1}, optimizer=adam)
    networks = {"generator": generator}
    if task == "toy-gan":
        networks["critic"] = replace(generator, settings={"outputs": 1, "norm": False, "dropout": 0.0})
    options = ToyGanOptions() if task == "toy-gan" else ToyOptions()
    return Recipe(name=task, view="hdl64e", networks=networks, options=options, training=Training(**settings))


def entries() -> list[tuple[dict, str, Any]]:
    """(table, name, value) that make the toys known to the package by name."""
    return [
        (MODELS, "toy", ToyNetwork),
        (TASKS, "toy", Denoise),
        (TASKS, "toy-gan", Gan),
    ]


def left(out: Path) -> tuple[int, dict[str, Tensor]]:
    """The step and every tensor of a run's last checkpoint: weights, averages, optimisers."""
    found = load_checkpoint(out)
    assert found is not None
    progress, tensors, optimizers = found
    tensors = dict(tensors)
    for name, state in optimizers.items():
        for number, values in state.get("state", {}).items():  # the loss scale has none
            tensors |= {f"optimizer/{name}/{number}/{key}": value for key, value in values.items()}
    return progress.step, tensors


def gap(one: Path, other: Path) -> float:
    """Largest difference between two runs' last checkpoints, which must be of one step and hold the same things."""
    (step, ours), (their_step, theirs) = left(one), left(other)
    assert step == their_step and ours.keys() == theirs.keys()
    return max((ours[name].double() - theirs[name].double()).abs().max().item() for name in ours)


if __name__ == "__main__":
    from lidar2pano.train.engine import train

    for table, name, value in entries():
        table[name] = value
    task, out, devices, pause_s, *changes = sys.argv[1:]
    Denoise.before_step = Gan.before_step = lambda _: time.sleep(float(pause_s))
    chosen = toy_recipe(task)
    for change in changes:
        chosen = override(chosen, change)
    train(chosen, Path(), Path(out), device="cpu", devices=int(devices))
