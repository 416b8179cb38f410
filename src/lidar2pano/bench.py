"""Times on this machine, warm: parts, each stage of the pipeline, several engines side by side, the street world.

Engines take turns in one process: on a shared machine only ratios count. Tensor operations dispatched for
one panorama are a count for all machines.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lidar2pano.demo import street
from lidar2pano.engines import accelerated, pick_engine
from lidar2pano.geometry.projection import Normalisation, project
from lidar2pano.hardware import Timer, has_bfloat16, pick_device
from lidar2pano.losses import lovasz_softmax
from lidar2pano.markdown import markdown_table
from lidar2pano.memory import Memory
from lidar2pano.models import build
from lidar2pano.models.families import best_family, families
from lidar2pano.pipeline import Pipeline, Segmenter, engine_parts, load, made_fast
from lidar2pano.pipeline.segmenter import clean_up
from lidar2pano.recordings.recorded_scans import read
from lidar2pano.scan import Scan
from lidar2pano.simulate.generation import SequenceWriter, generate
from lidar2pano.simulate.settings import WorldSettings
from lidar2pano.views import VIEWS

CPU = torch.device("cpu")
CAMERA = (15, 376, 1241)  # classes, rows and columns of the published TITAN-Net
WORLD_SEED, WORLD_PLACE = 5, "residential"
WHOLE = "whole panorama"
OUTSIDE = "outside of stages"
Row = dict[str, Any]
"""A line of a table: a title, and the median and least milliseconds over the runs; or the medians by engine."""


def measure(runs: int, device: str = "auto", weights: str = "", engine: str = "auto") -> list[Row]:
    """Time everything on the demo scan, `runs` times after a warm-up; saving the picture included.

    weights, engine  as for `pipeline.load`; weights "": untrained networks.
    Raises InputError when weights, device or engine cannot be had.
    """
    picked, scan = pick_device(device), read(street())
    pipeline = _pipeline(weights, picked, engine)
    image = project(scan, VIEWS["hdl64e"], device=picked)
    ids = torch.randint(1, 20, image.valid.shape, device=picked, generator=torch.Generator(picked).manual_seed(0))
    times = {
        "projection": _times(lambda _: project(scan, VIEWS["hdl64e"], device=picked), runs + 1, picked)[1:],
        "clean-up": _times(lambda _: clean_up(image, ids), runs + 1, picked)[1:],
        "Lovasz": _times(lovasz_step(picked), runs + 1, picked)[1:],
        **_stage_times({engine: pipeline}, scan, runs)[engine],
    }
    return [_row(title, measured) for title, measured in times.items()]


def default_weights() -> str:
    """The default family where it is installed, else "": untrained networks."""
    return best_family() if families() else ""


def _pipeline(weights: str, device: torch.device, engine: str) -> Pipeline:
    return load(weights, device.type, engine) if weights else untrained(device, engine)


def _stage_times(pipelines: Mapping[str, Pipeline], scan: Scan, runs: int) -> dict[str, dict[str, list[float]]]:
    """Return engine -> stage or whole -> milliseconds of each run after the first."""
    times: dict[str, dict[str, list[float]]] = {engine: {} for engine in pipelines}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(runs + 1):
            for engine, pipeline in pipelines.items():
                begin = time.perf_counter()
                panorama = pipeline(scan)
                painted = time.perf_counter()
                panorama.save(folder)
                end = time.perf_counter()
                stages = {**panorama.milliseconds, "save": (end - painted) * 1e3}
                measured = {f"stage {stage}": value for stage, value in stages.items()} | {WHOLE: (end - begin) * 1e3}
                for title, value in measured.items() if number else ():
                    times[engine].setdefault(title, []).append(value)
    return times


def compare(runs: int, device: str, weights: str, engines: Sequence[str]) -> list[Row]:
    """Time the stages of the pipeline `runs` times by each engine, after a warm-up that compiles.

    Arguments as of `measure`, which raises the same errors.
    """
    picked = pick_device(device)
    times = _stage_times({engine: _pipeline(weights, picked, engine) for engine in engines}, read(street()), runs)
    return [
        {
            "title": title,
            "median_ms": {engine: round(statistics.median(stages[title]), 2) for engine, stages in times.items()},
        }
        for title in times[engines[0]]
    ]


def measure_world(runs: int, processes: int) -> list[Row]:
    """Time one street: its scene, `runs` scans and whole frames in this process, and frames by `processes`.

    A frame is an HDL-64E scan with labels, the 1242 x 375 camera image and the 384 x 4608 panorama with labels and
    depth, written to files. Raises InputError without embreex.
    """
    settings = WorldSettings(seed=WORLD_SEED, frames=max(runs + 1, 10 * processes), place=WORLD_PLACE)
    with tempfile.TemporaryDirectory() as folder:
        writer = SequenceWriter(Path(folder) / "one", settings, 0)
        rows = [
            _row("world: build a piece of a town", _times(writer.scene, 1)),
            _row("world: scan with labels", _times(writer.scan, runs + 1)[1:]),
            _row("world: whole frame, one process", _times(writer.write, runs + 1)[1:]),  # the first makes the textures
        ]
        begin = time.perf_counter()
        frames = sum(generate(Path(folder) / "many", settings, 1, processes))
        frame_ms = (time.perf_counter() - begin) * 1e3 / frames
        title = f"world: whole frame, {processes} processes, {frames} frames, start and build included"
        return [*rows, _row(title, [frame_ms])]


def conditions(device: str, runs: int) -> dict[str, Any]:
    """What the times depend on, for JSON: device, threads, arithmetic, number of runs, versions."""
    picked = pick_device(device)
    return {
        "device": torch.cuda.get_device_name(picked) if picked.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "bfloat16": has_bfloat16(picked),
        "runs": runs,
        "torch": torch.__version__,
    }


def table(rows: Sequence[Row]) -> str:
    """Markdown: a line per row."""
    cells = ([row["title"], f"{row['median_ms']:.1f}", f"{row['least_ms']:.1f}"] for row in rows)
    return markdown_table(["milliseconds", "median", "least"], cells)


def comparison_table(rows: Sequence[Row]) -> str:
    """Markdown: a line per stage; each engine's time, and how often it fits into the first's."""
    first, *further = rows[0]["median_ms"]
    head = ["milliseconds, median", first, *(column for name in further for column in (name, f"{first} / {name}"))]
    lines = []
    for row in rows:
        times = row["median_ms"]
        cells = [row["title"], f"{times[first]:.0f}"]
        for name in further:
            cells += [f"{times[name]:.0f}", f"{times[first] / max(times[name], 0.01):.2f}"]
        lines.append(cells)
    return markdown_table(head, lines)


def lovasz_step(device: torch.device) -> Callable[[int], None]:
    """Forward and backward of the Lovasz-Softmax loss on one image of the published size."""
    generator = torch.Generator(device).manual_seed(0)
    classes, rows, columns = CAMERA
    logits = torch.randn(1, classes, rows, columns, device=device, generator=generator).requires_grad_()
    target = torch.randint(0, classes, (1, rows, columns), device=device, generator=generator)

    def step(_: int) -> None:
        logits.grad = None
        lovasz_softmax(logits.softmax(1), target, ignore=0).backward()

    return step


def untrained(device: torch.device, engine: str = "torch") -> Pipeline:
    """The released networks' shapes with random weights: as fast, and of no other use."""
    segmenter, translator, painter = (
        made_fast(build(name).eval().to(device)) for name in ("salsanext", "titan-pano", "latent-painter")
    )
    for network, name in ((segmenter, "salsanext"), (translator, "titan-pano"), (painter, "latent-painter")):
        for model, part in engine_parts(network, name).items():
            accelerated(part, model, "", engine, device)
    return Pipeline(
        segmenter=Segmenter(network=segmenter, view=VIEWS["hdl64e"], normalise=Normalisation()),
        translator=translator,
        painter=painter,  # pyright: ignore[reportArgumentType] a LatentPainter, as built
        view=VIEWS["panorama"].scaled(0.5),
        device=device,
        engine=pick_engine(engine, device),
    )


def _times(work: Callable[[int], object], runs: int, device: torch.device = CPU) -> list[float]:
    """Return the milliseconds of each of some calls with their numbers."""
    times = []
    for number in range(runs):
        timer = Timer(device)
        with timer("work"):
            work(number)
        times += timer.milliseconds.values()
    return times


def _row(title: str, times: list[float]) -> Row:
    return {"title": title, "median_ms": round(statistics.median(times), 2), "least_ms": round(min(times), 2)}


class _Counter(TorchDispatchMode):
    """Counts dispatched operations by the stage that is set.

    Those by which autocast rounds to bfloat16 do not count: a device without such units has none.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stage, self.counts = OUTSIDE, dict[str, int]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401, ARG002
        is_rounding = func is torch.ops.aten.to.dtype and args[1] is torch.bfloat16
        self.counts[self.stage] = self.counts.get(self.stage, 0) + (not is_rounding)
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


def measure_operations(weights: str, device: str) -> list[Row]:
    """Count the tensor operations that the demo scan's panorama dispatches: a row per stage, then the sum.

    Views count, too. An engine other than torch would compute a whole network in one operation or in none.
    weights  "": untrained networks. Raises InputError when weights or device cannot be had.
    """
    pipeline, counter = _pipeline(weights, pick_device(device), "torch"), _Counter()
    with counter:
        pipeline.step(Memory(), read(street()), None, _CountingTimer(pipeline.device, counter))
    counts = {**counter.counts, WHOLE: sum(counter.counts.values())}
    return [{"stage": stage, "operations": count} for stage, count in counts.items()]


def operations_table(rows: list[Row]) -> str:
    """Format the counts as Markdown, a line per stage."""
    return markdown_table(["stage", "tensor operations"], ([row["stage"], str(row["operations"])] for row in rows))
