"""Communication between the processes of one run; with a single process these are no-ops."""

from __future__ import annotations

import os
from collections.abc import Iterable

import torch
from torch import distributed, nn

from lidar2pano.errors import InputError


def world() -> int:
    """The number of processes that train together."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def check_launcher(processes: int) -> None:
    """Raise InputError when a launcher (torchrun, SLURM) started another number of processes than the run has."""
    started = os.environ.get("WORLD_SIZE", "")
    if started.isdigit() and int(started) not in (1, processes):
        raise InputError(
            f"the launcher started {started} processes, but devices times num_nodes is {processes}; make them equal"
        )


def largest(device: torch.device, *values: float) -> list[float]:
    """The largest of the processes' values, one by one, so that all decide alike; they meet here."""
    if world() == 1:
        return list(values)
    agreed = torch.tensor(values, dtype=torch.float64, device=device)
    distributed.all_reduce(agreed, distributed.ReduceOp.MAX)
    return agreed.tolist()


def average_gradients(weights: Iterable[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes; a weight without one counts as zero."""
    weights = list(weights)
    if world() == 1:
        return
    for one in weights:
        one.grad = torch.zeros_like(one) if one.grad is None else one.grad
    gradients = [one.grad for one in weights if one.grad is not None]
    distributed.all_reduce(flat := torch.cat([gradient.flatten() for gradient in gradients]))
    parts = (flat / world()).split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))
