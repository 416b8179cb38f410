"""RESULTS.md of a reproduction: the paper's tables, its values beside ours, its orderings, and training curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidar2pano import __version__
from lidar2pano.errors import InputError
from lidar2pano.evaluate.report import by_name, number_cell, value_of
from lidar2pano.formats.image_files import write_text
from lidar2pano.labels import COMMON14
from lidar2pano.markdown import markdown_table
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.reproduce.images import write_curves, write_sheets
from lidar2pano.reproduce.paper_tables import CLAIMS, LEVELS, PAPER_TIMES, Claim
from lidar2pano.reproduce.run import SEGMENTER, Outcome, Plan
from lidar2pano.train.checkpoint import commit

CLASSES = COMMON14.classes[1:]
LEAST_STEPS, LEAST_FRAMES = 1000, 50  # of training, and of scoring: an ordering on fewer is not decided
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
FID_NOTE = "\n\nFID: no Inception weights were given (`--inception FILE`), so there is none."
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
    return write_text(plan.out / "RESULTS.md", text)


def records(plan: Plan, outcome: Outcome) -> list[dict[str, Any]]:
    """Return every value of every row, ready for CSV."""
    return [
        {"row": name, "approach": plan.rows[name].name, **entry}
        for name, result in outcome.results.items()
        for entry in result["results"][0]["values"]
    ]


def results_page(plan: Plan, outcome: Outcome, sheets: Sequence[Path], curves: Path | None) -> str:
    """Return RESULTS.md as text."""
    parts = [
        _heading(plan, outcome),
        "## Segmentation (the paper's table 1, and table 3 of its supplement): IoU in percent\n\n"
        + _segments(plan, outcome),
        "## Images (the paper's table 2)\n\n" + _images(plan, outcome),
        "## Panorama\n\n" + _panorama(plan, outcome),
        "## The paper's orderings\n\n" + "\n".join(f"- {claim.text}: {_verdict(claim, outcome)}." for claim in CLAIMS),
        "## Time\n\n" + _times(plan, outcome),
        "## Networks\n\n" + _networks(plan),
    ]
    if outcome.failures:
        failures = "\n".join(f"- {name}: {reason}" for name, reason in outcome.failures.items())
        parts.append(f"## Failed\n\n{failures}")
    paths = {path.stem: path for path in sheets} | ({"training curves": curves} if curves else {})
    if paths:
        images = (f"![{title}]({path.relative_to(plan.out).as_posix()})" for title, path in paths.items())
        parts.append("## Images of the split\n\n" + "\n\n".join(images))
    return "\n\n".join(parts) + "\n"


def _values(outcome: Outcome, name: str) -> Mapping[tuple[str, str], Mapping[str, Any]]:
    """Return the values of a row by sector and name; empty if the row was not scored."""
    return by_name(outcome.results[name]["results"][0]["values"]) if name in outcome.results else {}


def _heading(plan: Plan, outcome: Outcome) -> str:
    # rows without classes say less of the data
    fullest = max(outcome.results.values(), key=lambda result: len(result["classes"]), default=None)
    scored = fullest["heading"] if fullest else "Nothing could be scored."
    form = "-mini recipes" if plan.mini else "the paper's recipes"
    allowed = f"--budget {plan.budget} for each network" if plan.budget else "the recipes' own budgets"
    allowed += "".join(f", {change}" for change in plan.changes)
    program = f"Version {__version__}" if commit() == __version__ else f"Commit {commit()}"
    return (
        f"# Results\n\nWritten by `lidar2pano reproduce`; not edited by hand. {program}, {form}, {allowed}, "
        f"device {plan.device}.\n\n{scored}"
    )


def _segments(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        if not row.segments:
            continue
        result = outcome.results.get(name)
        ious = {entry["class"]: entry["iou"] for entry in (result["results"][0]["classes"] if result else ())}
        mean = value_of(_values(outcome, name), "camera", "miou")
        rows.append([row.name, *(_percent(ious.get(label)) for label in CLASSES), f"**{_percent(mean)}**"])
        if row.miou is not None:
            theirs = [f"{value:g}" for value in row.classes] or ["-"] * len(CLASSES)
            rows.append([f"{row.name}: published", *theirs, f"{row.miou:g}"])
    return markdown_table(["approach", *CLASSES, "mIoU"], rows)


def _percent(share: float | None) -> str:
    return number_cell(None if share is None else 100 * share, 1)


def _images(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        values = _values(outcome, name)
        digits = {key: 4 if key == "ssim" else 2 for key in IMAGE_METRICS}
        rows.append([row.name, *(number_cell(value_of(values, "camera", key), digits[key]) for key in IMAGE_METRICS)])
        if row.paper:
            theirs = (f"{row.paper[key]:g}" if key in row.paper else "-" for key in IMAGE_METRICS)
            rows.append([f"{row.name}: published", *theirs])
    measured = any(value_of(_values(outcome, name), "camera", "fid") is not None for name in plan.rows)
    return markdown_table(["approach", *IMAGE_METRICS.values()], rows) + SWD_NOTE + ("" if measured else FID_NOTE)


def _panorama(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        values = [value_of(_values(outcome, name), "panorama", key) for key in PANORAMA_METRICS]
        if any(value is not None for value in values):
            rows.append([row.name, *map(number_cell, values)])
    if not rows:
        return "No row has panorama metrics on this data."
    return markdown_table(["approach", *PANORAMA_METRICS.values()], rows)


def _verdict(claim: Claim, outcome: Outcome) -> str:
    pair = [_values(outcome, name).get(("camera", claim.metric)) for name in (claim.first, claim.second)]
    entries = [entry for entry in pair if entry is not None and entry["value"] is not None]
    if len(entries) < 2:
        return "not measured here"
    first, second = (entry["value"] for entry in entries)
    numbers = f"({first:.4g} against {second:.4g})"
    steps = min(_steps(outcome.results[name], claim.metric) for name in (claim.first, claim.second))
    if reason := _doubt(entries, steps):
        return f"**not decided** here: {reason} {numbers}"
    better = first > second if claim.higher else first < second
    return f"**{'confirmed' if better else 'contradicted'}** here {numbers}"


def _doubt(pair: Sequence[Mapping[str, Any]], steps: int) -> str:
    """Return the reason for two values to decide nothing; "" if they do."""
    if steps < LEAST_STEPS:
        return f"{steps} steps of training are fewer than {LEAST_STEPS}"
    frames = min(entry.get("frames", 0) for entry in pair)
    if frames < LEAST_FRAMES:
        return f"{frames} frames are fewer than {LEAST_FRAMES}"
    ends = [entry[end] for entry in pair for end in ("low", "high") if entry.get(end) is not None]
    if len(ends) < 4:
        return "there are no intervals"
    low, high, other_low, other_high = ends
    return "the 95 % intervals overlap" if low <= other_high and other_low <= high else ""


def _steps(result: Mapping[str, Any], metric: str) -> int:
    """Return the steps of the row's least trained network of those that the metric depends on, but the segmenter."""
    networks = result["results"][0].get("networks", {})
    left_out = {"segmenter", "painter"} if metric == "miou" else {"segmenter"}
    return min((card.get("steps", 0) for role, card in networks.items() if role not in left_out), default=0)


def _times(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        if name in outcome.results:
            stages = outcome.results[name]["results"][0]["milliseconds"]
            stages_text = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
            rows.append([row.name, stages_text, f"{sum(stages.values()):.0f}"])
    if outcome.camera_segmenter_ms is not None:
        duration = f"{outcome.camera_segmenter_ms:.0f}"
        rows.append(["SD-Net (in training only)", f"segment an image {duration}", duration])
    theirs = ", ".join(f"{name} {value:g}" for name, value in PAPER_TIMES.items())
    return (
        markdown_table(["approach", "milliseconds per stage", "sum"], rows)
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
    return markdown_table(["network", "recipe", "data", "steps", "minutes", "device", "commit", "sha256"], rows)


def _files(weights: str) -> Mapping[str, Path]:
    """Return weight files by role; none of a run that failed."""
    try:
        return weight_files(weights, fill=False)
    except InputError:
        return {}
