"""Training curves: the scalars of every run's TensorBoard files as one picture."""

from __future__ import annotations

import logging
from pathlib import Path

from lidar2pano.formats.image_files import write_whole


def scalars(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Tag -> (step, value) of a run's TensorBoard files; empty where it has none."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = run / "tensorboard"
    if not folder.is_dir():
        return {}
    logging.getLogger("tensorboard").setLevel(logging.WARNING)  # it tells of every file that it has read to its end
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(one.step, one.value) for one in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def write_curves(runs: dict[str, Path], path: Path) -> Path | None:
    """Draw every run's losses into one PNG, a panel a run; None where there is nothing to draw."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    found = {name: losses for name, run in runs.items() if (losses := _losses(scalars(run)))}
    if not found:
        return None
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4 * columns, 2.6 * rows), squeeze=False)
    for panel in axes.flat[len(found) :]:
        panel.axis("off")
    for panel, (name, losses) in zip(axes.flat, found.items(), strict=False):
        for tag, points in losses.items():
            panel.plot(*zip(*points, strict=True), label=tag, linewidth=1)
        panel.set_title(name, fontsize=9)
        panel.tick_params(labelsize=7)
        panel.legend(fontsize=6)
    figure.tight_layout()
    try:
        return write_whole(path, lambda beside: figure.savefig(beside, format="png", dpi=80))
    finally:
        plt.close(figure)


def _losses(found: dict[str, list[tuple[int, float]]]) -> dict[str, list[tuple[int, float]]]:
    """Losses (rates and validation have a slash in their names) that have two points or more."""
    return {tag: points for tag, points in found.items() if len(points) > 1 and "/" not in tag}
