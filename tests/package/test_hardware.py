from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest
import torch

from lidar2pano import hardware
from lidar2pano.hardware import keep_buffers

FAULTS_OF_TEN_BUFFERS = """
import resource
from lidar2pano.hardware import keep_buffers
def faults():
    buffer = b"x" * (64 << 20)
    del buffer
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        buffer = b"x" * (64 << 20)  # written to, freed
        del buffer
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(faults(), keep_buffers(), faults(), keep_buffers(), faults())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="another C library")
def test_kept_buffers_are_not_faulted_in_again():
    code = [sys.executable, "-c", FAULTS_OF_TEN_BUFFERS]
    done = subprocess.run(code, check=True, capture_output=True, text=True, timeout=120)
    without, kept, once, kept_again, twice = done.stdout.split()
    assert (kept, kept_again) == ("True", "True")
    assert int(once) < int(without) / 10
    assert int(twice) < int(without) / 10, "twice is once"


class NoSuchFunction:
    def __getattr__(self, name: str) -> None:
        raise AttributeError(name)


class RefusesAll:
    gnu_get_libc_version = None

    @staticmethod
    def mallopt(_setting: int, _value: int) -> int:
        return 0


def fail(error: Exception):
    raise error


@pytest.mark.parametrize(
    "library",
    [
        lambda _: NoSuchFunction(),
        lambda _: RefusesAll(),
        lambda _: fail(OSError("no library")),
        lambda _: fail(TypeError("a name is needed")),  # Windows
    ],
)
def test_other_c_libraries_are_left_alone(monkeypatch, library):
    monkeypatch.setattr(ctypes, "CDLL", library)
    assert keep_buffers() is False


def test_inference_computes_in_bfloat16_where_no_gradients_flow(monkeypatch):
    monkeypatch.setattr(hardware, "has_bfloat16", lambda device: True)
    cpu = torch.device("cpu")
    assert hardware.inference_dtype(cpu) == torch.float32
    with hardware.fast_arithmetic(cpu):
        assert hardware.inference_dtype(cpu) == torch.float32
        with torch.inference_mode():
            assert hardware.inference_dtype(cpu) == torch.bfloat16
    with torch.inference_mode():
        assert hardware.inference_dtype(cpu) == torch.float32
