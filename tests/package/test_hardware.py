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
KEEP
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
buffer = b"x" * (64 << 20)
del buffer
before = faults()
for _ in range(10):
    buffer = b"x" * (64 << 20)  # written to, freed
    del buffer
print(faults() - before)
"""


def faults(keep: str) -> int:
    code = FAULTS_OF_TEN_BUFFERS.replace("KEEP", keep)
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120)
    return int(done.stdout)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="another C library")
def test_kept_buffers_are_not_faulted_in_again():
    without = faults("")
    assert faults("assert keep_buffers()") < without / 10
    assert faults("assert keep_buffers() and keep_buffers()") < without / 10, "twice is once"


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
