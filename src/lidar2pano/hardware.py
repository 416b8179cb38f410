"""The machine: device, arithmetic, times of stages, and glibc's allocation of memory."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

import torch

from lidar2pano.errors import InputError


def has_bfloat16(device: torch.device) -> bool:
    """Tell if the device multiplies bfloat16 faster than float32 (CUDA: Ampere and later; CPU: AMX, or AVX-512 BF16).

    Not AVX-512 BF16 of Intel's: it has half the rate of float32 (github.com/libxsmm/tpp-mlir/pull/1025; convolutions
    of a Xeon whose AMX a virtual machine hides took 1.7 times as long).
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    amx, avx512 = (
        getattr(torch.cpu, test, lambda: False)() for test in ("_is_amx_tile_supported", "_is_avx512_bf16_supported")
    )
    name = getattr(torch.cpu, "get_capabilities", dict)().get("cpu_name", "")
    return device.type == "cpu" and (amx or (avx512 and "Intel" not in name))


def fast_arithmetic(device: torch.device) -> AbstractContextManager[object]:
    """Context of inference: autocast to bfloat16 if the device has it."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=has_bfloat16(device))


def pick_device(name: str | torch.device) -> torch.device:
    """Return the device of "auto", "cpu" or "cuda"; InputError for an unknown or absent one."""
    if isinstance(name, torch.device):
        return name
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"no device {name!r}; there is auto, cpu and cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no CUDA device here; use --device cpu, or install torch for CUDA")
    return torch.device("cpu" if name == "cpu" or not torch.cuda.is_available() else "cuda")


@dataclass(slots=True)
class Timer:
    """Milliseconds per stage of one scan, in the order of the stages: `with timer("project"): ...`.

    A stage that is entered several times adds up.
    """

    device: torch.device
    milliseconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the body; on CUDA, until its kernels have ended."""
        begin = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.milliseconds[stage] = self.milliseconds.get(stage, 0.0) + (time.perf_counter() - begin) * 1e3


# The names and numbers of glibc's malloc.h, and their values.
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
SETTINGS = (
    (M_MMAP_MAX, 0),  # nothing gets a mapping of its own (the threshold is capped in some versions)
    (M_TRIM_THRESHOLD, -1),  # free memory at the end of the heap is never given back
)


def keep_buffers() -> bool:
    """Let glibc keep large buffers for the next step, in the whole process. True on success.

    By default every activation of some size is mapped, faulted in page by page and unmapped again; in a network of
    images this is up to half of the CPU's time.
    Elsewhere (musl, macOS, Windows) nothing happens and the answer is False. Calling it again changes nothing.
    """
    try:
        libc = ctypes.CDLL(None)
        _, mallopt = libc.gnu_get_libc_version, libc.mallopt  # other C libraries lack one or both
    except (AttributeError, OSError, TypeError):
        return False
    accepted = [mallopt(setting, value) for setting, value in SETTINGS]  # all of them, whatever the first one says
    return accepted == [1, 1]
