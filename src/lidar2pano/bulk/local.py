"""A bulk run in this process: reading ahead and writing behind while the networks work."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import takewhile
from typing import Any, TypeVar

from lidar2pano.bulk.entries import Entry
from lidar2pano.bulk.job import Job, Worker
from lidar2pano.bulk.stores import open_store

A = TypeVar("A")
B = TypeVar("B")
MOST_THREADS = 8  # for writing: coding a panorama's PNG takes a core about a seventh of a second


def translate_all(job: Job, todo: Iterable[Entry], stopped: Callable[[], bool]) -> Iterator[dict[str, Any]]:
    """Translate scans and yield the manifest's lines in their order, each when its outputs are written.

    stopped  asked before each scan: when true, those that were begun are finished, and that is all.
    Raises InputError when the outputs cannot be written or the pipeline cannot be made.
    """
    threads = min(MOST_THREADS, os.cpu_count() or 1)
    going = takewhile(lambda _: not stopped(), todo)
    with (
        open_store(job.out).scratch() as folder,
        closing(Worker(job, folder)) as worker,
        ThreadPoolExecutor(threads) as pool,
    ):
        painted = (worker.paint(work) for work in _ahead(pool, worker.load, map(worker.request, going), threads))
        for work in _ahead(pool, worker.write, painted, threads):
            yield work.record(job)


def _ahead(pool: ThreadPoolExecutor, function: Callable[[A], B], items: Iterable[A], most: int) -> Iterator[B]:
    """`map` in threads, in order, with at most so many items begun beyond the one that is yielded."""
    begun: deque[Future[B]] = deque()
    try:
        for item in items:
            begun.append(pool.submit(function, item))
            while begun and (len(begun) > most or begun[0].done()):
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        for future in begun:
            future.cancel()
