"""The surroundings of a run: device, precision, compiler and processes; its clock, and interrupts."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import gcd
from typing import Literal

import torch
from torch import distributed, nn

from lidar2pano.errors import InputError
from lidar2pano.hardware import has_bfloat16
from lidar2pano.train.recipe import Training

log = logging.getLogger(__name__)

FLOATS = {"16-mixed": "float16, with scaled losses,", "32-true": "float32"}


def choose_precision(training: Training, device: torch.device) -> Literal["bf16-mixed", "16-mixed", "32-true"]:
    """The recipe's precision on a device; without bfloat16 a GPU computes in float16, a CPU in float32."""
    if training.precision == "bf16-mixed" and not has_bfloat16(device):
        return "16-mixed" if device.type == "cuda" else "32-true"
    return training.precision


def log_precision(training: Training, device: torch.device) -> None:
    """Log a precision that is not the recipe's."""
    precision = choose_precision(training, device)
    if precision != training.precision:
        log.info("training in %s: this %s has no bfloat16", FLOATS[precision], device.type)


def has_channels_last(training: Training, device: torch.device) -> bool:
    """Tell whether weights lie channels last: as the recipe says, but never in float32 on a CPU.

    There a step of SalsaNext took 1.5 times as long with them as without, one of TITAN-pano 1.3 times.
    """
    slow = device.type == "cpu" and choose_precision(training, device) == "32-true"
    return training.channels_last and not slow


def shared(training: Training, processes: int) -> Training:
    """Divide a batch among processes, into micro-batches of at most the recipe's size.

    Raises InputError when the batch cannot be divided among the processes and micro-batches.
    """
    batch, accumulate = training.batch, training.accumulate
    if batch % (processes * accumulate) == 0:
        return training
    share = batch // processes
    if processes > 1 and batch % processes == 0 and batch % accumulate == 0:
        fewer = next(n for n in range(1, share + 1) if share % n == 0 and share // n <= batch // accumulate)
        log.info("%d devices take a batch of %d in %d micro-batches each", processes, batch, fewer)
        return replace(training, accumulate=fewer)
    hint = f"make it a multiple of {processes * accumulate}"
    if share and batch % processes == 0:
        hint = f"set training.accumulate={gcd(share, accumulate)}, or {hint}"
    raise InputError(
        f"training.batch={batch} cannot be divided among {processes} devices and training.accumulate={accumulate} "
        f"micro-batches; {hint}"
    )


def check_compiler(training: Training) -> None:
    """Raise InputError when networks are to be compiled without a C++ compiler for torch.compile."""
    compiler = os.environ.get("CXX") or ("clang++" if sys.platform == "darwin" else "g++")
    if training.compile and not shutil.which(compiler):
        raise InputError(
            f"training.compile=true needs a C++ compiler, and {compiler} is not installed; install it, name another one"
            " (CXX), or set training.compile=false"
        )


def device_name(device: torch.device) -> str:
    """Name a device for a card."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"


def check_launcher(processes: int) -> None:
    """Raise InputError when a launcher (torchrun, SLURM) started another number of processes than the run has."""
    started = os.environ.get("WORLD_SIZE", "")
    if started.isdigit() and int(started) not in (1, processes):
        raise InputError(
            f"the launcher started {started} processes, but devices times num_nodes is {processes}; make them equal"
        )


def largest(device: torch.device, *values: float) -> list[float]:
    """Largest of the processes' values, one by one, for equal decisions; all processes wait here for each other."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return list(values)
    agreed = torch.tensor(values, dtype=torch.float64, device=device)
    distributed.all_reduce(agreed, distributed.ReduceOp.MAX)
    return agreed.tolist()


def average_gradients(weights: Sequence[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes; a weight without one counts as zero."""
    for weight in weights:
        weight.grad = torch.zeros_like(weight) if weight.grad is None else weight.grad
    gradients = [weight.grad for weight in weights if weight.grad is not None]
    distributed.all_reduce(flat := torch.cat([gradient.flatten() for gradient in gradients]))
    parts = (flat / distributed.get_world_size()).split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))


def clock(used: float) -> Callable[[], float]:
    """Seconds of wall clock from now on, plus those `used` in earlier sittings."""
    began = time.monotonic()
    return lambda: used + time.monotonic() - began


class Timer:
    """Schedule of a repeated action: `minutes` after its last end (or after `now`); 0 = never.

    When it takes longer than `share` of the time, the pauses grow until it does not. All times are the run's clock in
    seconds, so that processes with one clock decide alike.
    """

    def __init__(self, minutes: float, now: float, share: float = 1.0) -> None:
        self.least, self.pause, self.last, self.share = 60 * minutes, 60 * minutes, now, share

    def due(self, now: float) -> bool:
        """Tell if the action is due now."""
        return self.least > 0 and now - self.last >= self.pause

    def done(self, began: float, ended: float) -> None:
        """Note a finished action."""
        self.last, self.pause = ended, max(self.least, (ended - began) * (1 / self.share - 1))


@contextmanager
def interrupts() -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C or SIGTERM makes the value return True; the second raises KeyboardInterrupt.

    Signals reach the main thread only; in another one nothing is noted.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    handlers = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
