"""Which sample comes when, and with which random numbers: functions of the seed and the place in the run alone."""

from __future__ import annotations

import random
import signal
import zlib
from collections.abc import Iterator
from functools import lru_cache
from typing import cast

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from lidar2pano.data.frames import SampleIndex
from lidar2pano.train.recipe import Training
from lidar2pano.train.task import Samples


def seed_step(seed: int, rank: int, step: int) -> None:
    """Make step `step` of process `rank` draw the same numbers whether or not the run was interrupted before it."""
    number = zlib.crc32(f"{seed}/{rank}/{step}".encode())
    random.seed(number)
    np.random.seed(number)  # noqa: NPY002 libraries of others may draw from the global generator
    torch.manual_seed(number)


def draw_at(seed: int, place: int, samples: int) -> SampleIndex:
    """The draw at `place` of an endless run through `samples` samples that shuffles them anew in each epoch."""
    epoch, position = divmod(place, samples)
    state = np.random.SeedSequence([seed, zlib.crc32(b"draw"), place]).generate_state(1, np.uint64)
    return SampleIndex(int(_order(seed, epoch, samples)[position]), int(state[0] >> np.uint64(1)))


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, samples: int) -> np.ndarray:
    return np.random.default_rng([seed, zlib.crc32(b"epoch"), epoch]).permutation(samples)


class Places:
    """Endless batch sampler of one process: from `step` on, `training.accumulate` lists of draws per step.

    Process `rank` takes every `world`-th place, so that all processes together see what one would.
    """

    def __init__(self, samples: int, step: int, training: Training, rank: int = 0, world: int = 1) -> None:
        self.samples, self.step, self.rank, self.world = samples, step, rank, world
        self.seed, self.batch, self.accumulate = training.seed, training.batch, training.accumulate

    def __iter__(self) -> Iterator[list[SampleIndex]]:
        """Lists of draws, one per micro-batch."""
        step = self.step
        while True:
            places = range(step * self.batch + self.rank, (step + 1) * self.batch, self.world)
            share = len(places) // self.accumulate
            for turn in range(self.accumulate):
                mine = places[turn * share : (turn + 1) * share]
                yield [draw_at(self.seed, place, self.samples) for place in mine]
            step += 1


def loader(dataset: Samples, places: Places, workers: int, pinned: bool) -> DataLoader:
    """Collated micro-batches in the order of `places`; workers leave Ctrl-C to the process that trains."""
    return DataLoader(
        cast(Dataset, dataset),
        batch_sampler=places,
        num_workers=workers,
        pin_memory=pinned,
        worker_init_fn=_leave_interrupts,
        prefetch_factor=4 if workers else None,
    )


def _leave_interrupts(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
