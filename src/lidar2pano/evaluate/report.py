"""What was counted, as Markdown, as rows for CSV and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from lidar2pano.evaluate.figures import NAMES, Figure, present
from lidar2pano.evaluate.tallies import UNSCORED, Tally
from lidar2pano.labels import COMMON15

if TYPE_CHECKING:
    from lidar2pano.evaluate.contenders import Contender
    from lidar2pano.evaluate.evaluation import Evaluation

Found = Mapping[tuple[str, str], Figure]
LEVELS = tuple(name for name in NAMES["swd"].values() if name != "swd")
# role -> sector, figure -> name in `score`, which cards take over
ROLES = {
    "segmenter": {("points", "miou"): "point_miou", ("points", "accuracy"): "point_accuracy"},
    "translator": {
        ("camera", "miou"): "camera_miou",
        ("camera", "accuracy"): "camera_accuracy",
        ("panorama", "miou"): "panorama_miou",
        ("panorama", "accuracy"): "panorama_accuracy",
        ("panorama", "depth_abs_rel"): "panorama_depth_abs_rel",
    },
    "painter": {
        (sector, figure): f"{sector}_{figure}"
        for sector in ("camera", "panorama")
        for figure in ("ssim", "swd", "fid", "fsd", "resegmentation_miou", "warping_error")
    },
}


class Row(NamedTuple):
    """A figure's row: its title, how many decimals, by what it is multiplied, and whether its interval is shown."""

    title: str
    decimals: int = 3
    times: float = 1.0
    interval: bool = False


ROWS: dict[str, Row] = {
    "accuracy": Row("accuracy", interval=True),
    "ssim": Row("SSIM", interval=True),
    "swd": Row("SWD x 1000", 1),
    "patch_frechet_ratio": Row("patch Frechet / real-to-real", 2),
    "patch_frechet": Row("patch Frechet distance", 3),
    "patch_frechet_real": Row("patch Frechet, real-to-real", 3),
    "fid": Row("FID", 1),
    "fsd": Row("FSD", 1),
    "resegmentation_miou": Row("re-segmentation mIoU", interval=True),
    "depth_abs_rel": Row("depth AbsRel", interval=True),
    "depth_rmse_m": Row("depth RMSE, m", 2),
    "warping_error": Row("warping error x 1000", 2, 1000.0, interval=True),
    "seam_ratio": Row("seam ratio", interval=True),
    "seam_ratio_nearby": Row("seam ratio nearby", interval=True),
    "roll_error": Row("roll error, grey levels", 2),
    "roll_error_ids": Row("roll error, share of classes", 4),
}
PREFIX = {"camera": "", "panorama": "all around: "}


def heading(one: Evaluation) -> str:
    """What is scored and how."""
    return _heading(one, [_by_name(one.figures(each.tally)) for each in one.contenders])


def _heading(one: Evaluation, found: list[Found]) -> str:
    there = one.counted() or ([] if one.images else one.counted("panorama"))
    missing = [name for c, name in enumerate(COMMON15.classes) if c not in (*there, *UNSCORED)]
    absent = f" (absent: {', '.join(missing)})" if missing else ""
    parts = [
        f"`{one.split}` of {one.data}: {max(one.images, one.pictures)} camera images, all of each at its own size,"
        f" from the scan alone; {one.scans} scans with point labels. Pixels whose target is unlabeled, sky or unsure"
        f" are not scored; answers of unlabeled or sky count as wrong."
    ]
    if there:
        parts.append(f"mIoU: mean over the {len(there)} of the paper's 14 classes that occur{absent}.")
    names = {name for each in found for _, name in each}
    if names & {"ssim", "swd"}:
        parts.append(f"Colours: against the camera's pictures ({one.pictures}); SWD's are stretched to 1024 x 1024.")
    if one.panoramas:
        parts.append(
            f"All around: against true panoramas ({one.panoramas}), on their raster, where they are known; "
            "SWD in quarters."
        )
    if any(not math.isnan(figure.low) for each in found for figure in each.values()):
        parts.append("In brackets: 95 % of the bootstrap's resamples of frames.")
    if told := [each.system.origin.name for each in one.contenders if each.system.told]:
        parts.append(f"Told the camera's true classes, not the scan: {', '.join(told)}.")
    if steady := [each.system.origin.name for each in one.contenders if getattr(each.system, "steady", False)]:
        parts.append(f"Told the sensor's poses beside the scan: {', '.join(steady)}.")
    return " ".join(parts)


def table(one: Evaluation) -> str:
    """Markdown: the heading, then a column per system."""
    names = [each.system.origin.name for each in one.contenders]
    head = ["class", "pixels", *names]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    found = [_by_name(one.figures(each.tally)) for each in one.contenders]
    truth = _by_name(one.figures(one.reference))
    for sector, prefix in PREFIX.items():
        rows += _class_rows(one, sector, prefix, found)
        rows += _figure_rows(one, sector, prefix, found, truth)
    rows += _point_rows(one, found)
    times = [each.mean_milliseconds() for each in one.contenders]
    for stage in dict.fromkeys(stage for time in times for stage in time):
        cells = [f"{time[stage]:.0f}" if stage in time else "-" for time in times]
        rows.append([f"{stage.replace('_', ' ')}, ms", "", *cells])
    rows += _origin_rows(one)
    return "\n".join([_heading(one, found), "", *(f"| {' | '.join(row)} |" for row in rows)])


def records(one: Evaluation) -> list[dict[str, Any]]:
    """One row per system and figure; classes' IoU and milliseconds too; the truth's own figures are of "truth"."""
    rows: list[dict[str, Any]] = []

    def add(system: str, figure: Figure) -> None:
        numbers = {name: _finite(getattr(figure, name)) for name in ("value", "low", "high")}
        rows.append(
            {"system": system, "sector": figure.sector, "figure": figure.name, **numbers, "frames": figure.frames}
        )

    for each in one.contenders:
        name = each.system.origin.name
        for figure in (*one.figures(each.tally), *_class_figures(each.tally)):
            add(name, figure)
        for stage, value in each.mean_milliseconds().items():
            frames = len(each.milliseconds[stage])
            add(name, Figure(sector="milliseconds", name=stage, value=value, frames=frames))
    for figure in one.figures(one.reference):
        add("truth", figure)
    return rows


def as_dict(one: Evaluation) -> dict[str, Any]:
    """Everything, ready for JSON."""
    measures = one.measures
    found = [one.figures(each.tally) for each in one.contenders]
    return {
        "data": one.data,
        "split": one.split,
        "images": one.images,
        "scans": one.scans,
        "pictures": one.pictures,
        "panoramas": one.panoramas,
        "measures": list(measures.kinds),
        "sectors": list(measures.sectors),
        "inception": measures.inception.sha256 if measures.inception else None,
        "camera_segmenter": measures.eye.sha256 if measures.eye else None,
        "classes": [COMMON15.classes[c] for c in one.counted()],
        "panorama_classes": [COMMON15.classes[c] for c in one.counted("panorama")],
        "heading": _heading(one, [_by_name(each) for each in found]),
        "results": [_result(one, each, figures) for each, figures in zip(one.contenders, found, strict=True)],
        "truth": [_plain(figure) for figure in one.figures(one.reference)],
    }


def _result(one: Evaluation, each: Contender, found: list[Figure]) -> dict[str, Any]:
    values = {(figure.sector, figure.name): figure.value for figure in found}
    scores = {
        role: {name: values[key] for key, name in wanted.items() if not math.isnan(values.get(key, math.nan))}
        for role, wanted in ROLES.items()
    }
    scores["renderer"] = scores["painter"]
    made = {"segmenter", "translator", *(each.system.origin.networks.keys() & scores.keys())}
    result = {
        "weights": each.system.origin.name,
        "networks": {role: dict(card) for role, card in each.system.origin.networks.items()},
        "score": {role: part | {"split": one.split} for role, part in scores.items() if role in made},
        "milliseconds": {stage: round(value, 2) for stage, value in each.mean_milliseconds().items()},
        "figures": [_plain(figure) for figure in found],
        "worst": [{"frame": name, "figure": figure, "value": value} for name, figure, value in each.worst.rows()],
    }
    for sector, name in (("camera", "classes"), ("points", "point_classes"), ("panorama", "panorama_classes")):
        counts = each.tally.classes(sector)
        result[name] = [] if counts is None else counts.confusion().table()
    return result


def _class_rows(one: Evaluation, sector: str, prefix: str, found: Iterable[Found]) -> list[list[str]]:
    """A row per class, and their mean."""
    there = one.counted(sector)
    counts = [each.tally.classes(sector) for each in one.contenders]
    tables = [None if each is None else each.confusion() for each in counts]
    first = next((each for each in tables if each is not None), None)
    if first is None or not there:
        return []
    named = first.counts.sum(1)
    ious = [None if each is None else each.iou() for each in tables]
    rows = []
    for c in there:
        cells = ["-" if iou is None else _number(float(iou[c]), Row("")) for iou in ious]
        rows.append([prefix + COMMON15.classes[c], f"{named[c] / named.sum():.1%}", *cells])
    cells = []
    for each in found:
        figure = each.get((sector, "miou"))
        cells.append("-" if figure is None else f"**{_number(figure.value, Row(''))}**{_between(figure, Row(''))}")
    rows.append([f"{prefix}**mIoU of {len(there)}**", "", *cells])
    return rows


def _figure_rows(one: Evaluation, sector: str, prefix: str, found: list[Found], truth: Found) -> list[list[str]]:
    """A row per figure that some system has."""
    rows = []
    for name, row in ROWS.items():
        key = (sector, name)
        if key == ("camera", "fid") and one.measures.inception is None:
            if any((sector, "swd") in each for each in found):
                cells = ["no Inception weights" if (sector, "swd") in each else "-" for each in found]
                rows.append([row.title, "", *cells])
            continue
        if not any(key in each for each in found):
            continue
        eye = one.measures.eye
        title = f"{row.title} (features of {eye.sha256[:8]})" if name == "fsd" and eye is not None else row.title
        own = f"truth {_number(truth[key].value, row)}" if key in truth else ""
        rows.append([prefix + title, own, *(_cell(each.get(key), row) for each in found)])
        if name == "swd":
            levels = " ".join(level.removeprefix("swd_") for level in LEVELS)
            cells = [
                " ".join(_cell(each.get((sector, level)), row) for level in LEVELS) if key in each else "-"
                for each in found
            ]
            rows.append([f"{prefix}SWD x 1000 by level, {levels}", "", *cells])
    return rows


def _point_rows(one: Evaluation, found: list[Found]) -> list[list[str]]:
    if not any(("points", "miou") in each for each in found):
        return []
    there = len(one.counted("points"))
    mious = (_cell(each.get(("points", "miou")), Row("", interval=True)) for each in found)
    return [
        [f"points: mIoU of {there} SemanticKITTI classes", "", *mious],
        ["points: accuracy", "", *(_cell(each.get(("points", "accuracy")), ROWS["accuracy"]) for each in found)],
    ]


def _origin_rows(one: Evaluation) -> list[list[str]]:
    """Where each system's networks come from, by their cards."""
    rows = []
    networks = [each.system.origin.networks for each in one.contenders]
    for role in dict.fromkeys(role for each in networks for role in each):
        cards = [each.get(role) for each in networks]
        made = [
            "-"
            if card is None
            else f"{card.get('recipe') or '?'}, {card.get('steps', 0)} steps, {card.get('hours', 0)} h"
            for card in cards
        ]
        rows.append([f"{role}: recipe", "", *made])
        rows.append([f"{role}: commit", "", *("-" if c is None else c.get("commit", "")[:12] or "?" for c in cards)])
    return rows


def _class_figures(tally: Tally) -> Iterable[Figure]:
    for sector in ("camera", "panorama", "points"):
        counts = tally.classes(sector)
        if counts is None:
            continue
        whole, there = counts.confusion(), present(counts)
        for c in there:
            iou = float(whole.iou()[c])
            yield Figure(sector=sector, name=f"iou {whole.names[c]}", value=iou, frames=len(counts))


def _by_name(found: Iterable[Figure]) -> Found:
    return {(figure.sector, figure.name): figure for figure in found}


def _cell(figure: Figure | None, row: Row) -> str:
    return "-" if figure is None else _number(figure.value, row) + (_between(figure, row) if row.interval else "")


def _number(value: float, row: Row) -> str:
    return "-" if math.isnan(value) else f"{value * row.times:.{row.decimals}f}"


def _between(figure: Figure, row: Row) -> str:
    if math.isnan(figure.low):
        return ""
    return f" ({_number(figure.low, row)} to {_number(figure.high, row)})"


def _plain(figure: Figure) -> dict[str, Any]:
    numbers = {name: _finite(getattr(figure, name)) for name in ("value", "low", "high")}
    return {"sector": figure.sector, "name": figure.name, **numbers, "frames": figure.frames}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
