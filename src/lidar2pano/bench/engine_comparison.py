"""The pipeline's stages by several engines, taking turns in one process: on a shared machine only ratios count."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from lidar2pano.bench.timings import POINTS, made_up_scan, untrained
from lidar2pano.hardware import pick_device
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.scan import Scan

WHOLE = "whole panorama"


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Median milliseconds of one stage by engine, in the order that they were named."""

    what: str
    median_ms: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """The comparison for JSON."""
        return asdict(self)


def compare(runs: int, device: str, weights: str, engines: Sequence[str]) -> list[Comparison]:
    """Time the stages of the pipeline `runs` times by each engine, after a warm-up that compiles.

    Arguments as of `timings.measure`, which raises the same errors.
    """
    picked = pick_device(device)
    pipelines = {engine: load(weights, device, engine) if weights else untrained(picked, engine) for engine in engines}
    scan = made_up_scan(POINTS, seed=0)
    taken: dict[str, list[dict[str, float]]] = {engine: [] for engine in engines}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs + 1):
            for name, pipeline in pipelines.items():
                taken[name].append(_stages(pipeline, scan, folder))
    stages = next(iter(taken.values()))[0]
    return [_row(stage, taken) for stage in stages]


def _row(stage: str, taken: dict[str, list[dict[str, float]]]) -> Comparison:
    warm = {name: [run[stage] for run in times[1:]] for name, times in taken.items()}
    return Comparison(
        what=stage if stage == WHOLE else f"stage {stage}",
        median_ms={name: round(statistics.median(times), 2) for name, times in warm.items()},
    )


def _stages(pipeline: Pipeline, scan: Scan, folder: str) -> dict[str, float]:
    begin = time.perf_counter()
    panorama = pipeline(scan)
    painted = time.perf_counter()
    panorama.save(folder)
    end = time.perf_counter()
    return {**panorama.milliseconds, "save": (end - painted) * 1e3, WHOLE: (end - begin) * 1e3}


def comparison_table(rows: Sequence[Comparison], conditions: dict[str, Any]) -> str:
    """Markdown: the conditions, then a line per stage; each engine's time, and how often it fits into the first's."""
    first, *rest = rows[0].median_ms
    words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in conditions.items())
    head = ["milliseconds, median", first, *(column for name in rest for column in (name, f"{first} / {name}"))]
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    for row in rows:
        cells = [row.what, f"{row.median_ms[first]:.0f}"]
        for name in rest:
            cells += [f"{row.median_ms[name]:.0f}", f"{row.median_ms[first] / max(row.median_ms[name], 0.01):.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([words, "", *lines])
