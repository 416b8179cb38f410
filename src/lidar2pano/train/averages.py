"""Averages of a network's weights over a run: what is validated and released."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class EMA:
    """Exponential moving average of a network's weights; its other state (norm statistics) is copied as it is.

    The decay of step s is min(decay, (1 + s) / (10 + s)), so that the initial weights soon have no influence.
    start_share  share of the weights that the network has now, before its first step, in what is applied: between its
                 start and its end a network keeps more of what it knew of other data (WiSE-FT, Wortsman et al. 2022).
    """

    def __init__(self, network: nn.Module, decay: float, start_share: float = 0.0) -> None:
        self.network, self.decay, self.start_share = network, decay, start_share
        self.state = {name: value.detach().clone() for name, value in network.state_dict().items()}
        trained = {name for name, _ in network.named_parameters()}
        self.averaged = [name for name in self.state if name in trained]
        self.copied = [name for name in self.state if name not in trained]
        self.start = {name: self.state[name].clone() for name in self.averaged} if start_share else {}

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

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Give the network the average, inside, with the share of its start."""
        kept = {name: value.clone() for name, value in self.network.state_dict().items()}
        mixed = {name: self.state[name].lerp(value, self.start_share) for name, value in self.start.items()}
        self.network.load_state_dict(self.state | mixed)
        try:
            yield
        finally:
            self.network.load_state_dict(kept)


@contextmanager
def averaged(networks: Iterable[nn.Module], averages: Iterable[EMA]) -> Iterator[None]:
    """Inside, the networks have their averaged weights, are in evaluation mode and record no gradients."""
    networks = list(networks)
    modes = [(part, part.training) for network in networks for part in network.modules()]
    with ExitStack() as stack:
        for average in averages:
            stack.enter_context(average.applied())
        for network in networks:
            network.eval()
        try:
            with torch.no_grad():
                yield
        finally:
            for part, mode in modes:
                part.training = mode
