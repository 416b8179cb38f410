"""The arithmetic a device is fast at: bfloat16 where the hardware has it, float32 elsewhere."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch

from lidar2pano.errors import InputError


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 in hardware (CPU: AMX or AVX-512 BF16; CUDA: Ampere and later)."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    tests = ("_is_amx_tile_supported", "_is_avx512_bf16_supported")
    return device.type == "cpu" and any(getattr(torch.cpu, test, lambda: False)() for test in tests)


def fast_arithmetic(device: torch.device) -> AbstractContextManager[object]:
    """Context of inference: autocast to bfloat16 where the device has it."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=has_bfloat16(device))


def pick_device(name: str) -> torch.device:
    """The device that "auto", "cpu" or "cuda" stands for; InputError where it is unknown or not there."""
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"no device {name!r}; there is auto, cpu and cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no CUDA device here; use --device cpu, or install torch for CUDA")
    return torch.device("cpu" if name == "cpu" or not torch.cuda.is_available() else "cuda")
