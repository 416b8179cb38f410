"""A bulk run on Ray: a worker that is killed costs nothing but time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from bulk_runs import SCANS, assert_each_once, contents, job_of, run
from house_rules import ROOT
from lidar2pano.bulk import Entry, ScanKey
from lidar2pano.bulk.on_ray import ATTEMPTS, translate_in_pool
from lidar2pano.bulk.stores import SCRATCH
from lidar2pano.errors import InputError
from random_weights import street, write_scan

PROGRAM = ROOT / "tests" / "support" / "bulk_on_ray.py"


def processes(out: Path) -> set[int]:
    """The processes that have a scratch folder there."""
    return {int(folder.name.rsplit("-", 2)[1]) for folder in out.glob(f"{SCRATCH}*")}


def test_a_killed_worker_loses_nothing(tmp_path):
    pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")
    from miniature_recordings import START_NS, STEP_NS, points
    from miniature_recordings import write as write_recording

    root, out = tmp_path / "in", tmp_path / "out"
    for number in range(SCANS):
        write_scan(root / f"{number % 3}" / f"{number:06d}.bin", street(50, seed=number))
    drive = (points(street(50, seed=number), START_NS + number * STEP_NS) for number in range(SCANS))
    write_recording(root, "db3", drive, "drive")
    assert run(job_of(root, tmp_path / "whole")) == 0
    places = os.pathsep.join(map(str, (ROOT / "src", PROGRAM.parent)))
    settings = os.environ | {"PYTHONPATH": places, "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    driver = subprocess.Popen([sys.executable, PROGRAM, root, out], env=settings, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while len(list(out.rglob("*.depth.png"))) < 4 and driver.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    victim = min(processes(out) - {driver.pid})
    os.kill(victim, signal.SIGKILL)
    _, errors = driver.communicate(timeout=300)
    assert driver.returncode == 0, errors
    assert contents(out) == contents(tmp_path / "whole")
    assert_each_once(out, root, {"drive.db3": SCANS})
    assert not processes(out)


# --- the pool, with workers that are no processes ---------------------------------------------------------------------


class Died(Exception):
    pass


class Failed(Exception):
    pass


class Call:
    """A method of a worker: `remote` gives a reference, here the function that gives the result."""

    def __init__(self, function):
        self.function = function

    def remote(self, *arguments):
        return lambda: self.function(*arguments)


class Fake:
    """A worker that dies of the scans in `deadly`, together with all that it holds; `held` is what it was given."""

    def __init__(self, deadly: set[str], healthy: bool = True):
        self.deadly, self.healthy, self.held = deadly, healthy, []
        self.prepare, self.translate = Call(self._alive), SimpleNamespace(remote=self._hold)

    def _alive(self):
        if not self.healthy or any(name in self.deadly for name in self.held):
            raise Died

    def _hold(self, entry):
        self.held.append(str(entry.key))
        return lambda: self._finish(str(entry.key))

    def _finish(self, name):
        self._alive()
        self.held.remove(name)
        return {"input": name, "error": None}


@pytest.fixture
def fake_ray(monkeypatch):
    errors = SimpleNamespace(RayTaskError=Failed, RayActorError=Died)
    ray = SimpleNamespace(
        exceptions=errors, get=lambda call: call(), wait=lambda calls, num_returns=1, timeout=0: (calls[:1], calls[1:])
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", errors)


def translated(
    deadly: set[str], healthy: Callable[[int], bool] = lambda number: True, most: int = 20
) -> tuple[dict[str, dict | None], list[Fake], list[Fake]]:
    """Records of twenty scans by name, all workers that were made, and the last ones; at `most` it is stopped.

    healthy  whether a worker starts, by the number of those before it.
    """
    made: list[Fake] = []
    pool: list[Fake] = []

    def make() -> Fake:
        made.append(Fake(deadly, healthy(len(made))))
        return made[-1]

    todo = [Entry(key=ScanKey(f"{number}.bin"), stem=f"{number}") for number in range(20)]
    records: dict[str, dict | None] = {}
    for entry, record in translate_in_pool(pool, make, 2, todo, lambda: len(records) >= most):
        assert str(entry.key) not in records
        records[str(entry.key)] = record
    return records, made, pool


@pytest.mark.usefixtures("fake_ray")
def test_a_scan_that_kills_its_workers_costs_only_itself():
    records, made, pool = translated({"5.bin", "6.bin", "11.bin"})
    assert set(records) == {f"{number}.bin" for number in range(20)}
    assert {name for name, record in records.items() if record is None} == {"5.bin", "6.bin", "11.bin"}
    assert len(made) <= 2 + 3 * ATTEMPTS and made[-1] in pool and len(pool) == 2


@pytest.mark.usefixtures("fake_ray")
def test_a_run_that_is_stopped_gives_out_no_more_scans():
    records, *_ = translated({"1.bin"}, most=4)
    assert 4 <= len(records) <= 9 and all(records.values())


@pytest.mark.usefixtures("fake_ray")
def test_workers_that_cannot_start_end_the_run():
    with pytest.raises(InputError, match="workers die while they start"):
        translated(set(), healthy=lambda number: False)


@pytest.mark.usefixtures("fake_ray")
def test_workers_that_die_at_their_start_now_and_then_are_replaced():
    deadly = {f"{number}.bin" for number in range(0, 20, 3)}
    records, made, _ = translated(deadly, healthy=lambda number: number % 2 == 0)
    assert {name for name, record in records.items() if record is None} == deadly and len(records) == 20
    assert len(made) > 2 * ATTEMPTS + 2
