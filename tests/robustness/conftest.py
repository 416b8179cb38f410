"""A process that runs commands, kills them, and bounds their files: shared by the tests of this folder."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import lidar2pano

HERE = Path(__file__).resolve().parent
SOURCE = Path(lidar2pano.__file__).parents[1]
Run = Callable[..., tuple[int, float, str]]
Jobs = Callable[..., list[tuple[int, float, str]]]


@pytest.fixture(scope="session")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Jobs]:
    """A function that has a job done by killed_commands.py: (exit code, seconds, stderr) of each process."""
    where = {"PYTHONPATH": f"{SOURCE}:{HERE.parent / 'support'}", "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
    errors = tmp_path_factory.mktemp("commands") / "stderr"
    command = [sys.executable, "-W", "ignore", str(HERE / "killed_commands.py"), str(errors)]
    process = subprocess.Popen(command, env=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin and process.stdout

    def do(words: list[str], **changes: float | None) -> list[tuple[int, float, str]]:
        assert process.stdin and process.stdout
        job = {"words": words, "after_s": None, "signal": signal.SIGKILL, "most_bytes": None, "again_s": None} | changes
        process.stdin.write(json.dumps(job) + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    yield do
    process.stdin.close()
    process.stdout.close()
    process.wait()


@pytest.fixture(scope="session")
def run(jobs: Jobs) -> Run:
    """A function that runs a command and may kill it, or bound its files: (exit code, seconds, stderr)."""

    def runs(
        words: list[str], after_s: float | None = None, sign: int = signal.SIGKILL, most_bytes: int | None = None
    ) -> tuple[int, float, str]:
        (answer,) = jobs(words, after_s=after_s, signal=sign, most_bytes=most_bytes)
        return answer

    return runs
