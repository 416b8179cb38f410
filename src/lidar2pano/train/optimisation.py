"""Optimisers, learning rates over a run, and exponential moving averages of weights."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from lidar2pano.train.recipe import Optimizer

SAVED = ({"step", "exp_avg", "exp_avg_sq"}, {"momentum_buffer"})  # of each weight: Adam's, SGD's
OPTIMIZERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}  # and "sgd"


def make_optimizer(settings: Optimizer, network: nn.Module) -> torch.optim.Optimizer:
    """The optimiser of a network's trainable weights."""
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    rate, decay = settings.rate, settings.weight_decay
    if settings.algorithm == "sgd":
        return torch.optim.SGD(weights, lr=rate, momentum=settings.betas[0], weight_decay=decay)
    return OPTIMIZERS[settings.algorithm](weights, lr=rate, betas=settings.betas, weight_decay=decay)


def load_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Go on from the saved state of an optimiser of the same weights; ValueError when it is of others, or odd.

    Its settings stay the recipe's, not the saved ones.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for number, values in saved["state"].items():
        if number not in range(len(weights)) or values.keys() not in SAVED:
            raise ValueError(f"the optimiser's state of weight {number!r} is odd")
        for name, value in values.items():
            shape = torch.Size() if name == "step" else weights[number].shape
            if value is not None and not (torch.is_tensor(value) and value.shape == shape and value.isfinite().all()):
                raise ValueError(f"the optimiser's {name!r} of weight {number} does not fit")
    optimizer.load_state_dict({"state": saved["state"], "param_groups": optimizer.state_dict()["param_groups"]})


def learning_rate(settings: Optimizer, step: int, progress: float) -> float:
    """The rate of step `step` (from 0), when `progress` (0 to 1) of the run is done."""
    rate, progress = settings.rate * min(1.0, (step + 1) / max(settings.warmup, 1)), min(progress, 1.0)
    match settings.schedule:
        case "cosine":
            return rate * (1 + math.cos(math.pi * progress)) / 2
        case "linear":
            return rate * min(1.0, 2 * (1 - progress))
        case "exponential":
            return rate * settings.final**progress
    return rate


class EMA:
    """Exponential moving average of a network's weights; its other state (norm statistics) is copied as it is.

    The decay of step s is min(decay, (1 + s) / (10 + s)), so that the initial weights soon have no influence.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.network, self.decay = network, decay
        self.state = {name: value.detach().clone() for name, value in network.state_dict().items()}
        trained = {name for name, _ in network.named_parameters()}
        self.averaged = [name for name in self.state if name in trained]
        self.copied = [name for name in self.state if name not in trained]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Add the weights after step `step` (from 0) to the average."""
        now = self.network.state_dict()
        mix = get_ema_multi_avg_fn(min(self.decay, (1 + step) / (10 + step)))
        mix([self.state[name] for name in self.averaged], [now[name] for name in self.averaged], None)
        for name in self.copied:
            self.state[name].copy_(now[name])

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a saved `state`."""
        for name, value in self.state.items():
            value.copy_(state[name])

    @torch.no_grad()
    def swap(self) -> None:
        """Exchange the network's weights with the average; doing it twice changes nothing."""
        for name, value in self.network.state_dict().items():
            kept = value.clone()
            value.copy_(self.state[name])
            self.state[name].copy_(kept)


@contextmanager
def averaged(networks: Iterable[nn.Module], averages: Iterable[EMA]) -> Iterator[None]:
    """Inside, the networks have their averaged weights, are in evaluation mode and record no gradients."""
    networks, averages = list(networks), list(averages)
    modes = [(part, part.training) for network in networks for part in network.modules()]
    for average in averages:
        average.swap()
    for network in networks:
        network.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        for part, mode in modes:
            part.training = mode
        for average in averages:
            average.swap()


def clip(weights: Iterable[Tensor], largest: float) -> None:
    """Scale the gradient of `weights` down to the norm `largest`; 0 = no clipping."""
    if largest > 0:
        torch.nn.utils.clip_grad_norm_(list(weights), largest)
