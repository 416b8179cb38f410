"""A bulk run on a Ray cluster: a pool of workers, one per GPU or per so many cores; any may be killed at any time."""

from __future__ import annotations

import logging
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from lidar2pano.bulk.entries import Entry, Job, ScanKey
from lidar2pano.bulk.job import Worker
from lidar2pano.bulk.manifest import line
from lidar2pano.bulk.stores import open_store
from lidar2pano.errors import InputError

AT_ONCE = 3  # scans in a worker: one is read and one written while one is painted
ATTEMPTS = 3  # at a scan whose worker dies
POLL_S = 1.0


@contextmanager
def connected(address: str) -> Iterator[dict[str, float]]:
    """Connect to a Ray cluster; give its resources: "CPU", "GPU".

    address  of the cluster; "auto": of RAY_ADDRESS, else one on this machine, else a new one.
    Raises InputError if there is none.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to others
    import ray

    try:
        ray.init(None if address == "auto" else address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # a node that does not start in time raises this very class
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"--ray {address}: cannot be connected to ({reason}); start a cluster by ray start") from error
    try:
        yield dict(ray.cluster_resources())  # pyright: ignore[reportReturnType]
    finally:
        ray.shutdown()


class RayWorker:
    """A Worker in a process of its own. Several of its calls run at once, but one at a time paints."""

    def __init__(self, job: Job, cores: int) -> None:
        import torch

        torch.set_num_threads(cores)
        self._exit = ExitStack()
        self._worker = Worker(job, self._exit.enter_context(open_store(job.out).scratch()))
        self._painting = threading.Lock()

    def prepare(self) -> None:
        """Make the pipeline."""
        _ = self._worker.translator.pipeline

    def translate(self, entry: Entry) -> dict[str, Any]:
        """Translate a scan; return the manifest's line."""
        work = self._worker.load(self._worker.request(entry))
        with self._painting:
            self._worker.paint(work)
        return self._worker.write(work).record(self._worker.job)

    def close(self) -> None:
        """Remove the scratch folder, and close recordings."""
        self._worker.close()
        self._exit.close()


class Pool:
    """Workers and their tasks. A dead worker is replaced, and its scans are given out again.

    make  starts a worker;  size: how many there are;  todo: the scans.
    """

    def __init__(self, make: Callable[[], Any], size: int, todo: Iterable[Entry]) -> None:
        self._make = make
        self._todo = deque(todo)
        self._suspects: deque[Entry] = deque()  # were in a dead worker: each is tried again alone
        self._deaths: Counter[ScanKey] = Counter()
        self._failed_starts = 0
        self._free: dict[Any, int] = {}  # worker -> how many more scans it takes; not while it starts
        self._running: dict[Any, tuple[Any, Entry | None, int]] = {}  # reference -> worker, scan (None: starts), load
        for _ in range(size):
            self._start()

    def records(self, job: Job, stopped: Callable[[], bool]) -> Iterator[dict[str, Any]]:
        """Translate all scans and yield the manifest's lines as they come; see `bulk.job.translate_all`."""
        import ray

        while True:
            if not stopped():
                self._give_out()
            at_work = any(entry is not None for _, entry, _ in self._running.values())
            if not at_work and (stopped() or not (self._todo or self._suspects)):
                return
            for reference in ray.wait(list(self._running), timeout=POLL_S)[0]:
                if record := self._taken(reference, job):
                    yield record

    def _taken(self, reference: Any, job: Job) -> dict[str, Any] | None:  # noqa: ANN401
        """Return the line of a call that has ended; None for a started worker, or a scan to be tried again."""
        from ray import get
        from ray.exceptions import RayActorError, RayTaskError

        worker, entry, load = self._running.pop(reference)
        try:
            record: Any = get(reference)
        except RayTaskError as error:
            raise (error.cause if isinstance(error.cause, InputError) else error) from None
        except RayActorError:
            return self._bury(worker, entry, job)
        if entry is None:
            self._free[worker], self._failed_starts = AT_ONCE, 0
        elif worker in self._free:  # otherwise it has died since
            self._free[worker] += load
        return record

    def close(self) -> None:
        """End the workers."""
        import ray

        ray.wait([worker.close.remote() for worker in self._free], num_returns=len(self._free) or 1, timeout=10)

    def _start(self) -> None:
        worker = self._make()
        self._running[worker.prepare.remote()] = (worker, None, AT_ONCE)

    def _give_out(self) -> None:
        for worker in list(self._free):
            while self._free[worker] > 0:
                retry = bool(self._suspects) and self._free[worker] == AT_ONCE
                if not retry and not self._todo:
                    break
                entry = (self._suspects if retry else self._todo).popleft()
                load = AT_ONCE if retry else 1
                self._free[worker] -= load
                self._running[worker.translate.remote(entry)] = (worker, entry, load)

    def _bury(self, worker: Any, entry: Entry | None, job: Job) -> dict[str, Any] | None:  # noqa: ANN401
        """Replace a dead worker; return the line of the scan if it has cost too many workers."""
        if self._free.pop(worker, None) is not None or entry is None:
            self._failed_starts += entry is None
            if self._failed_starts > ATTEMPTS:
                raise InputError("--ray: workers die while they start; look into Ray's logs")
            self._start()
        if entry is None:
            return None
        self._deaths[entry.key] += 1
        if self._deaths[entry.key] < ATTEMPTS:
            self._suspects.append(entry)
            return None
        return line(entry.key, "", job.weights, outputs=[], error=f"{entry.key}: its worker died {ATTEMPTS} times")


def translate_on_ray(
    job: Job, todo: Iterable[Entry], stopped: Callable[[], bool], *, workers: int, cores: int, gpus: int
) -> Iterator[dict[str, Any]]:
    """Translate scans on the connected cluster and yield the manifest's lines as they come.

    workers  how many;  cores, gpus: of each. Missing resources are waited for, and asked of the autoscaler.
    Raises InputError as `bulk.job.translate_all`.
    """
    import ray

    settings: dict[str, Any] = {"num_cpus": cores, "num_gpus": gpus, "max_restarts": 0, "max_concurrency": AT_ONCE}
    remote: Any = ray.remote(**settings)(RayWorker)
    pool = Pool(lambda: remote.remote(job, cores), workers, todo)
    try:
        yield from pool.records(job, stopped)
    finally:
        pool.close()
        with open_store(job.out).scratch():  # removes files of killed workers
            pass
