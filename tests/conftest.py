"""What every test gets: no network, seeded draws, threads set once; and where the recorded and the real data lie."""

from __future__ import annotations

import functools
import gc
import ipaddress
import math
import os
import random
import socket
import sys
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
os.environ.setdefault(
    "LIDAR2PANO_ENGINE", "torch"
)  # what "auto" is in tests: nothing is compiled that they do not ask for


def _refuse_other_machines(address: object) -> None:
    """Raise RuntimeError unless the address is of this machine (loopback, or a path: a Unix socket)."""
    if not isinstance(address, tuple):
        return
    host = str(address[0])
    try:
        own = host in {"", "localhost"} or ipaddress.ip_address(host).is_loopback
    except ValueError:
        own = False
    if not own:
        raise RuntimeError(f"a test tried to connect to {host!r}; the suite runs without a network")


def close_network(patch: pytest.MonkeyPatch) -> None:
    """Let sockets connect to this machine only."""

    def guarded(original: Any, position: int) -> Any:
        @functools.wraps(original)
        def connect(*args: Any, **settings: Any) -> Any:
            _refuse_other_machines(args[position])
            return original(*args, **settings)

        return connect

    patch.setattr(socket.socket, "connect", guarded(socket.socket.connect, 1))
    patch.setattr(socket.socket, "connect_ex", guarded(socket.socket.connect_ex, 1))
    patch.setattr(socket, "create_connection", guarded(socket.create_connection, 0))


@pytest.fixture(scope="session", autouse=True)
def _no_network():
    with pytest.MonkeyPatch.context() as patch:
        close_network(patch)
        yield


@functools.cache
def _set_threads() -> None:
    if "OMP_NUM_THREADS" not in os.environ:
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        sys.modules["torch"].set_num_threads(max(count // workers, 1))


@pytest.fixture(autouse=True)
def _no_lines_about_progress(monkeypatch):
    """A busy machine makes short work long: lines about it would stand among those that tests expect."""
    monkeypatch.setattr("lidar2pano.cli.console.LINES_S", (math.inf,))


@pytest.fixture(autouse=True)
def _seeded():
    """Every test draws the same numbers whatever ran before it; torch is not imported for tests that do not use it."""
    random.seed(0)
    if "torch" in sys.modules:
        _set_threads()
        sys.modules["torch"].manual_seed(0)


# --- what a clone has, and what it has not ----------------------------------------------------------------------------

DATA = ROOT / "data"
REAL_DATA = {  # fixture -> folder; the licences of these data sets forbid to pass them on
    "kitti_mini": DATA / "kitti-mini",
    "pandaset_mini": DATA / "pandaset-mini",
    "nuscenes": DATA / "other-sensors" / "nuscenes",
}
_left_out = pytest.StashKey[Counter[str]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fuzz-seconds", type=float, default=10, help="how long mutants are tried")
    parser.addoption("--kills", type=int, default=1, help="how often each command is killed")
    parser.addoption("--released", action="store_true", help="also run what takes the released weights and minutes")
    parser.addoption("--no-parity-skips", action="store_true", help="a skipped test marked `parity` fails (also: CI=1)")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "needs(there, what): left out of the run unless `there`; `what` says what to do")
    config.addinivalue_line("markers", "child: a child process reads files, as for users, whatever the module has")
    config.stash[_left_out] = Counter()


def _missing(item: pytest.Item) -> str | None:
    """What has to be there before a test can run and is not, as an advice to the reader."""
    if item.get_closest_marker("released") and not item.config.getoption("released"):
        return "documented commands on the released weights: make test-released"
    for marker in item.iter_markers("needs"):
        if not marker.args[0]:
            return marker.args[1]
    if any(not REAL_DATA[name].is_dir() for name in REAL_DATA.keys() & set(getattr(item, "fixturenames", ()))):
        return "real data: unpack them into data/"
    return None


def pytest_make_parametrize_id(val: object) -> str | None:
    """Name bytes by their number: a packed file may hold the second it was made in, and all workers need one name."""
    return f"{len(val)}-bytes" if isinstance(val, bytes) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what needs more than the repository has; the summary says how many tests and why."""
    missing = {item: _missing(item) for item in items}
    out = [item for item in items if missing[item]]
    items[:] = [item for item in items if not missing[item]]
    config.stash[_left_out].update(missing[item] for item in out)
    if out:
        config.hook.pytest_deselected(items=out)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for reason, count in sorted(config.stash[_left_out].items()):
        terminalreporter.write_line(f"LEFT OUT [{count}] {reason}")


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:  # noqa: ARG001 the hook's names
    """Take what one of the workers left out: all collect the same tests."""
    if not node.config.stash[_left_out]:
        node.config.stash[_left_out].update(getattr(node, "workeroutput", {}).get("left_out", {}))  # a crash gives none


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):  # in a worker of pytest-xdist
        session.config.workeroutput["left_out"] = dict(session.config.stash[_left_out])


def _parity_must_run(config: pytest.Config) -> bool:
    return config.getoption("no_parity_skips") or bool(os.environ.get("CI"))


def _fail(report: pytest.TestReport | pytest.CollectReport) -> None:
    reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else getattr(report, "wasxfail", "")
    report.outcome, report.longrepr = "failed", f"a parity test may not be skipped ({reason})"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A skipped or expectedly failing parity test is a failure where parity must be tested."""
    report = yield
    if report.skipped and item.get_closest_marker("parity") and _parity_must_run(item.config):
        _fail(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """The same for a module with parity tests that is skipped as a whole."""
    report = yield
    if report.skipped and _parity_must_run(collector.config) and "mark.parity" in collector.path.read_text():
        _fail(report)
    return report


def pytest_collection_finish() -> None:
    """Spare the collector the thousands of tests, and what is imported for them, from here on."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(5000)


@pytest.fixture(scope="session")
def golden() -> Path:
    """Recorded outputs of the published networks and operators: or the whole ones that LIDAR2PANO_GOLDEN names."""
    return Path(os.environ.get("LIDAR2PANO_GOLDEN", ROOT / "tests" / "golden"))


@pytest.fixture(scope="session")
def kitti_mini() -> Path:
    """About a hundred real scan and image pairs of KITTI."""
    return REAL_DATA["kitti_mini"]


@pytest.fixture(scope="session")
def pandaset_mini() -> Path:
    """Twelve real Pandar64 scans with six cameras all around."""
    return REAL_DATA["pandaset_mini"]


@pytest.fixture(scope="session")
def nuscenes() -> Path:
    """One real sample of nuScenes, six cameras all around, with an info file."""
    return REAL_DATA["nuscenes"]


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a family of small untrained networks."""
    from random_weights import write_family

    return write_family(tmp_path_factory.mktemp("weights") / "small")


@pytest.fixture(scope="session")
def front_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a segmenter and a small translator of the paper's kind, untrained."""
    from random_weights import write_front

    return write_front(tmp_path_factory.mktemp("weights") / "front")


@pytest.fixture
def one_thread():
    """As many threads as tests give processes that they start: sums come out alike only when they are split alike."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files without a child process, whose start takes longer than small ones; tests marked `child` have it."""
    if not request.node.get_closest_marker("child"):
        monkeypatch.setattr("lidar2pano.child_process.resource", None)


@pytest.fixture
def small_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """The view that small recipes have is one of VIEWS."""
    from lidar2pano.views import VIEWS
    from small_recipes import VIEW

    for name, view in VIEW.items():
        monkeypatch.setitem(VIEWS, name, view)
