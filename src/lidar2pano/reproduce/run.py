"""Training of missing networks, and scoring of rows whose inputs changed."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidar2pano.data.frames import FrameList
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate import MetricConfig, report, score, system
from lidar2pano.formats.image_files import write_whole
from lidar2pano.formats.json_files import read_json
from lidar2pano.hardware import Timer, pick_device
from lidar2pano.models import build
from lidar2pano.models.camera_teachers import CameraSegmenter, ImageNormalisation
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.pipeline import load
from lidar2pano.reproduce.images import write_images
from lidar2pano.reproduce.paper_tables import PaperRow
from lidar2pano.reproduce.plan import SEGMENTER, Plan, training_data
from lidar2pano.train.recipes import recipe_named

log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Outcome:
    """The result of a plan.

    results   row -> its `report.as_dict`;  failures: part or row -> the reason.
    camera_segmenter_ms  time of SD-Net for an image of the split; None: there is no image.
    """

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    camera_segmenter_ms: float | None = None


def reproduce(plan: Plan) -> Outcome:
    """Train and score missing parts and rows; failures are logged, and the rest goes on."""
    outcome = Outcome()
    files: dict[str, Path] = {}
    scored = sampled(frames(plan.data, plan.split), plan.frames)  # now: a mistake in the data concerns every part
    if plan.segmenter:
        files[SEGMENTER] = _segmenter(plan.segmenter)
    for part in plan.parts:
        try:
            files[part] = train_part(plan, part, files)
        except (InputError, FloatingPointError) as error:
            outcome.failures[part] = str(error)
            log.warning("%s: not trained: %s", part, error)
    config = MetricConfig.parse("", inception=plan.inception, sdnet=plan.sdnet, device=plan.device)
    for name, row in plan.rows.items():
        missing = [part for part in row.parts if part != "oracle" and part not in files]
        if missing:
            outcome.failures[name] = f"{missing[0]} was not trained: {outcome.failures[missing[0]]}"
            continue
        try:
            outcome.results[name] = score_row(plan, name, row, files, scored, config)
        except InputError as error:
            outcome.failures[name] = str(error)
            log.warning("%s: not scored: %s", row.name, error)
    outcome.camera_segmenter_ms = _camera_segmenter_ms(plan, scored, config)
    return outcome


def _camera_segmenter_ms(plan: Plan, scored: FrameList, config: MetricConfig) -> float | None:
    """Time SD-Net on an image, milliseconds: the given one or, since weights do not matter, a fresh one."""
    image = scored[0].image
    if image is None:
        return None
    if config.image_segmenter:
        segmenter = config.image_segmenter.segmenter
    else:
        spec = recipe_named("sdnet-mini" if plan.mini else "sdnet").networks["camera"]
        network = build(spec.model, **spec.settings).eval().to(pick_device(plan.device))
        segmenter = CameraSegmenter(network=network, normalise=ImageNormalisation())
    timer = Timer(pick_device(plan.device))
    for stage in ("first", "warm"):
        with timer(stage):
            segmenter.probabilities(image)
    return timer.milliseconds["warm"]


def train_part(plan: Plan, part: str, files: Mapping[str, Path]) -> Path:
    """Return the best weights of a part, trained unless its run is finished."""
    from lidar2pano.train.engine import train

    recipe = plan.recipe(part, files)
    for option in ("translator", "segmenter"):
        if part == "scene-painter" and not getattr(recipe.options, option):
            raise InputError(f"the painter is trained behind a {option}, and there is none")
    log.info("training %s", recipe.name)
    folder = train(recipe, training_data(plan), plan.run(part), device=plan.device, devices=plan.devices)
    return folder / f"{_released(part)}.safetensors"


def _released(part: str) -> str:
    """Return the name of a part's network within its task."""
    if part == SEGMENTER:
        return "segmenter"
    if part in ("scene-painter", "vid2vid"):
        return "painter"
    return "renderer" if part in ("scunet", "pix2pix-rgb", "titan-no-segments") else "translator"


def _segmenter(name: str) -> Path:
    files = weight_files(name, fill=False)
    if "segmenter" not in files:
        raise InputError(f"--segmenter {name}: has no weights of a LiDAR segmenter; name a family, run or file")
    return files["segmenter"]


def sampled(split: FrameList, count: int) -> FrameList:
    """Return all frames, or `count` of them, evenly over the split."""
    if not count or count >= len(split):
        return split
    return split[:: len(split) // count][:count]


def score_row(
    plan: Plan, name: str, row: PaperRow, files: Mapping[str, Path], scored: FrameList, config: MetricConfig
) -> dict[str, Any]:
    """Return a row's evaluation, from DIR/rows if none of its inputs has changed."""
    path = plan.out / "rows" / f"{name}.json"
    key = _key(plan, row, files, scored, config)
    if path.is_file():
        try:
            stored = read_json(path)
        except InputError:
            stored = None  # damaged: scored again
        if isinstance(stored, dict) and stored.get("key") == key and isinstance(stored.get("result"), dict):
            return stored["result"]
    log.info("scoring %s", row.name)
    row_system = system(plan.chain(row), device=plan.device)
    painter = load(plan.chain(row), plan.device) if name == "titan" else None  # the paper's panoramas
    write_images(plan.out / "images" / name, row_system, scored, config, painter)
    evaluation = score([row_system], scored, data=plan.data.resolve().name, split=plan.split, config=config)
    result = report.as_dict(evaluation)
    text = json.dumps({"key": key, "result": result}, indent=1)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return result


def _key(plan: Plan, row: PaperRow, files: Mapping[str, Path], scored: FrameList, config: MetricConfig) -> str:
    """Hash everything on which a row's evaluation depends: weights, frames and metrics."""
    parts = [part for part in (SEGMENTER, *row.parts) if part in files]
    inputs = {
        "weights": [read_card(files[part]).sha256 for part in parts],
        "chain": row.parts,
        "data": str(plan.data.resolve()),
        "split": plan.split,
        "frames": scored.names,
        "metrics": [config.groups, config.sectors],
        "inception": config.inception.sha256 if config.inception else "",
        "image_segmenter": config.image_segmenter.sha256 if config.image_segmenter else "",
    }
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()
