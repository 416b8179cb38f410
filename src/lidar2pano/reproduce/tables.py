"""RESULTS.md of a reproduction: the paper's tables, its figures beside ours, and what that says of its orderings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError
from lidar2pano.evaluate.weights import named_files
from lidar2pano.labels import COMMON14
from lidar2pano.models.card import read_card
from lidar2pano.reproduce.plan import SEGMENTER, Plan
from lidar2pano.reproduce.rows import CLAIMS, LEVELS, PAPER_TIMES, Claim
from lidar2pano.reproduce.run import Outcome
from lidar2pano.train.checkpoint import commit

CLASSES = COMMON14.classes[1:]
PICTURES = {"ssim": "SSIM", "fid": "FID", **{f"swd_{level}": f"SWD {level}" for level in LEVELS}, "swd": "SWD mean"}
AROUND = {
    "miou": "mIoU",
    "ssim": "SSIM",
    "swd": "SWD mean",
    "depth_abs_rel": "depth AbsRel",
    "depth_rmse_m": "depth RMSE, m",
    "seam_ratio": "seam ratio",
    "seam_ratio_nearby": "seam ratio nearby",
    "warping_error": "warping error",
}


def figure(result: Mapping[str, Any], name: str, sector: str = "camera") -> float:
    """A figure of a row's result; NaN where it has none."""
    for one in result["results"][0]["figures"]:
        if one["sector"] == sector and one["name"] == name and one["value"] is not None:
            return one["value"]
    return math.nan


def report(plan: Plan, outcome: Outcome, sheets: Sequence[Path], curves: Path | None) -> str:
    """RESULTS.md as text."""
    parts = [
        _heading(plan, outcome),
        "## Segments (the paper's table 1, and table 3 of its supplement): IoU in percent\n\n"
        + _segments(plan, outcome),
        "## Pictures (the paper's table 2)\n\n" + _pictures(plan, outcome),
        "## All around\n\n" + _around(plan, outcome),
        "## The paper's orderings\n\n" + "\n".join(_claims(outcome)),
        "## Time\n\n" + _times(plan, outcome),
        "## Networks\n\n" + _networks(plan),
    ]
    if outcome.failures:
        parts.append("## Failed\n\n" + "\n".join(f"- {name}: {why}" for name, why in outcome.failures.items()))
    pictures = [f"![{path.stem}]({path.relative_to(plan.out).as_posix()})" for path in sheets]
    if curves:
        pictures.append(f"![training curves]({curves.relative_to(plan.out).as_posix()})")
    if pictures:
        parts.append("## Pictures of the split\n\n" + "\n\n".join(pictures))
    return "\n\n".join(parts) + "\n"


def _heading(plan: Plan, outcome: Outcome) -> str:
    most = max(outcome.results.values(), key=lambda one: len(one["classes"]), default=None)  # some have no classes
    scored = most["heading"] if most else "Nothing could be scored."
    form = "-mini recipes" if plan.mini else "the paper's recipes"
    allowed = f"{plan.budget} of training per network" if plan.budget else "the recipes' own budgets"
    return (
        f"# Results\n\nWritten by `lidar2pano reproduce`; nothing here is typed. Commit {commit()}, {form}, {allowed}, "
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
        ours = math.nan if result is None else 100 * figure(result, "miou")
        rows.append([row.name, *ious, f"**{_cell(ours, 1)}**"])
        if row.miou is not None:
            rows.append([f"{row.name}: paper", *(f"{value:g}" for value in row.classes), f"{row.miou:g}"])
    return _table(["approach", *CLASSES, "mIoU"], rows)


def _percent(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{100 * value:.1f}"


def _pictures(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        result = outcome.results.get(name)
        values = {key: math.nan if result is None else figure(result, key) for key in PICTURES}
        rows.append([row.name, *(_cell(values[key], 4 if key == "ssim" else 2) for key in PICTURES)])
        if row.paper:
            rows.append([f"{row.name}: paper", *(f"{row.paper[key]:g}" for key in PICTURES)])
    note = (
        ""
        if any(_has(outcome, "fid"))
        else "\n\nFID: no Inception weights were given (`--inception FILE`), so there is none."
    )
    return _table(["approach", *PICTURES.values()], rows) + note


def _has(outcome: Outcome, name: str) -> Iterable[bool]:
    return (not math.isnan(figure(result, name)) for result in outcome.results.values())


def _around(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        result = outcome.results.get(name)
        values = [math.nan if result is None else figure(result, key, "panorama") for key in AROUND]
        if not all(map(math.isnan, values)):
            rows.append([row.name, *(_cell(value, 3) for value in values)])
    if not rows:
        return "No row makes panorama figures on this data."
    return _table(["approach", *AROUND.values()], rows)


def _claims(outcome: Outcome) -> Iterable[str]:
    return (f"- {claim.says}: {_judged(claim, outcome)}." for claim in CLAIMS)


def _judged(claim: Claim, outcome: Outcome) -> str:
    pair = [outcome.results.get(name) for name in (claim.first, claim.second)]
    values = [math.nan if one is None else figure(one, claim.figure) for one in pair]
    if any(map(math.isnan, values)):
        return "not measured here"
    better = values[0] > values[1] if claim.higher else values[0] < values[1]
    return f"**{'confirmed' if better else 'contradicted'}** here ({values[0]:.4g} against {values[1]:.4g})"


def _times(plan: Plan, outcome: Outcome) -> str:
    rows = []
    for name, row in plan.rows.items():
        if name in outcome.results:
            stages = outcome.results[name]["results"][0]["milliseconds"]
            spoken = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
            rows.append([row.name, spoken, f"{sum(stages.values()):.0f}"])
    theirs = ", ".join(f"{name} {value:g}" for name, value in PAPER_TIMES.items())
    return (
        _table(["approach", "milliseconds per stage", "sum"], rows)
        + f"\n\nThe paper's, on a Quadro RTX 6000, for the front view alone: {theirs}."
    )


def _networks(plan: Plan) -> str:
    rows = []
    for part in ([SEGMENTER] if plan.segmenter else []) + plan.parts:
        for role, file in named_files(plan.weights(part)).items() if _there(plan.weights(part)) else ():
            card = read_card(file)
            if part != SEGMENTER or role == "segmenter":
                made = [part, card.recipe, card.data, str(card.steps), f"{60 * card.hours:.1f}", card.device]
                rows.append([*made, card.commit[:12], card.sha256[:12]])
    return _table(["network", "recipe", "data", "steps", "minutes", "device", "commit", "sha256"], rows)


def _there(weights: str) -> bool:
    """Whether there are weights, and not only a run that failed."""
    try:
        return bool(named_files(weights))
    except InputError:
        return False
