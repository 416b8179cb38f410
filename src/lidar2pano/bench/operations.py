"""Tensor operations that one panorama dispatches, stage by stage: a count that holds on any machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lidar2pano.bench.timings import WHOLE, markdown_table, untrained
from lidar2pano.demo import street
from lidar2pano.hardware import Timer, pick_device
from lidar2pano.memory import Memory
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.recordings.recorded_scans import read
from lidar2pano.scan import Scan

BELIEF = ("project", "segment", "clean_up", "translate")  # stages that make a scene
OUTSIDE = "outside of stages"


@dataclass(frozen=True, kw_only=True)
class Operations:
    """Number of tensor operations of one stage."""

    stage: str
    operations: int


class _Counter(TorchDispatchMode):
    """Counts dispatched operations by the stage that is set."""

    def __init__(self) -> None:
        super().__init__()
        self.stage, self.counts = OUTSIDE, dict[str, int]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401, ARG002
        self.counts[self.stage] = self.counts.get(self.stage, 0) + 1
        return func(*args, **(kwargs or {}))


class _CountingTimer(Timer):
    """A timer that tells a counter the stage."""

    __slots__ = ("counter",)

    def __init__(self, device: torch.device, counter: _Counter) -> None:
        super().__init__(device)
        self.counter = counter

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        previous, self.counter.stage = self.counter.stage, stage
        with super().__call__(stage):
            yield
        self.counter.stage = previous


def measure_operations(weights: str, device: str) -> list[Operations]:
    """Count the operations of the demo scan's panorama by torch; weights "": untrained networks.

    Raises InputError when weights or device cannot be had.
    """
    pipeline = load(weights, device, "torch") if weights else untrained(pick_device(device))
    return count_operations(pipeline, read(street()))


def count_operations(pipeline: Pipeline, scan: Scan) -> list[Operations]:
    """Count the tensor operations that a panorama of a single scan dispatches: a row per stage, then the sum.

    Views count, too. An engine other than torch computes a whole network in one operation or in none.
    """
    counter = _Counter()
    with counter:
        pipeline.step(Memory(), scan, None, _CountingTimer(pipeline.device, counter))
    total = sum(counter.counts.values())
    counts = {**counter.counts, WHOLE: total}
    return [Operations(stage=stage, operations=count) for stage, count in counts.items()]


def operations_table(rows: list[Operations]) -> str:
    """Format the counts as Markdown, a line per stage."""
    return markdown_table(["stage", "tensor operations"], ([row.stage, str(row.operations)] for row in rows))
