"""Where a run computes: device, arithmetic, and how a batch is shared out."""

from __future__ import annotations

import logging
from typing import Literal

import torch

from lidar2pano.errors import InputError, closest
from lidar2pano.hardware import has_bfloat16
from lidar2pano.train.recipe import Training

DEVICES = ("auto", "cpu", "cuda")
log = logging.getLogger(__name__)


def device_kind(device: str) -> str:
    """The kind, "cpu" or "cuda", that `device` ("auto", "cpu", "cuda") means here; what is absent raises InputError."""
    if device not in DEVICES:
        raise InputError(f"no device {device!r}{closest(device, DEVICES)}")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device 'cuda': this machine or this build of torch has no CUDA; use 'cpu'")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


def arithmetic(training: Training, kind: str) -> Literal["bf16-mixed", "32-true"]:
    """The recipe's precision, or "32-true" on a device that would only emulate bfloat16, slowly."""
    if training.precision == "bf16-mixed" and not has_bfloat16(torch.device(kind)):
        log.info("training in float32: this %s has no bfloat16", kind)
        return "32-true"
    return training.precision


def check_shares(training: Training, processes: int) -> None:
    """Raise InputError unless every process gets the same number of samples in each turn."""
    turns = processes * training.accumulate
    if training.batch % turns:
        raise InputError(
            f"training.batch={training.batch} cannot be shared by {processes} devices in "
            f"training.accumulate={training.accumulate} turns; make it a multiple of {turns}"
        )


def device_name(device: torch.device) -> str:
    """What to call `device` in a card."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
