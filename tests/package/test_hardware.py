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


@pytest.mark.parametrize(
    ("amx", "avx512", "name", "faster"),
    [(True, True, "Intel Xeon", True), (False, True, "Intel Xeon", False), (False, True, "AMD Zen5", True)]
    + [(False, False, "AMD Zen3", False), (False, True, "", True)],
)
def test_bfloat16_counts_where_it_is_faster_than_float32(monkeypatch, amx, avx512, name, faster):
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx512)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"cpu_name": name} if name else {}, raising=False)
    assert hardware.has_bfloat16(torch.device("cpu")) is faster
    assert not hardware.has_bfloat16(torch.device("meta"))


def test_a_stage_entered_again_adds_its_time(monkeypatch):
    clock_s = iter([0.0, 0.5, 1.0, 3.0, 3.0, 3.25])
    monkeypatch.setattr(hardware.time, "perf_counter", lambda: next(clock_s))
    timer = hardware.Timer(torch.device("cpu"))
    for stage in ("cameras", "paint", "cameras"):
        with timer(stage):
            pass
    assert list(timer.milliseconds.items()) == [("cameras", 750.0), ("paint", 2000.0)]


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
