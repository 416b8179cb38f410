"""An evaluation as Markdown, as rows for CSV and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from lidar2pano.evaluate.evaluation import EvaluatedSystem, Evaluation
from lidar2pano.evaluate.metric_values import SECTOR_ORDER, SWD_LEVELS, UNSCORED, MetricCollection, MetricValue
from lidar2pano.labels import COMMON15

Values = Mapping[tuple[str, str], MetricValue]
# role -> (sector, value) -> name in "score", which cards of released weights take over
CARD_SCORES = {
    "segmenter": {("points", "miou"): "point_miou", ("points", "accuracy"): "point_accuracy"},
    "translator": {
        ("camera", "miou"): "camera_miou",
        ("camera", "accuracy"): "camera_accuracy",
        ("panorama", "miou"): "panorama_miou",
        ("panorama", "accuracy"): "panorama_accuracy",
        ("panorama", "depth_abs_rel"): "panorama_depth_abs_rel",
    },
    "painter": {
        (sector, name): f"{sector}_{name}"
        for sector in ("camera", "panorama")
        for name in ("ssim", "swd", "fid", "fsd", "resegmentation_miou", "warping_error")
    },
}


class Row(NamedTuple):
    """Format of a value's row: title, decimals, factor, and whether the interval is shown."""

    title: str
    decimals: int = 3
    times: float = 1.0
    interval: bool = False


ROWS: dict[str, Row] = {
    "accuracy": Row("accuracy", interval=True),
    "miou_published": Row("mIoU as the published code counts it (predictions of unlabeled left out)", interval=True),
    "ssim": Row("SSIM", interval=True),
    "swd_pairs": Row("SWD of image pairs, as the paper prints it", 2, interval=True),
    "swd": Row("SWD x 1000 (Karras et al.)", 1, interval=True),
    "patch_frechet_ratio": Row("patch Frechet / real-to-real", 2, interval=True),
    "patch_frechet": Row("patch Frechet distance", 3),
    "patch_frechet_real": Row("patch Frechet, real-to-real", 3),
    "fid": Row("FID", 1, interval=True),
    "fsd": Row("FSD", 1, interval=True),
    "resegmentation_miou": Row("re-segmentation mIoU", interval=True),
    "depth_abs_rel": Row("depth AbsRel", interval=True),
    "depth_rmse_m": Row("depth RMSE, m", 2),
    "warping_error": Row("warping error x 1000", 2, 1000.0, interval=True),
    "seam_ratio": Row("seam ratio", interval=True),
    "seam_ratio_nearby": Row("seam ratio nearby", interval=True),
    "roll_error": Row("roll error, grey levels", 2),
    "roll_error_ids": Row("roll error, share of classes", 4),
}
PREFIX = {"camera": "", "panorama": "panorama: "}


def heading(one: Evaluation) -> str:
    """Describe the data, the metrics and the limits of an evaluation."""
    values = [by_name(one.values(each.metrics)) for each in one.systems]
    present = one.target_classes() or ([] if one.images else one.target_classes("panorama"))
    missing = [name for c, name in enumerate(COMMON15.classes) if c not in (*present, *UNSCORED)]
    absent = f" (absent: {', '.join(missing)})" if missing else ""
    parts = [
        f"`{one.split}` of {one.data}: {max(one.images, one.camera_images)} camera images, each scored as a whole at"
        f" its own size, predicted from the scan alone; {one.scans} scans with point labels. Pixels whose target is"
        f" unlabeled, sky or unknown are not scored; predictions of unlabeled or sky count as wrong."
    ]
    if pseudo := [f"{part} of {n} frames by {name[:8]}" for (part, name), n in sorted(one.pseudo_labels.items())]:
        parts.append(f"**Pseudo-labels of networks, not ground truth: {', '.join(pseudo)}.**")
    if present:
        parts.append(f"mIoU: mean over the {len(present)} of the paper's 14 classes that occur{absent}.")
    names = {name for each in values for _, name in each}
    if names & {"ssim", "swd"}:
        parts.append(f"Colours: against the camera's images ({one.camera_images}), resized to 1024 x 1024 for SWD.")
    if one.panoramas:
        parts.append(
            f"Panorama: against ground-truth panoramas ({one.panoramas}), on their raster, where they are valid; "
            "SWD in quarters."
        )
    if any(not math.isnan(value.low) for each in values for value in each.values()):
        parts.append("In brackets: 95 % interval, by the bootstrap over frames (distances of sets: by the jackknife).")
    if chosen := [each.system.info.name for each in one.systems if _selected_here(one, each)]:
        parts.append(f"**Weights were selected on this split, so its scores flatter them: {', '.join(chosen)}.**")
    if oracles := [each.system.info.name for each in one.systems if each.system.uses_ground_truth]:
        parts.append(f"Input is the camera's ground-truth labels, not the scan: {', '.join(oracles)}.")
    if steady := [each.system.info.name for each in one.systems if getattr(each.system, "steady", False)]:
        parts.append(f"Input is the sensor's pose beside the scan: {', '.join(steady)}.")
    return " ".join(parts)


def _selected_here(one: Evaluation, each: EvaluatedSystem) -> bool:
    """Whether the best of a network's checkpoints was selected on the split that is scored."""
    cards = each.system.info.networks.values()
    return any(
        one.split in str(card.get("split", "")).split(" + ") and one.data in str(card.get("data", "")).split("+")
        for card in cards
    )


def table(one: Evaluation) -> str:
    """Markdown: the heading, then a column per system."""
    names = [each.system.info.name for each in one.systems]
    head = ["class", "pixels", *names]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    values = [by_name(one.values(each.metrics)) for each in one.systems]
    reference = by_name(one.values(one.reference))
    for sector, prefix in PREFIX.items():
        rows += _class_rows(one, sector, prefix, values)
        rows += _value_rows(one, sector, prefix, values, reference)
    rows += _point_rows(one, values)
    times = [each.mean_milliseconds() for each in one.systems]
    for stage in dict.fromkeys(stage for time in times for stage in time):
        cells = [f"{time[stage]:.0f}" if stage in time else "-" for time in times]
        rows.append([f"{stage.replace('_', ' ')}, ms", "", *cells])
    rows += _network_rows(one)
    return "\n".join([heading(one), "", *(f"| {' | '.join(row)} |" for row in rows)])


def records(one: Evaluation) -> list[dict[str, Any]]:
    """One row per system and value, with IoU of classes and milliseconds; the reference is system "ground truth"."""
    rows: list[dict[str, Any]] = []

    def add(system: str, value: MetricValue) -> None:
        plain = _plain(value)
        rows.append({"system": system, "sector": plain.pop("sector"), "metric": plain.pop("name"), **plain})

    for each in one.systems:
        name = each.system.info.name
        for value in (*one.values(each.metrics), *_class_values(each.metrics)):
            add(name, value)
        for stage, mean in each.mean_milliseconds().items():
            frames = len(each.milliseconds[stage])
            add(name, MetricValue(sector="milliseconds", name=stage, value=mean, frames=frames))
    for value in one.values(one.reference):
        add("ground truth", value)
    return rows


def as_dict(one: Evaluation) -> dict[str, Any]:
    """Everything, ready for JSON; undefined values are None or left out."""
    config = one.config
    values = [one.values(each.metrics) for each in one.systems]
    return {
        "data": one.data,
        "split": one.split,
        "images": one.images,
        "scans": one.scans,
        "camera_images": one.camera_images,
        "panoramas": one.panoramas,
        "pseudo_labels": [
            {"part": part, "made_by": name, "frames": count} for (part, name), count in one.pseudo_labels.items()
        ],
        "metrics": list(config.groups),
        "sectors": list(config.sectors),
        "inception": config.inception.sha256 if config.inception else None,
        "camera_segmenter": config.image_segmenter.sha256 if config.image_segmenter else None,
        "classes": [COMMON15.classes[c] for c in one.target_classes()],
        "panorama_classes": [COMMON15.classes[c] for c in one.target_classes("panorama")],
        "heading": heading(one),
        "results": [_result(one, each, found) for each, found in zip(one.systems, values, strict=True)],
        "ground_truth": [_plain(value) for value in one.values(one.reference)],
    }


def _result(one: Evaluation, each: EvaluatedSystem, found: list[MetricValue]) -> dict[str, Any]:
    values = {key: value.value for key, value in by_name(found).items()}
    scores = {
        role: {name: values[key] for key, name in wanted.items() if not math.isnan(values.get(key, math.nan))}
        for role, wanted in CARD_SCORES.items()
    }
    scores["renderer"] = scores["painter"]
    networks = each.system.info.networks
    scored = {"segmenter", "translator", *(networks.keys() & scores.keys())}
    result = {
        "weights": each.system.info.name,
        "networks": {role: dict(card) for role, card in networks.items()},
        "score": {role: part | {"split": one.split} for role, part in scores.items() if role in scored},
        "milliseconds": {stage: round(value, 2) for stage, value in each.mean_milliseconds().items()},
        "values": [_plain(value) for value in found],
        "worst": [{"frame": name, "metric": metric, "value": value} for name, metric, value in each.worst.rows()],
    }
    for sector, name in (("camera", "classes"), ("points", "point_classes"), ("panorama", "panorama_classes")):
        counts = each.metrics.classes(sector)
        result[name] = [] if counts is None else counts.confusion().table()
    return result


def _class_rows(one: Evaluation, sector: str, prefix: str, values: Iterable[Values]) -> list[list[str]]:
    """A row per class, and their mean."""
    present = one.target_classes(sector)
    counts = [each.metrics.classes(sector) for each in one.systems]
    tables = [None if each is None else each.confusion() for each in counts]
    first = next((each for each in tables if each is not None), None)
    if first is None or not present:
        return []
    targets = first.counts.sum(1)
    ious = [None if each is None else each.iou() for each in tables]
    rows = []
    for c in present:
        cells = ["-" if iou is None else _number(float(iou[c]), Row("")) for iou in ious]
        rows.append([prefix + COMMON15.classes[c], f"{targets[c] / targets.sum():.1%}", *cells])
    cells = []
    for each in values:
        value = each.get((sector, "miou"))
        cells.append("-" if value is None else f"**{_number(value.value, Row(''))}**{_between(value, Row(''))}")
    pseudo = _pseudo(one, "camera labels") if sector == "camera" else ""
    rows.append([f"{prefix}**mIoU of {len(present)}**{pseudo}", "", *cells])
    return rows


def _pseudo(one: Evaluation, part: str) -> str:
    """Says in a row's title that the labels are predictions, and of which networks."""
    names = sorted({name[:8] for which, name in one.pseudo_labels if which == part})
    return f" (pseudo-labels by {', '.join(names)})" if names else ""


def _value_rows(one: Evaluation, sector: str, prefix: str, values: list[Values], reference: Values) -> list[list[str]]:
    """A row per value that some system has."""
    rows = []
    for name, row in ROWS.items():
        key = (sector, name)
        if key == ("camera", "fid") and one.config.inception is None:
            if any((sector, "swd") in each for each in values):
                cells = ["no Inception weights" if (sector, "swd") in each else "-" for each in values]
                rows.append([row.title, "", *cells])
            continue
        if not any(key in each for each in values):
            continue
        segmenter, title = one.config.image_segmenter, row.title
        if name == "fsd" and segmenter is not None:
            title = f"{title} (features of {segmenter.sha256[:8]})"
        own = f"ground truth {_number(reference[key].value, row)}" if key in reference else ""
        rows.append([prefix + title, own, *(_cell(each.get(key), row) for each in values)])
        if name == "swd":
            levels = " ".join(level.removeprefix("swd_") for level in SWD_LEVELS)
            cells = [
                " ".join(_cell(each.get((sector, level)), row) for level in SWD_LEVELS) if key in each else "-"
                for each in values
            ]
            rows.append([f"{prefix}SWD x 1000 by level, {levels}", "", *cells])
    return rows


def _point_rows(one: Evaluation, values: list[Values]) -> list[list[str]]:
    if not any(("points", "miou") in each for each in values):
        return []
    present = len(one.target_classes("points"))
    mious = (_cell(each.get(("points", "miou")), Row("", interval=True)) for each in values)
    return [
        [f"points: mIoU of {present} SemanticKITTI classes{_pseudo(one, 'point labels')}", "", *mious],
        ["points: accuracy", "", *(_cell(each.get(("points", "accuracy")), ROWS["accuracy"]) for each in values)],
    ]


def _network_rows(one: Evaluation) -> list[list[str]]:
    """Recipe and commit of each system's networks, by their cards."""
    rows = []
    networks = [each.system.info.networks for each in one.systems]
    for role in dict.fromkeys(role for each in networks for role in each):
        cards = [each.get(role) for each in networks]
        training = [
            "-"
            if card is None
            else f"{card.get('recipe') or '?'}, {card.get('steps', 0)} steps, {card.get('hours', 0)} h"
            for card in cards
        ]
        rows.append([f"{role}: recipe", "", *training])
        rows.append([f"{role}: commit", "", *("-" if c is None else c.get("commit", "")[:12] or "?" for c in cards)])
    return rows


def _class_values(metrics: MetricCollection) -> Iterable[MetricValue]:
    for sector in SECTOR_ORDER:
        counts = metrics.classes(sector)
        if counts is None:
            continue
        whole = counts.confusion()
        for c in metrics.target_classes(sector) or ():
            iou = float(whole.iou()[c])
            yield MetricValue(sector=sector, name=f"iou {whole.names[c]}", value=iou, frames=len(counts))


def by_name(values: Iterable[MetricValue]) -> Values:
    """Values by sector and name."""
    return {(value.sector, value.name): value for value in values}


def _cell(value: MetricValue | None, row: Row) -> str:
    return "-" if value is None else _number(value.value, row) + (_between(value, row) if row.interval else "")


def _number(value: float, row: Row) -> str:
    return "-" if math.isnan(value) else f"{value * row.times:.{row.decimals}f}"


def _between(value: MetricValue, row: Row) -> str:
    if math.isnan(value.low):
        return ""
    return f" ({_number(value.low, row)} to {_number(value.high, row)})"


def _plain(value: MetricValue) -> dict[str, Any]:
    numbers = {name: _finite(getattr(value, name)) for name in ("value", "low", "high")}
    return {"sector": value.sector, "name": value.name, **numbers, "frames": value.frames}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
