"""Where a run computes: its device, precision and compiler, and how a batch is divided."""

from __future__ import annotations

import logging
import os
import shutil
import sys
from dataclasses import replace
from math import gcd
from typing import Literal

import torch

from lidar2pano.errors import InputError
from lidar2pano.hardware import has_bfloat16
from lidar2pano.train.recipe import Training

log = logging.getLogger(__name__)

FLOATS = {"16-mixed": "float16, with scaled losses,", "32-true": "float32"}


def choose_precision(training: Training, device: torch.device) -> Literal["bf16-mixed", "16-mixed", "32-true"]:
    """The recipe's precision on a device; without bfloat16 a GPU computes in float16, a CPU in float32."""
    if training.precision == "bf16-mixed" and not has_bfloat16(device):
        instead: Literal["16-mixed", "32-true"] = "16-mixed" if device.type == "cuda" else "32-true"
        log.info("training in %s: this %s has no bfloat16", FLOATS[instead], device.type)
        return instead
    return training.precision


def shared(training: Training, processes: int) -> Training:
    """The training as each of so many processes does it: the same batch, and micro-batches that are not larger.

    Raises InputError where the batch cannot be divided among the processes and micro-batches.
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
    """Raise InputError where networks are to be compiled and there is no C++ compiler, which torch.compile calls."""
    compiler = os.environ.get("CXX") or ("clang++" if sys.platform == "darwin" else "g++")
    if training.compile and not shutil.which(compiler):
        raise InputError(
            f"training.compile=true needs a C++ compiler, and {compiler} is not installed; install it, name another one"
            " (CXX), or set training.compile=false"
        )


def device_name(device: torch.device) -> str:
    """What to call `device` in a card."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
