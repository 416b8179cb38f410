"""An evaluation as JSON, as rows for CSV and as Markdown; the last two are made from the first."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from lidar2pano.evaluate.evaluation import EvaluatedSystem, Evaluation
from lidar2pano.evaluate.metric_collection import ABSENT, LEADING, PANORAMA_NEED, SWD_LEVELS, UNSCORED, MetricValue
from lidar2pano.labels import COMMON15
from lidar2pano.markdown import markdown_table

Entry = Mapping[str, Any]  # of "values": sector, name, value, low, high, frames; None where undefined
Values = Mapping[tuple[str, str], Entry]  # by sector and name
# role -> values of sectors, of which cards of released weights take over SECTOR_VALUE as "score"
CARD_SCORES = {
    "segmenter": (("points", "miou accuracy"),),
    "translator": (("camera", "miou accuracy"), ("panorama", "miou accuracy depth_abs_rel")),
    "painter": tuple((s, "ssim swd fid fsd resegmentation_miou warping_error") for s in ("camera", "panorama")),
}
CLASS_TABLES = {"camera": "classes", "panorama": "panorama_classes", "points": "point_classes"}  # sector -> key


class Row(NamedTuple):
    """Format of a value's row: title, decimals, factor, and whether the interval is shown."""

    title: str
    decimals: int = 3
    factor: float = 1.0
    interval: bool = False


ROWS: dict[str, Row] = {
    "accuracy": Row("accuracy", interval=True),
    "miou_published": Row("mIoU as the published code counts it (predictions of unlabeled left out)", interval=True),
    "ssim": Row("SSIM", interval=True),
    "swd_pairs": Row("SWD of image pairs, as the paper prints it", 2, interval=True),
    "swd": Row("SWD x 1000 (Karras et al.)", 1, interval=True),
    "patch_frechet_ratio": Row("patch Frechet / real-to-real", 2, interval=True),
    "patch_frechet_halved_ratio": Row("patch Frechet / real-to-real, half size", 2, interval=True),
    "edge_frechet_ratio": Row("patch Frechet / real-to-real, edge features", 2, interval=True),
    "edge_frechet_halved_ratio": Row("patch Frechet / real-to-real, edge features, half size", 2, interval=True),
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
WITH_INTERVAL = Row("", interval=True)
PREFIX = {"camera": "", "panorama": "panorama: "}


# --- JSON -------------------------------------------------------------------------------------------------------------


def as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return everything, ready for JSON; undefined values are None or left out."""
    config = evaluation.config
    results = [_result(evaluation, system) for system in evaluation.systems]
    return {
        "data": evaluation.data,
        "split": evaluation.split,
        **{name: evaluation.counts[name] for name in ("images", "scans", "camera_images", "panoramas")},
        "pseudo_labels": [
            {"part": part, "made_by": name, "frames": count}
            for (part, name), count in sorted(evaluation.pseudo_labels.items())
        ],
        "metrics": list(config.groups),
        "sectors": list(config.sectors),
        "inception": config.inception.sha256 if config.inception else None,
        "camera_segmenter": config.image_segmenter.sha256 if config.image_segmenter else None,
        "classes": [COMMON15.classes[c] for c in evaluation.target_classes()],
        "panorama_classes": [COMMON15.classes[c] for c in evaluation.target_classes("panorama")],
        "heading": _heading(evaluation, [entry for result in results for entry in result["values"]]),
        "results": results,
        "ground_truth": [_entry(value) for value in evaluation.values(evaluation.reference)],
    }


def _result(evaluation: Evaluation, system: EvaluatedSystem) -> dict[str, Any]:
    """Return the entry of one system in "results"."""
    entries = [_entry(value) for value in evaluation.values(system.metrics)]
    values = by_name(entries)
    scores = {
        role: {
            f"{sector.removesuffix('s')}_{name}": value
            for sector, names in sectors
            for name in names.split()
            if (value := value_of(values, sector, name)) is not None
        }
        for role, sectors in CARD_SCORES.items()
    }
    scores["renderer"] = scores["painter"]
    networks = system.system.info.networks
    scored_roles = {"segmenter", "translator", *(networks.keys() & scores.keys())}
    counts = {key: system.metrics.classes(sector) for sector, key in CLASS_TABLES.items()}
    return {
        "weights": system.system.info.name,
        "networks": {role: dict(card) for role, card in networks.items()},
        "score": {role: score | {"split": evaluation.split} for role, score in scores.items() if role in scored_roles},
        "milliseconds": {stage: round(value, 2) for stage, value in system.mean_milliseconds().items()},
        "values": entries,
        "worst": [{"frame": frame.name, "metric": frame.metric, "value": frame.value} for frame in system.worst.held],
        **{key: [] if count is None else count.table() for key, count in counts.items()},
    }


def _entry(value: MetricValue) -> dict[str, Any]:
    sector, title, part = value
    finite = {name: number if math.isfinite(number) else None for name, number in part._asdict().items()}
    return {"sector": sector, "name": title, **finite}


def by_name(entries: Iterable[Entry]) -> dict[tuple[str, str], Entry]:
    """Return the entries by sector and name."""
    return {(entry["sector"], entry["name"]): entry for entry in entries}


def value_of(values: Values, sector: str, name: str) -> float | None:
    """Return a value; None if it is absent or undefined."""
    entry = values.get((sector, name))
    return None if entry is None else entry["value"]


def _heading(evaluation: Evaluation, entries: Sequence[Entry]) -> str:
    """Describe the data, the metrics and their limits; entries: of all systems."""
    counts = evaluation.counts
    present = evaluation.target_classes() or ([] if counts["images"] else evaluation.target_classes("panorama"))
    missing = [name for c, name in enumerate(COMMON15.classes) if c not in (*present, *UNSCORED)]
    absent = f" (absent: {', '.join(missing)})" if missing else ""
    images, stitched = max(counts["images"], counts["camera_images"]), counts["stitched_images"]
    sort = "images of the front camera" if stitched else "camera images"
    cameras = f"{images} {sort}, each scored as a whole at its own size, " if evaluation.config.has("camera") else ""
    parts = [
        f"`{evaluation.split}` of {evaluation.data}: {cameras}predicted from the scan alone; {counts['scans']} scans"
        f" with point labels. Pixels whose target is unlabeled, sky or unknown are not scored; predictions of unlabeled"
        f" or sky count as wrong."
    ]
    teachers = sorted(evaluation.pseudo_labels.items())
    if teachers:
        pseudo = ", ".join(f"{part} of {count} frames by {name[:8]}" for (part, name), count in teachers)
        parts.append(f"**Pseudo-labels of networks, not ground truth: {pseudo}.**")
    if present:
        parts.append(f"mIoU: mean over the {len(present)} of the paper's 14 classes that occur{absent}.")
    names = {entry["name"] for entry in entries}
    if names & {"ssim", "swd"}:
        parts.append(
            f"Colours: against the camera's images ({counts['camera_images']}), resized to 1024 x 1024 for SWD."
        )
        if evaluation.config.inception is None:
            parts.append("FID: not measured, no Inception weights were given.")
    if counts["panoramas"] and evaluation.config.has("panorama"):
        parts.append(
            f"Panorama: against ground-truth panoramas ({counts['panoramas']}"
            f"{f', of {stitched} camera images' if stitched else ''}), on their raster, where they are valid; SWD in"
            " quarters."
        )
    if any(entry["low"] is not None for entry in entries):
        parts.append("In brackets: 95 % interval, by the bootstrap over frames (distances of sets: by the jackknife).")
    return " ".join([*parts, *_unmeasured(evaluation, entries), *_reservations(evaluation)])


def _unmeasured(evaluation: Evaluation, entries: Iterable[Entry]) -> Iterable[str]:
    """Name the requested metrics without any value, and their needs; entries: of all systems."""
    measured = {(entry["sector"], entry["name"]) for entry in entries if entry["value"] is not None}
    titles: dict[str, list[str]] = {}
    for sector in ("points", *evaluation.config.sectors):
        for group in evaluation.config.groups:
            value, need = LEADING[group]
            if group in ABSENT.get(sector, LEADING.keys() - {"points"}) or (sector, value) in measured:
                continue
            if sector == "panorama" and not evaluation.counts["panoramas"]:
                titles[PANORAMA_NEED] = [sector]
            else:
                titles.setdefault(need, []).append(group if sector == "points" else f"{sector} {group}")
    if titles:
        reasons = (f"{', '.join(groups)}, because that needs {need}" for need, groups in titles.items())
        yield f"Not measured: {'; '.join(reasons)}."


def _reservations(evaluation: Evaluation) -> Iterable[str]:
    """Name the systems whose scores are flattered, or that receive more than the scan."""
    systems = [system.system for system in evaluation.systems]
    selected = [system.info.name for system in systems if _selected_here(evaluation, system.info.networks)]
    if selected:
        yield f"**Weights were selected on this split, so its scores flatter them: {', '.join(selected)}.**"
    oracles = [system.info.name for system in systems if system.uses_ground_truth]
    if oracles:
        yield f"Input is the camera's ground-truth labels, not the scan: {', '.join(oracles)}."
    steady = [system.info.name for system in systems if getattr(system, "steady", False)]
    if steady and evaluation.counts["following"]:
        yield f"Input is the sensor's pose beside the scan: {', '.join(steady)}."
    elif steady:
        yield f"Not smoothed over time, because no frame with a pose follows another: {', '.join(steady)}."


def _selected_here(evaluation: Evaluation, networks: Mapping[str, Mapping[str, Any]]) -> bool:
    """Return whether the best of a network's checkpoints was selected on the split that is scored."""
    return any(
        evaluation.split in str(card.get("split", "")).split(" + ")
        and evaluation.data in str(card.get("data", "")).split("+")
        for card in networks.values()
    )


# --- CSV --------------------------------------------------------------------------------------------------------------


def records(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return one row per system and value, with IoU of classes and milliseconds.

    summary  `as_dict` of an evaluation. Its reference is the system "ground truth".
    """
    rows: list[dict[str, Any]] = []

    def add(system: str, entry: Entry) -> None:
        plain = dict(entry)
        rows.append({"system": system, "sector": plain.pop("sector"), "metric": plain.pop("name"), **plain})

    for result in summary["results"]:
        values, empty = by_name(result["values"]), {"low": None, "high": None, "frames": None}
        for entry in result["values"]:
            add(result["weights"], entry)
        for sector, key in CLASS_TABLES.items():
            frames = values.get((sector, "miou"), empty)["frames"]
            for row in result[key]:
                if row["pixels"]:
                    entry = {"sector": sector, "name": f"iou {row['class']}", "value": row["iou"]}
                    add(result["weights"], empty | entry | {"frames": frames})
        for stage, mean in result["milliseconds"].items():
            add(result["weights"], {"sector": "milliseconds", "name": stage, "value": mean} | empty)
    for entry in summary["ground_truth"]:
        add("ground truth", entry)
    return rows


# --- Markdown ---------------------------------------------------------------------------------------------------------


def table(summary: Mapping[str, Any]) -> str:
    """Return Markdown of `as_dict` of an evaluation: its heading, then a column per system."""
    results = summary["results"]
    values = [by_name(result["values"]) for result in results]
    reference = by_name(summary["ground_truth"])
    rows: list[Sequence[str]] = []
    for sector, prefix in PREFIX.items():
        rows.extend(_class_rows(summary, sector, prefix, values))
        rows.extend(_value_rows(summary, sector, prefix, values, reference))
    rows.extend(_point_rows(summary, values))
    times = [result["milliseconds"] for result in results]
    for stage in dict.fromkeys(stage for time in times for stage in time):
        cells = [f"{time[stage]:.0f}" if stage in time else "-" for time in times]
        rows.append([f"{stage.replace('_', ' ')}, ms", "", *cells])
    head = ["class", "pixels", *(result["weights"] for result in results)]
    return f"{summary['heading']}\n\n{markdown_table(head, rows)}"


def number_cell(value: float | None, decimals: int = 3) -> str:
    """Return a number as text; "-" for None and NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:.{decimals}f}"


def entry_cell(entry: Entry | None, row: Row) -> str:
    """Return a value, with its interval if the row shows intervals; "-" if it is absent or undefined."""
    if entry is None:
        return "-"
    value, low, high = (
        number_cell(None if entry[end] is None else entry[end] * row.factor, row.decimals)
        for end in ("value", "low", "high")
    )
    return value if not row.interval or entry["low"] is None else f"{value} ({low} to {high})"


def _class_rows(
    summary: Mapping[str, Any], sector: str, prefix: str, values: Iterable[Values]
) -> Iterable[Sequence[str]]:
    """Return a row per class, and their mean."""
    present, tables = summary[CLASS_TABLES[sector]], [result[CLASS_TABLES[sector]] for result in summary["results"]]
    pixels = {row["class"]: row["pixels"] for row in next(filter(None, tables), [])}
    if not pixels or not present:
        return
    ious = [{row["class"]: row["iou"] for row in rows} for rows in tables]
    for name in present:
        cells = [number_cell(iou.get(name)) for iou in ious]
        yield [prefix + name, f"{pixels[name] / sum(pixels.values()):.1%}", *cells]
    cells = [_bold(entry_cell(entries.get((sector, "miou")), WITH_INTERVAL)) for entries in values]
    pseudo = _pseudo_labels(summary, "camera labels") if sector == "camera" else ""
    yield [f"{prefix}**mIoU of {len(present)}**{pseudo}", "", *cells]


def _bold(cell: str) -> str:
    """Return a cell with its number, not its interval, in bold."""
    number, space, interval = cell.partition(" ")
    return cell if cell == "-" else f"**{number}**{space}{interval}"


def _pseudo_labels(summary: Mapping[str, Any], part: str) -> str:
    """Return the addition to a row's title that names the networks which predicted the labels; "" for ground truth."""
    names = sorted({label["made_by"] for label in summary["pseudo_labels"] if label["part"] == part})
    return f" (pseudo-labels by {', '.join(name[:8] for name in names)})" if names else ""


def _value_rows(
    summary: Mapping[str, Any], sector: str, prefix: str, values: Sequence[Values], reference: Values
) -> Iterable[Sequence[str]]:
    """Return a row per value that some system has."""
    for name, row in ROWS.items():
        key, title = (sector, name), row.title
        if not any(key in entries for entries in values):
            continue
        if name == "fsd" and summary["camera_segmenter"]:
            title = f"{title} (features of {summary['camera_segmenter'][:8]})"
        ground_truth = (
            f"ground truth {entry_cell(reference[key], row._replace(interval=False))}" if key in reference else ""
        )
        yield [prefix + title, ground_truth, *(entry_cell(entries.get(key), row) for entries in values)]
        if name == "swd":
            levels = " ".join(level.removeprefix("swd_") for level in SWD_LEVELS)
            cells = (
                " ".join(entry_cell(entries.get((sector, level)), row._replace(interval=False)) for level in SWD_LEVELS)
                if key in entries
                else "-"
                for entries in values
            )
            yield [f"{prefix}SWD x 1000 by level, {levels}", "", *cells]


def _point_rows(summary: Mapping[str, Any], values: Sequence[Values]) -> Iterable[Sequence[str]]:
    """Return the rows of the points' classes, if some system has any."""
    if not any(("points", "miou") in entries for entries in values):
        return
    classes = next(filter(None, (result["point_classes"] for result in summary["results"])), [])
    present = sum(row["pixels"] > 0 for row in classes)
    title = f"points: mIoU of {present} SemanticKITTI classes{_pseudo_labels(summary, 'point labels')}"
    for name, heading in (("miou", title), ("accuracy", "points: accuracy")):
        yield [heading, "", *(entry_cell(entries.get(("points", name)), WITH_INTERVAL) for entries in values)]
