"""How long things take on this machine: projection, clean-up, the Lovasz loss, and each stage of the pipeline, warm."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from lidar2pano.engines import accelerated, pick_engine
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import Normalisation, project
from lidar2pano.hardware import has_bfloat16, pick_device
from lidar2pano.losses import lovasz_softmax
from lidar2pano.models import build
from lidar2pano.models.families import best_family, families
from lidar2pano.pipeline import Pipeline, Segmenter, assemble, load, made_fast
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS

POINTS = 120_000
CAMERA = (15, 376, 1241)  # classes, rows and columns of the published TITAN-Net
# Milliseconds that we aim at, by device, or that the published code took on an idle Xeon with two cores (AMX), float32,
# its large buffers kept by the allocator.
AIMS = {
    "cpu": {"projection": "< 5", "clean-up": "< 25", "Lovasz": "published 630", "panorama": "< 1500, aim 1000"},
    "cuda": {"panorama": "< 50"},
}
PUBLISHED = {"segment": "published 640", "clean_up": "published 70 to 90", "translate": "published 1140 (64 x 2048)"}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One thing that was timed; milliseconds: median and least over the runs; aim: what it should take, in words."""

    what: str
    median_ms: float
    least_ms: float
    aim: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The row for JSON."""
        return asdict(self)


def measure(runs: int, device: str = "auto", weights: str = "", engine: str = "auto") -> list[Row]:
    """Time everything `runs` times after a warm-up.

    weights, engine  as for `pipeline.load`; weights "": untrained networks.
    Raises InputError when weights, device or engine cannot be had.
    """
    picked = pick_device(device)
    pipeline = load(weights, device, engine) if weights else untrained(picked, engine)
    aims = AIMS[picked.type]
    scan = made_up_scan(POINTS, seed=0)
    image = project(scan, VIEWS["hdl64e"], device=picked)
    ids = torch.randint(1, 20, image.valid.shape, device=picked, generator=torch.Generator(picked).manual_seed(0))
    row = _timer(runs, picked)
    return [
        row("projection", aims, lambda: project(scan, VIEWS["hdl64e"], device=picked)),
        row("clean-up", aims, lambda: clean_up(image, ids)),
        row("Lovasz", aims, lovasz_step(picked)),
        *stages(pipeline, scan, runs, aims),
    ]


def default_weights() -> str:
    """The default family where it is installed, else "": untrained networks."""
    return best_family() if families() else ""


def stages(pipeline: Pipeline, scan: Scan, runs: int, aims: dict[str, str]) -> list[Row]:
    """The pipeline's stages, saving the picture included, and their sum."""
    taken: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs + 1):
            panorama = pipeline(scan)
            begin = time.perf_counter()
            panorama.save(folder)
            taken.append({**panorama.milliseconds, "save": (time.perf_counter() - begin) * 1e3})
    warm = taken[1:]
    rows = {stage: [run[stage] for run in warm] for stage in warm[0]}
    published = PUBLISHED if pipeline.device.type == "cpu" else {}
    return [
        *(_row(f"stage {stage}", times, published.get(stage, "")) for stage, times in rows.items()),
        _row("whole panorama", [sum(run.values()) for run in warm], aims["panorama"]),
    ]


def conditions(device: str, runs: int) -> dict[str, Any]:
    """What the times depend on, for JSON: device, threads, arithmetic, number of runs, versions."""
    picked = pick_device(device)
    return {
        "device": torch.cuda.get_device_name(picked) if picked.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "bfloat16": has_bfloat16(picked),
        "runs": runs,
        "points": POINTS,
        "torch": torch.__version__,
    }


def table(rows: list[Row], conditions: dict[str, Any]) -> str:
    """Markdown: the conditions, then a line per row."""
    words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in conditions.items())
    head = ["| milliseconds | median | least | aim |", "|---|---:|---:|---|"]
    return "\n".join(
        [words, "", *head, *(f"| {row.what} | {row.median_ms:.1f} | {row.least_ms:.1f} | {row.aim} |" for row in rows)]
    )


def made_up_scan(points: int, seed: int) -> Scan:
    """A scan of a street that does not exist: 64 beams from +2 to -24.8 degrees over flat ground between two walls."""
    generator = np.random.default_rng(seed)
    beams = 64
    azimuth = np.repeat(np.linspace(math.pi, -math.pi, -(-points // beams), endpoint=False), beams)[:points]
    elevation = np.radians(np.tile(np.linspace(2.0, -24.8, beams), -(-points // beams))[:points])
    wall_m = 8 / np.maximum(np.abs(np.sin(azimuth)), 0.1)
    ground_m = 1.73 / np.maximum(-np.tan(elevation), 0.01)
    flat_m = np.minimum(wall_m, ground_m) * generator.uniform(0.97, 1.03, points)
    xyz = np.stack([flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), flat_m * np.tan(elevation)], axis=1)
    order = np.argsort(np.tile(np.arange(beams), -(-points // beams))[:points], kind="stable")  # beam by beam, as KITTI
    remission = generator.uniform(0, 1, points).astype(np.float32)
    return Scan(xyz=xyz[order].astype(np.float32), remission=remission, name="made-up")


def lovasz_step(device: torch.device) -> Callable[[], None]:
    """Forward and backward of the Lovasz-Softmax loss on one image of the published size."""
    generator = torch.Generator(device).manual_seed(0)
    classes, rows, columns = CAMERA
    logits = torch.randn(1, classes, rows, columns, device=device, generator=generator).requires_grad_()
    target = torch.randint(0, classes, (1, rows, columns), device=device, generator=generator)

    def step() -> None:
        logits.grad = None
        lovasz_softmax(logits.softmax(1), target, ignore=0).backward()

    return step


def untrained(device: torch.device, engine: str = "torch") -> Pipeline:
    """The released networks' shapes with random weights: as fast, and of no other use."""
    segmenter, translator, painter = (
        accelerated(made_fast(build(name).eval().to(device)), name, "", engine, device)
        for name in ("salsanext", "titan-pano", "scene-painter")
    )
    return assemble(
        Segmenter(network=segmenter, view=VIEWS["hdl64e"], normalise=Normalisation()),
        translator,
        painter,  # pyright: ignore[reportArgumentType] a ScenePainter, as built
        VIEWS["panorama"].scaled(0.5),
        device,
        engine=pick_engine(engine, device),
    )


def _timer(runs: int, device: torch.device) -> Callable[[str, dict[str, str], Callable[[], object]], Row]:
    def timed(what: str, aims: dict[str, str], work: Callable[[], object]) -> Row:
        times = []
        for _ in range(runs + 1):
            begin = time.perf_counter()
            work()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            times.append((time.perf_counter() - begin) * 1e3)
        return _row(what, times[1:], aims.get(what, ""))

    return timed


def _row(what: str, times: list[float], aim: str) -> Row:
    return Row(what=what, median_ms=round(statistics.median(times), 2), least_ms=round(min(times), 2), aim=aim)
