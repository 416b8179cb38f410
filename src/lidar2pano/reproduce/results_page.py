"""RESULTS.md of a reproduction: the paper's tables, its values beside ours, its orderings, and training curves."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.labels import COMMON14
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.reproduce.image_sheets import write_sheets
from lidar2pano.reproduce.paper_tables import CLAIMS, LEVELS, PAPER_TIMES, Claim
from lidar2pano.reproduce.plan import SEGMENTER, Plan
from lidar2pano.reproduce.run import Outcome
from lidar2pano.train.checkpoint import commit

CLASSES = COMMON14.classes[1:]
LEAST_STEPS, LEAST_FRAMES = 1000, 50  # of training, and of scoring: below, an ordering is not decided
IMAGE_METRICS = {
    "ssim": "SSIM",
    "fid": "FID",
    **{f"swd_pairs_{level}": f"SWD {level}" for level in LEVELS},
    "swd_pairs": "SWD mean",
    "swd": "set SWD x 1000",
}
SWD_NOTE = (
    "\n\nSWD: of each image and its real one, on the paper's scale, averaged over frames; unrelated photographs of"
    " KITTI are at 2.6. Set SWD: between all images together, as Karras et al. 2018 define it."
)
PANORAMA_METRICS = {
    "miou": "mIoU",
    "ssim": "SSIM",
    "swd": "SWD mean",
    "depth_abs_rel": "depth AbsRel",
    "depth_rmse_m": "depth RMSE, m",
    "seam_ratio": "seam ratio",
    "seam_ratio_nearby": "seam ratio nearby",
    "warping_error": "warping error",
}


def write_results_page(plan: Plan, outcome: Outcome) -> Path:
    """Write DIR/RESULTS.md with the images it shows; return its path."""
    names = {"ground-truth": "ground truth"} | {name: row.name for name, row in plan.rows.items()}
    sheets = write_sheets(plan.out / "images", plan.out / "sheets", names)
    curves = write_curves({part: plan.run(part) for part in plan.parts}, plan.out / "sheets" / "curves.png")
    text = results_page(plan, outcome, sheets, curves)
    return write_whole(plan.out / "RESULTS.md", lambda path: path.write_text(text, encoding="utf-8"))


def records(plan: Plan, outcome: Outcome) -> list[dict[str, Any]]:
    """Every value of every row, ready for CSV."""
    return [
        {"row": name, "approach": plan.rows[name].name, **one}
        for name, result in outcome.results.items()
        for one in result["results"][0]["values"]
    ]


def value_of(result: Mapping[str, Any], name: str, sector: str = "camera") -> float:
    """A value of a row's result; NaN where it has none."""
    return _entry(result, name, sector).get("value", math.nan)


def _entry(result: Mapping[str, Any], name: str, sector: str) -> Mapping[str, Any]:
    """A value of a row's result with its interval; empty where it has none."""
    values = result["results"][0]["values"]
    wanted = (one for one in values if (one["sector"], one["name"]) == (sector, name) and one["value"] is not None)
    return next(wanted, {})


def results_page(plan: Plan, outcome: Outcome, sheets: Sequence[Path], curves: Path | None) -> str:
    """RESULTS.md as text."""
    parts = [
        _heading(plan, outcome),
        "## Segmentation (the paper's table 1, and table 3 of its supplement): IoU in percent\n\n"
        + _segments(plan, outcome),
        "## Images (the paper's table 2)\n\n" + _images(plan, outcome),
        "## Panorama\n\n" + _panorama(plan, outcome),
        "## The paper's orderings\n\n" + "\n".join(_claims(outcome)),
        "## Time\n\n" + _times(plan, outcome),
        "## Networks\n\n" + _networks(plan),
    ]
    if outcome.failures:
        parts.append("## Failed\n\n" + "\n".join(f"- {name}: {why}" for name, why in outcome.failures.items()))
    images = [f"![{path.stem}]({path.relative_to(plan.out).as_posix()})" for path in sheets]
    if curves:
        images.append(f"![training curves]({curves.relative_to(plan.out).as_posix()})")
    if images:
        parts.append("## Images of the split\n\n" + "\n\n".join(images))
    return "\n\n".join(parts) + "\n"


def _heading(plan: Plan, outcome: Outcome) -> str:
    most = max(outcome.results.values(), key=lambda one: len(one["classes"]), default=None)  # some have no classes
    scored = most["heading"] if most else "Nothing could be scored."
    form = "-mini recipes" if plan.mini else "the paper's recipes"
    allowed = f"{plan.budget} of training per network" if plan.budget else "the recipes' own budgets"
    return (
        f"# Results\n\nWritten by `lidar2pano reproduce`; not edited by hand. Commit {commit()}, {form}, {allowed}, "
        f"device {plan.device}.\n\n{scored}"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _segments(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        if not row.segments:
            continue
        result = outcome.results.get(name)
        found = {} if result is None else {one["class"]: one["iou"] for one in result["results"][0]["classes"]}
        ious = [_percent(found.get(each)) for each in CLASSES]
        ours = math.nan if result is None else 100 * value_of(result, "miou")
        rows.append([row.name, *ious, f"**{_cell(ours, 1)}**"])
        if row.miou is not None:
            rows.append([f"{row.name}: paper", *(f"{value:g}" for value in row.classes), f"{row.miou:g}"])
    return _table(["approach", *CLASSES, "mIoU"], rows)


def _percent(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{100 * value:.1f}"


def _images(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        result = outcome.results.get(name)
        values = {key: math.nan if result is None else value_of(result, key) for key in IMAGE_METRICS}
        rows.append([row.name, *(_cell(values[key], 4 if key == "ssim" else 2) for key in IMAGE_METRICS)])
        if row.paper:
            theirs = (f"{row.paper[key]:g}" if key in row.paper else "-" for key in IMAGE_METRICS)
            rows.append([f"{row.name}: paper", *theirs])
    note = (
        ""
        if any(_has(outcome, "fid"))
        else "\n\nFID: no Inception weights were given (`--inception FILE`), so there is none."
    )
    return _table(["approach", *IMAGE_METRICS.values()], rows) + SWD_NOTE + note


def _has(outcome: Outcome, name: str) -> Iterable[bool]:
    return (not math.isnan(value_of(result, name)) for result in outcome.results.values())


def _panorama(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        result = outcome.results.get(name)
        values = [math.nan if result is None else value_of(result, key, "panorama") for key in PANORAMA_METRICS]
        if not all(map(math.isnan, values)):
            rows.append([row.name, *(_cell(value, 3) for value in values)])
    if not rows:
        return "No row has panorama metrics on this data."
    return _table(["approach", *PANORAMA_METRICS.values()], rows)


def _claims(outcome: Outcome) -> Iterable[str]:
    return (f"- {claim.text}: {_verdict(claim, outcome)}." for claim in CLAIMS)


def _verdict(claim: Claim, outcome: Outcome) -> str:
    results = [outcome.results.get(name) for name in (claim.first, claim.second)]
    pair = [{} if one is None else _entry(one, claim.metric, "camera") for one in results]
    if not all(pair):
        return "not measured here"
    first, second = (one["value"] for one in pair)
    numbers = f"({first:.4g} against {second:.4g})"
    if reason := _undecided(pair, min(_steps(one, claim.metric) for one in results if one is not None)):
        return f"**not decided** here: {reason} {numbers}"
    better = first > second if claim.higher else first < second
    return f"**{'confirmed' if better else 'contradicted'}** here {numbers}"


def _undecided(pair: Sequence[Mapping[str, Any]], steps: int) -> str:
    """Why two values decide nothing; "" where they do."""
    if steps < LEAST_STEPS:
        return f"{steps} steps of training are fewer than {LEAST_STEPS}"
    frames = min(one.get("frames", 0) for one in pair)
    if frames < LEAST_FRAMES:
        return f"{frames} frames are fewer than {LEAST_FRAMES}"
    ends = [one[end] for one in pair for end in ("low", "high") if one.get(end) is not None]
    if len(ends) < 4:
        return "there are no intervals"
    low, high, other_low, other_high = ends
    return "the 95 % intervals overlap" if low <= other_high and other_low <= high else ""


def _steps(result: Mapping[str, Any], metric: str) -> int:
    """Steps of the row's least trained network beside the LiDAR segmenter, of those on which the metric depends."""
    networks = result["results"][0].get("networks", {})
    others = {"segmenter", "painter"} if metric == "miou" else {"segmenter"}
    return min((card.get("steps", 0) for role, card in networks.items() if role not in others), default=0)


def _times(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        if name in outcome.results:
            stages = outcome.results[name]["results"][0]["milliseconds"]
            stages_text = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
            rows.append([row.name, stages_text, f"{sum(stages.values()):.0f}"])
    if outcome.camera_segmenter_ms is not None:
        taken = f"{outcome.camera_segmenter_ms:.0f}"
        rows.append(["SD-Net (in training only)", f"segment an image {taken}", taken])
    theirs = ", ".join(f"{name} {value:g}" for name, value in PAPER_TIMES.items())
    return (
        _table(["approach", "milliseconds per stage", "sum"], rows)
        + f"\n\nThe paper, on a Quadro RTX 6000, for the front view alone: {theirs}."
    )


def _networks(plan: Plan) -> str:
    rows = []
    for part in ([SEGMENTER] if plan.segmenter else []) + plan.parts:
        for role, file in _files(plan.weights(part)).items():
            card = read_card(file)
            if part != SEGMENTER or role == "segmenter":
                entries = [part, card.recipe, card.data, str(card.steps), f"{60 * card.hours:.1f}", card.device]
                rows.append([*entries, card.commit[:12], card.sha256[:12]])
    return _table(["network", "recipe", "data", "steps", "minutes", "device", "commit", "sha256"], rows)


def _files(weights: str) -> Mapping[str, Path]:
    """Weight files by role; none of a run that failed."""
    try:
        return weight_files(weights, fill=False)
    except InputError:
        return {}


# --- training curves ------------------------------------------------------------------------------------------------


def scalars(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Tag -> (step, value) of a run's TensorBoard files; empty where it has none."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = run / "tensorboard"
    if not folder.is_dir():
        return {}
    logging.getLogger("tensorboard").setLevel(logging.WARNING)  # it logs every file that it has read to its end
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
    """Losses (rates and validation have a slash in their names) with two points or more."""
    return {tag: points for tag, points in found.items() if len(points) > 1 and "/" not in tag}
