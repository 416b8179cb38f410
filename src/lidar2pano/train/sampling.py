"""Order of samples and their random numbers: functions of the seed and the position in the run alone."""

from __future__ import annotations

import math
import random
import signal
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.train.recipe import Training


def seed_step(seed: int, rank: int, step: int) -> None:
    """Seed step `step` of process `rank`, for random numbers independent of interruptions."""
    number = zlib.crc32(f"{seed}/{rank}/{step}".encode())
    random.seed(number)
    np.random.seed(number)  # noqa: NPY002 libraries of others may draw from the global generator
    torch.manual_seed(number)


def steps_over(samples: int, training: Training) -> int:
    """Optimiser steps of a run on so many training samples: `steps`, or those of `epochs` if fewer."""
    of_epochs = math.ceil(training.epochs * samples / training.batch)
    return min(training.steps, of_epochs) if of_epochs else training.steps


def sample_at(seed: int, position: int, samples: int) -> SampleIndex:
    """The sample at `position` of an endless run through `samples` samples, shuffled again in each epoch."""
    epoch, place = divmod(position, samples)
    state = np.random.SeedSequence([seed, zlib.crc32(b"draw"), position]).generate_state(1, np.uint64)
    return SampleIndex(int(_order(seed, epoch, samples)[place]), int(state[0] >> np.uint64(1)))


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, samples: int) -> np.ndarray:
    return np.random.default_rng([seed, zlib.crc32(b"epoch"), epoch]).permutation(samples)


class BatchSampler:
    """Endless batch sampler of one process: from `step` on, `training.accumulate` micro-batches per step.

    Process `rank` takes every `world`-th position, so that all together take one process's samples.
    """

    def __init__(self, samples: int, step: int, training: Training, rank: int = 0, world: int = 1) -> None:
        self.samples, self.step, self.rank, self.world = samples, step, rank, world
        self.seed, self.batch, self.accumulate = training.seed, training.batch, training.accumulate

    def __iter__(self) -> Iterator[list[SampleIndex]]:
        """Lists of samples, one per micro-batch."""
        step = self.step
        while True:
            positions = range(step * self.batch + self.rank, (step + 1) * self.batch, self.world)
            share = len(positions) // self.accumulate
            for number in range(self.accumulate):
                micro_batch = positions[number * share : (number + 1) * share]
                yield [sample_at(self.seed, position, self.samples) for position in micro_batch]
            step += 1


def batches(dataset: Dataset, sampler: BatchSampler, workers: int, *, pinned: bool) -> Iterator[Any]:
    """Collated micro-batches in the order of `sampler`; workers leave Ctrl-C to the training process.

    A user's mistake in a worker raises InputError with one line; for the loss of a worker see `lost_workers`.
    """
    loader = DataLoader(
        dataset,
        batch_sampler=sampler,
        num_workers=workers,
        pin_memory=pinned,
        worker_init_fn=_ignore_interrupts,
        prefetch_factor=4 if workers else None,
    )
    return _with_short_errors(iter(loader))  # made now: it draws a random number of no step's


def _with_short_errors(loaded: Iterator[Any]) -> Iterator[Any]:
    try:
        with lost_workers():
            yield from loaded
    except InputError as error:  # a worker's exception has its traceback as its text, the message last
        raise InputError(str(error).strip().rpartition("\n")[2].rpartition("InputError: ")[2]) from None


@contextmanager
def lost_workers() -> Iterator[None]:
    """Turn the loss of a worker, raised by torch anywhere, into an InputError with one line."""
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise InputError(
            "a process that prepares samples was killed, often for lack of memory; repeat the command to go on, with "
            "fewer training.workers"
        ) from None


def _ignore_interrupts(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
