"""What every test gets: no network, seeded draws, threads set once; and where the recorded and the real data lie."""

from __future__ import annotations

import functools
import ipaddress
import os
import random
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent


def _refuse_strangers(address: object) -> None:
    """Raise RuntimeError unless the address is of this machine (loopback, or a path: a Unix socket)."""
    if not isinstance(address, tuple):
        return
    host = str(address[0])
    try:
        mine = host in {"", "localhost"} or ipaddress.ip_address(host).is_loopback
    except ValueError:
        mine = False
    if not mine:
        raise RuntimeError(f"a test tried to connect to {host!r}; the suite runs without a network")


def close_network(patch: pytest.MonkeyPatch) -> None:
    """Let sockets connect to this machine only."""

    def guarded(original: Any, position: int) -> Any:
        @functools.wraps(original)
        def connect(*args: Any, **settings: Any) -> Any:
            _refuse_strangers(args[position])
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
        sys.modules["torch"].set_num_threads(count)


@pytest.fixture(autouse=True)
def _seeded():
    """Every test draws the same numbers whatever ran before it; torch is not imported for tests that do not use it."""
    random.seed(0)
    if "torch" in sys.modules:
        _set_threads()
        sys.modules["torch"].manual_seed(0)


def _folder(path: Path, how: str) -> Path:
    if not path.is_dir():
        pytest.skip(f"{path} is missing: {how}")
    return path


@pytest.fixture(scope="session")
def golden() -> Path:
    """The recorded inputs and outputs of the published networks and operators."""
    path = Path(os.environ.get("LIDAR2PANO_GOLDEN", ROOT.parent / "shared" / "golden"))
    return _folder(path, "set LIDAR2PANO_GOLDEN to the folder of golden vectors")


@pytest.fixture(scope="session")
def kitti_mini() -> Path:
    """About a hundred real scan and image pairs of KITTI."""
    return _folder(ROOT / "data" / "kitti-mini", "unpack the real data into data/")


@pytest.fixture(scope="session")
def pandaset_mini() -> Path:
    """Twelve real Pandar64 scans with six cameras all around."""
    return _folder(ROOT / "data" / "pandaset-mini", "unpack the real data into data/")


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
def small_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """The view that small recipes have is one of VIEWS."""
    from lidar2pano.views import VIEWS
    from small_recipes import VIEW

    for name, view in VIEW.items():
        monkeypatch.setitem(VIEWS, name, view)
