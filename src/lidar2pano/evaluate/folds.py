"""Scores over folds: places, cities or sensors, each one sample; frames of one place are not independent."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lidar2pano.errors import InputError
from lidar2pano.evaluate.report import PREFIX, ROWS
from lidar2pano.markdown import markdown_table
from lidar2pano.metrics.accumulation import student_quantile

PLACEHOLDER = "{fold}"  # in a name of weights: stands for the name of the fold to be scored
LEAST = 3  # folds for an interval

Scores = Mapping[str, float]  # by value
Folded = Mapping[str, Mapping[str, Scores]]  # by system, then by fold


class Fold(NamedTuple):
    """A split of a data set, scored as one place."""

    name: str
    root: Path
    split: str


class Summary(NamedTuple):
    """Mean over folds and half of its 95 % interval, None for fewer than LEAST folds."""

    mean: float
    reach: float | None

    def __str__(self) -> str:
        """Return "mean ± reach"."""
        return f"{self.mean:.4f}" if self.reach is None else f"{self.mean:.4f} ± {self.reach:.4f}"


def parse_folds(texts: Iterable[str]) -> list[Fold]:
    """Return the folds of texts NAME=ROOT:SPLIT; InputError for another form, a name twice, fewer than two."""
    folds: list[Fold] = []
    for text in texts:
        name, equals, place = text.partition("=")
        root, colon, split = place.rpartition(":")
        if not (name and equals and root and colon and split):
            raise InputError(f"--folds {text}: say NAME=ROOT:SPLIT, as in harbour=data/harbour:val")
        folds.append(Fold(name, Path(root), split))
    names = [fold.name for fold in folds]
    if len(set(names)) != len(names):
        raise InputError(f"--folds: {', '.join(names)} name a fold twice")
    if len(folds) < 2:
        raise InputError("--folds: one fold is no comparison over places; give two or more, or --data and --split")
    return folds


def summary_of(values: Sequence[float]) -> Summary:
    """Return the mean of values, one a fold, and its interval by Student's t distribution."""
    mean = statistics.mean(values)
    if len(values) < LEAST:
        return Summary(mean, None)
    return Summary(mean, student_quantile(len(values) - 1) * statistics.stdev(values) / len(values) ** 0.5)


def scores_of(result: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of an entry of "results" (`report.as_dict`) as in reports, by "SECTOR NAME"."""
    return {
        f"{entry['sector']} {entry['name']}": entry["value"]
        for entry in result["values"]
        if entry["value"] is not None and (entry["name"] in ROWS or entry["name"] == "miou")
    }


def common_values(folded: Folded) -> list[str]:
    """Return the names of the values that all systems have on all folds so far; InputError without any."""
    scored = [scores for by_fold in folded.values() for scores in by_fold.values()]
    common = [name for name in scored[0] if all(name in scores for scores in scored)]
    if not common:
        folds = ", ".join(next(iter(folded.values())))
        raise InputError(f"no value is defined on all of {folds}; choose other --metrics or folds")
    return common


def compared(folded: Folded) -> dict[str, Any]:
    """Return everything, ready for JSON: each system's values by fold, their mean, the difference to the first system.

    Differences are paired: of the same folds. Values are `common_values`.
    """
    first, common = next(iter(folded.values())), common_values(folded)
    folds = list(first)
    systems: list[dict[str, Any]] = []
    for system, scores in folded.items():
        rows: list[dict[str, Any]] = []
        for name in common:
            values = [scores[fold][name] for fold in folds]
            gaps = [value - first[fold][name] for value, fold in zip(values, folds, strict=True)]
            parts = {"mean": summary_of(values), "difference": summary_of(gaps)}
            rows.append({"name": name, "values": values} | {key: part._asdict() for key, part in parts.items()})
        systems.append({"weights": system, "scores": rows})
    return {"folds": folds, "systems": systems}


def table(comparison: Mapping[str, Any]) -> str:
    """Return Markdown of `compared`: a row per value and system."""
    rows: list[list[str]] = []
    systems = comparison["systems"]
    for number in range(len(systems[0]["scores"])):
        for system in systems:
            score = system["scores"][number]
            sector, name = score["name"].split(" ", 1)
            title = ROWS[name].title if name in ROWS else "mIoU"
            summaries = [str(Summary(**score[key])) for key in ("mean", "difference")]
            cells = [f"{value:.4f}" for value in score["values"]]
            rows.append([f"{PREFIX.get(sector, f'{sector}: ')}{title}", system["weights"], *cells, *summaries])
    return markdown_table(["score", "weights", *comparison["folds"], "mean", "to the first"], rows)
