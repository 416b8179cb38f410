"""Mutants through everything that is read from outside: nothing but InputError, for so long as `--fuzz-seconds`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import lidar2pano

HERE = Path(__file__).resolve().parent
SOURCE = Path(lidar2pano.__file__).parents[1]
# What must be noticed: a reader that raises, one whose message has a hundred lines, one that fills the memory.
BROKEN = """
import campaign, time
from lidar2pano.errors import InputError

def lines(data):
    raise InputError("x\\n" * 6000)

for run in (lambda data: data[9], lambda data: campaign.time.sleep(0), lines, lambda data: b"1" * (800 << 20)):
    target = campaign.Target([b"a"], lambda draw, data: data, run)
    print(campaign.attempt("broken", target, b"a") is not None)
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A program of this folder in a process of its own, which a mutant may end."""
    command = [sys.executable, *arguments]
    where = {"PYTHONPATH": f"{SOURCE}:{HERE}", "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=4000, env=where)


def test_what_once_broke_and_new_mutants_are_one_line_each(request: pytest.FixtureRequest):
    seconds = request.config.getoption("fuzz_seconds")
    done = run(str(HERE / "campaign.py"), "--replay", "--seconds", str(seconds), "--seed", "11")
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    assert int(done.stdout.split()[2]) > 100 * min(seconds, 1)


def test_the_harness_notices_what_is_broken():
    done = run("-c", BROKEN)
    assert done.stdout.split() == ["True", "False", "True", "True"], done.stderr
