"""A bulk run on a Ray cluster: a pool of workers, one per GPU or per so many cores; any may be killed at any time."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any

from lidar2pano.bulk.entries import Entry, Job
from lidar2pano.bulk.job import Worker
from lidar2pano.bulk.manifest import line
from lidar2pano.bulk.stores import open_store
from lidar2pano.errors import InputError

AT_ONCE = 3  # scans in a worker: one is read and one written while one is painted
ATTEMPTS = 3  # at a scan whose worker dies
POLL_S = 1.0
Answer = tuple[Entry, dict[str, Any] | None]  # a scan and its line


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
    pool: list[Any] = []
    try:
        for entry, record in translate_in_pool(pool, lambda: remote.remote(job, cores), workers, todo, stopped):
            died = {"outputs": [], "error": f"{entry.key}: its worker died {ATTEMPTS} times"}
            yield record or line(entry.key, "", job.weights, **died)
    finally:
        ray.wait([worker.close.remote() for worker in pool], num_returns=len(pool) or 1, timeout=10)
        with open_store(job.out).scratch():  # removes files of killed workers
            pass


def translate_in_pool(
    pool: list[Any], make: Callable[[], Any], size: int, todo: Iterable[Entry], stopped: Callable[[], bool]
) -> Iterator[Answer]:
    """Yield scans and their lines as they come; None of a scan with ATTEMPTS dead workers.

    pool  gets `size` workers, started by `make`, and another for each dead one.
    The scans of a dead worker are tried again when all others are done, each alone in a worker.
    """
    pool += [make() for _ in range(size)]
    for attempt in range(ATTEMPTS):
        suspects: list[Entry] = []
        for entry, record in _answers(pool, make, iter(todo), stopped, 1 if attempt else AT_ONCE):
            if record:
                yield entry, record
            else:
                suspects.append(entry)
        todo = suspects
    yield from ((entry, None) for entry in todo)


def _answers(
    pool: list[Any], make: Callable[[], Any], scans: Iterator[Entry], stopped: Callable[[], bool], at_once: int
) -> Iterator[Answer]:
    """Give out scans, so many to a worker at once; yield each with its line, None if its worker has died."""
    from ray import get, wait
    from ray.exceptions import RayActorError, RayTaskError

    failed_starts = 0
    running: dict[Any, tuple[Any, Entry | None]]  # reference -> worker, scan (None: starts)
    running = {worker.prepare.remote(): (worker, None) for worker in pool}
    while running and not (stopped() and all(entry is None for _, entry in running.values())):
        for reference in wait(list(running), timeout=POLL_S)[0]:
            worker, entry = running.pop(reference)
            try:
                record: Any = get(reference)
            except RayTaskError as error:
                raise (error.cause if isinstance(error.cause, InputError) else error) from None
            except RayActorError:
                if entry is not None:
                    yield entry, None
                elif (failed_starts := failed_starts + 1) > ATTEMPTS:
                    raise InputError("--ray: workers die while they start; look into Ray's logs") from None
                if worker in pool:  # not replaced yet, for another of its scans
                    pool[pool.index(worker)] = worker = make()
                    running[worker.prepare.remote()] = worker, None
                continue
            if entry is None:
                failed_starts = 0  # in a row
            else:
                yield entry, record
            for following in islice(scans, 0 if stopped() else at_once if entry is None else 1):
                running[worker.translate.remote(following)] = worker, following
