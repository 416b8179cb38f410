"""The run: networks that are missing are trained, rows that changed are scored, then the report is written."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidar2pano.data.truths import Truths, truths
from lidar2pano.errors import InputError
from lidar2pano.evaluate import Measures, score, system
from lidar2pano.formats.image_files import write_whole
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.reproduce.plan import SEGMENTER, Plan
from lidar2pano.reproduce.rows import Row
from lidar2pano.reproduce.sheets import keep_pictures

log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Outcome:
    """What came of a plan.

    results   row -> what `Evaluation.as_dict()` says of it;  failures: part or row -> why there is none.
    """

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)


def reproduce(plan: Plan) -> Outcome:
    """Train and score what is missing; a part or row that fails is told of, and the rest goes on."""
    outcome = Outcome()
    files: dict[str, Path] = {}
    if plan.segmenter:
        files[SEGMENTER] = _segmenter(plan.segmenter)
    for part in plan.parts:
        try:
            files[part] = train_part(plan, part, files)
        except (InputError, FloatingPointError) as error:
            outcome.failures[part] = str(error)
            log.warning("%s: not trained: %s", part, error)
    found = sampled(truths(plan.data, plan.split), plan.frames)
    measures = Measures.of("", inception=plan.inception, sdnet=plan.sdnet, device=plan.device)
    for name, row in plan.rows.items():
        missing = [part for part in row.parts if part != "truth" and part not in files]
        if missing:
            outcome.failures[name] = f"{missing[0]} was not trained: {outcome.failures[missing[0]]}"
            continue
        try:
            outcome.results[name] = score_row(plan, name, row, files, found, measures)
        except InputError as error:
            outcome.failures[name] = str(error)
            log.warning("%s: not scored: %s", row.name, error)
    return outcome


def train_part(plan: Plan, part: str, files: Mapping[str, Path]) -> Path:
    """The best weights of a part, trained unless its run is at its end already."""
    from lidar2pano.train.engine import train

    recipe = plan.recipe(part, files)
    for option in ("translator", "segmenter"):
        if part == "painter" and not recipe.options[option]:
            raise InputError(f"the painter learns behind a {option}, and there is none")
    log.info("training %s", recipe.name)
    folder = train(recipe, plan.data, plan.run(part), device=plan.device)
    return folder / f"{_released(part)}.safetensors"


def _released(part: str) -> str:
    """The name, within its task, of the network that a part is."""
    if part == SEGMENTER:
        return "segmenter"
    if part in ("painter", "vid2vid"):
        return "painter"
    return "renderer" if part in ("scunet", "pix2pix-rgb", "titan-no-segments") else "translator"


def _segmenter(name: str) -> Path:
    found = weight_files(name, fill=False)
    if "segmenter" not in found:
        raise InputError(f"--segmenter {name}: has no weights of a LiDAR segmenter; name a family, run or file")
    return found["segmenter"]


def sampled(found: Truths, count: int) -> Truths:
    """All frames, or `count` of them, evenly over the split."""
    if not count or count >= len(found):
        return found
    return found[:: len(found) // count][:count]


def score_row(
    plan: Plan, name: str, row: Row, files: Mapping[str, Path], found: Truths, measures: Measures
) -> dict[str, Any]:
    """A row's figures, from DIR/rows where nothing that they depend on has changed."""
    path = plan.out / "rows" / f"{name}.json"
    key = _key(plan, row, files, found, measures)
    if path.is_file():
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            held = {}  # damaged: scored anew
        if held.get("key") == key:
            return held["result"]
    log.info("scoring %s", row.name)
    one = system(plan.chain(row), device=plan.device)
    keep_pictures(plan.out / "pictures" / name, one, found, measures)
    evaluation = score([one], found, data=plan.data.resolve().name, split=plan.split, measures=measures)
    result = evaluation.as_dict()
    text = json.dumps({"key": key, "result": result}, indent=1)
    write_whole(path, lambda beside: beside.write_text(text, encoding="utf-8"))
    return result


def _key(plan: Plan, row: Row, files: Mapping[str, Path], found: Truths, measures: Measures) -> str:
    """A hash of all that a row's figures depend on: weights, frames and what is measured."""
    parts = [part for part in (SEGMENTER, *row.parts) if part in files]
    told = {
        "weights": [read_card(files[part]).sha256 for part in parts],
        "chain": row.parts,
        "data": str(plan.data.resolve()),
        "split": plan.split,
        "frames": found.names,
        "measures": [measures.kinds, measures.sectors],
        "inception": measures.inception.sha256 if measures.inception else "",
        "eye": measures.eye.sha256 if measures.eye else "",
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
