"""One reproduction: its options, recipes and forecast, training of missing networks, scoring of rows that changed."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from lidar2pano.data.clips import runs
from lidar2pano.data.frames import Frame, FrameList, evenly_spaced, listed_splits
from lidar2pano.data.layouts import frames, frames_of
from lidar2pano.data.semantic_kitti import SEQUENCES
from lidar2pano.errors import InputError
from lidar2pano.evaluate import MetricConfig, report, score, system
from lidar2pano.formats.image_files import write_text
from lidar2pano.formats.json_files import read_json
from lidar2pano.hardware import Timer, pick_device
from lidar2pano.models import build
from lidar2pano.models.camera_teachers import CameraSegmenter, ImageNormalisation
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.pipeline import load
from lidar2pano.reproduce.images import write_images
from lidar2pano.reproduce.paper_tables import ROWS, PaperRow
from lidar2pano.train.checkpoint import read_progress
from lidar2pano.train.recipe import Recipe, Training, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.video import VideoOptions

log = logging.getLogger(__name__)

SELECTION = "selection"  # split of training frames for the selection of checkpoints
UNITS = {"s": 1 / 60, "m": 1.0, "h": 60.0}
SEGMENTER = "salsanext"
MOST_BUDGET = 1e7  # seconds, minutes, hours or steps
PUBLISHED_SEGMENTER = "salsanext-published"  # its recipe at full length
# Packages of the extra `train` by importing part; "" stands for every part.
PACKAGES = {
    "": ("lightning_fabric", "tensorboard", "matplotlib"),
    "vid2vid": ("cv2",),
    "autoencoder": ("efficientnet_lite_pytorch",),
}
PAINTING = ("autoencoder", "latent-painter")  # in this order, behind a translator
# trained on the camera's colours, not on its classes
IMAGES_ALONE = {*PAINTING, "scunet", "pix2pix-rgb", "titan-no-segments"}
COPIES = 5  # of a network on disk: its checkpoint with Adam's two moments, its best and its latest weights
GIB = 2**30


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One reproduction.

    data, out  the data set and the output folder;  split: the scored split.
    budget     training of every network: "90s", "20m", "2h" or "5000steps"; "" as in the recipe.
    rows       of the tables;  mini: the recipes' small forms;  frames: number of scored frames (0 = all).
    segmenter  weights of the LiDAR segmenter; "" trains one;  devices: number of training GPUs or processes.
    changes    "PART.a.b=c" for single recipes, e.g. "titan.training.batch=4".
    """

    data: Path
    out: Path
    split: str = "val"
    budget: str = ""
    rows: Mapping[str, PaperRow] = field(default_factory=lambda: ROWS)
    mini: bool = True
    frames: int = 0
    segmenter: str = ""
    device: str = "auto"
    devices: int = 1
    sdnet: Path | None = None
    inception: Path | None = None
    changes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError for impossible values."""
        budget(self.budget)
        if self.frames < 0:
            raise InputError(f"--frames {self.frames} cannot be negative")

    @property
    def parts(self) -> list[str]:
        """The networks of all rows, in an order of training."""
        used = dict.fromkeys(part for row in self.rows.values() for part in row.parts if part != "oracle")
        first = [] if self.segmenter else [SEGMENTER]
        painting = PAINTING if used.keys() & set(PAINTING) else ()
        return [*first, *(part for part in used if part not in PAINTING), *painting]

    def run(self, part: str) -> Path:
        """Return the folder of a network's training."""
        return self.out / "runs" / part

    def weights(self, part: str) -> str:
        """Return the place of a part's weights: its run, or the segmenter's weights."""
        return self.segmenter if part == SEGMENTER and self.segmenter else str(self.run(part))

    def chain(self, row: PaperRow) -> str:
        """Return the row's system, as an argument of `evaluate`; the segmenter is first, for rows with point labels."""
        runs = ["oracle" if part == "oracle" else str(self.run(part)) for part in row.parts]
        uses_labels = row.segments and row.parts[0] != "oracle"
        return "+".join([self.weights(SEGMENTER), *runs] if uses_labels else runs)

    def recipe(self, part: str, files: Mapping[str, Path]) -> Recipe:
        """Return the recipe of a part on this data; files: weight files of the trained parts."""
        full = PUBLISHED_SEGMENTER if part == SEGMENTER else part
        recipe = recipe_named(f"{part}-mini" if self.mini else full)
        names = splits(self.data)
        train = tuple(name for name in recipe.data.train if name in names) or ("train",)
        recipe = replace(recipe, data=replace(recipe.data, train=train, val=(SELECTION,)))
        parts = {"segmenter": SEGMENTER, "translator": "titan-pano", "autoencoder": "autoencoder"}
        options: dict[str, Any] = {
            name: str(files[made_by])
            for name, made_by in parts.items()
            if made_by in files and hasattr(recipe.options, name)
        }
        if hasattr(recipe.options, "cache"):
            options["cache"] = str(self.out / "sectors")
        if SEGMENTER in files and hasattr(recipe.options, "segments"):
            options["segments"] = "predicted"  # as in the paper's section 3.1
        if isinstance(recipe.options, VideoOptions):
            options["single_frame_splits"] = self._stills(recipe.data.train, recipe.options.clip_length)
        recipe = replace(recipe, options=replace(recipe.options, **options))
        for change in budget(self.budget):
            recipe = override(recipe, change)
        for change in self.changes:
            name, _, rest = change.partition(".")
            if name == part:
                recipe = override(recipe, rest)
        return recipe

    def _stills(self, train: Sequence[str], length: int) -> tuple[str, ...]:
        """Return the splits without `length` successive frames: vid2vid pans over each of their frames."""
        lists = training_frames(self) if (self.data / "sequences").is_dir() else {}
        return tuple(name for name in dict.fromkeys((*train, SELECTION)) if not runs(lists.get(name, ()), length))


def training_data(plan: Plan) -> Path:
    """Write DIR/data, the data set with a split `selection`: all training frames of the last one's sequence.

    Where these are more than half of `train`, as where it has one sequence only, they are its last tenth instead.
    No checkpoint is selected on scored frames: other splits but the scored one lose these frames, and the training
    splits lose those of the scored one. Everything but splits.json are links.
    """
    lists = training_frames(plan)
    folder = plan.out / "data"
    folder.mkdir(parents=True, exist_ok=True)
    for path in plan.data.resolve().iterdir():
        if path.name != "splits.json":
            link = folder / path.name
            try:
                link.symlink_to(path)
            except FileExistsError:
                if not link.is_symlink() or link.readlink() != path:
                    raise InputError(f"{link}: is no link to {path}; remove it, or choose another --out") from None
    write_text(folder / "splits.json", json.dumps(lists, indent=1))
    return folder


def training_frames(plan: Plan) -> dict[str, list[str]]:
    """Return the names of the frames of every split of `training_data`."""
    lists = _frames_by_split(plan)
    scored = set(lists[plan.split])
    train = [name for name in lists["train"] if name not in scored]
    if not train:
        raise InputError(f"{plan.data}: all frames of `train` are in `{plan.split}`, which is scored; name another")
    last_sequence = train[-1].partition("/")[0]
    held = [name for name in train if name.partition("/")[0] == last_sequence]  # sequences may interleave
    if len(held) > len(train) / 2:
        held = train[-max(1, len(train) // 10) :]
    left_out = scored.union(held)
    kept = {split: [name for name in names if name not in left_out] for split, names in lists.items()}
    return kept | {"train": kept["train"] or train, SELECTION: held, plan.split: lists[plan.split]}


def _frames_by_split(plan: Plan) -> dict[str, list[str]]:
    """Return the names of the frames of every split; unused splits of SemanticKITTI may be empty."""
    lists: dict[str, list[str]] = {}
    for name in dict.fromkeys(["train", plan.split, *sorted(splits(plan.data))]):
        try:
            lists[name] = list(frames(plan.data, name).names)
        except InputError:
            if name in ("train", plan.split) or (plan.data / "splits.json").is_file():
                raise
    return lists


def budget(text: str) -> list[str]:
    """Return changes of a recipe for "90s", "20m", "2h" or "5000steps"; InputError for other text."""
    if not text:
        return []
    match = re.fullmatch(r"([0-9.]+)(s|m|h|steps)", text)
    try:
        amount = float(match[1]) if match else 0.0
    except ValueError:
        amount = 0.0
    if not match or not 0 < amount <= MOST_BUDGET:
        raise InputError(f"--budget {text!r} is not of the form 90s, 20m, 2h or 5000steps")
    if match[2] == "steps":
        return [f"training.steps={int(amount)}", "training.epochs=0", "training.minutes=0"]
    return ["training.steps=10000000", "training.epochs=0", f"training.minutes={amount * UNITS[match[2]]:.4f}"]


def splits(root: Path) -> set[str]:
    """Return the names of the data set's splits."""
    listing = root / "splits.json"
    return set(listed_splits(listing)) if listing.is_file() else set(SEQUENCES)


# --- the run ----------------------------------------------------------------------------------------------------------


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
    outcome, files = Outcome(), dict[str, Path]()
    scored = sampled(frames(plan.data, plan.split), plan.frames)  # now: a mistake in the data concerns every part
    if plan.segmenter:
        segmenter_files = weight_files(plan.segmenter, fill=False)
        if "segmenter" not in segmenter_files:
            raise InputError(
                f"--segmenter {plan.segmenter}: has no weights of a LiDAR segmenter; name a family, run or file"
            )
        files[SEGMENTER] = segmenter_files["segmenter"]
    for part in plan.parts:
        try:
            files[part] = train_part(plan, part, files)
        except (InputError, FloatingPointError) as error:
            outcome.failures[part] = str(error)
            log.warning("%s: not trained: %s", part, error)
    config = MetricConfig.parse(inception=plan.inception, sdnet=plan.sdnet, device=plan.device)
    inputs = _scoring_inputs(plan, scored, config)
    for name, row in plan.rows.items():
        missing = [part for part in row.parts if part != "oracle" and part not in files]
        if missing:
            outcome.failures[name] = f"{missing[0]} was not trained: {outcome.failures[missing[0]]}"
            continue
        try:
            outcome.results[name] = score_row(plan, name, row, files, scored, config, inputs)
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
    from lidar2pano.train.tasks import TASKS

    recipe = plan.recipe(part, files)
    for option in ("translator", "segmenter", "autoencoder"):
        if part == "latent-painter" and not getattr(recipe.options, option):
            raise InputError(f"the painter is trained behind its {option}, and there is none")
    data = training_data(plan)
    counts = len(frames_of(data, recipe.data.train)), len(frames_of(data, recipe.data.val))
    log.info("training %s on %d frames, its checkpoints selected on %d", recipe.name, *counts)
    folder = train(recipe, data, plan.run(part), device=plan.device, devices=plan.devices)
    (network,) = TASKS[recipe.task].released
    return folder / f"{network}.safetensors"


def sampled(split: FrameList, count: int) -> FrameList:
    """Return all frames, or `count` of them, evenly spaced from the first to the last."""
    indices = evenly_spaced(len(split), count or len(split))
    return sum((split[index : index + 1] for index in indices), FrameList())


def score_row(
    plan: Plan,
    name: str,
    row: PaperRow,
    files: Mapping[str, Path],
    scored: FrameList,
    config: MetricConfig,
    inputs: Mapping[str, Any],
) -> dict[str, Any]:
    """Return a row's evaluation, from DIR/rows if neither its weights nor `inputs` of `_scoring_inputs` changed."""
    path = plan.out / "rows" / f"{name}.json"
    weights = [read_card(files[part]).sha256 for part in (SEGMENTER, *row.parts) if part in files]
    key = hashlib.sha256(
        json.dumps({**inputs, "weights": weights, "chain": row.parts}, sort_keys=True).encode()
    ).hexdigest()
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
    write_text(path, json.dumps({"key": key, "result": result}, indent=1))
    return result


def _scoring_inputs(plan: Plan, scored: FrameList, config: MetricConfig) -> dict[str, Any]:
    """Return the inputs that all rows share: frames, with size and time of change of their files, and metrics.

    Files of the layouts of SemanticKITTI and KITTI-360 are looked at, others are taken to stay as they are.
    """
    return {
        "data": str(plan.data.resolve()),
        "split": plan.split,
        "frames": scored.names,
        "files": _stamps(scored),
        "metrics": [config.groups, config.sectors],
        "inception": config.inception.sha256 if config.inception else "",
        "image_segmenter": config.image_segmenter.sha256 if config.image_segmenter else "",
    }


def _stamps(scored: FrameList) -> str:
    """Hash the sizes and times of change of the frames' files; labels are rewritten in place, at the same size."""
    digest = hashlib.sha256()
    for path in dict.fromkeys(path for frame in scored for path in frame.source_files):
        stamp = path.stat() if path.is_file() else None
        digest.update(f"{path} {stamp and (stamp.st_size, stamp.st_mtime_ns)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def missing_packages(plan: Plan) -> list[str]:
    """Return the absent packages of the extra `train` among the imports of the plan's parts."""
    needed = [name for part, names in PACKAGES.items() if not part or part in plan.parts for name in names]
    return [name for name in needed if find_spec(name) is None]


def check_packages(plan: Plan) -> None:
    """Raise InputError before the first training if a later one would lack a package."""
    if missing := missing_packages(plan):
        raise InputError(f"reproduce needs {', '.join(missing)}: pip install 'lidar2pano[train]'")


def _network_bytes(recipe: Recipe) -> int:
    with torch.device("meta"):
        networks = [build(spec.model, **spec.settings) for spec in recipe.networks.values()]
    return sum(4 * weights.numel() for network in networks for weights in network.parameters())


def missing_data(plan: Plan) -> list[str]:
    """Return a sentence for every kind of file missing from the first frames of training and scoring."""
    scored = frames(plan.data, plan.split)[0]
    train = training_frames(plan)["train"] if splits(plan.data) else []
    first = next(iter(frames(plan.data, "train"))) if train else scored
    lacks = [f"split {plan.split}: {fault}" for fault in _lacking(scored, plan, scoring=True)]
    return lacks + [f"split train: {fault}" for fault in _lacking(first, plan, scoring=False)]


def _lacking(frame: Frame, plan: Plan, *, scoring: bool) -> list[str]:
    prepare = f"lidar2pano prepare {plan.data}"
    faults = []
    if frame.image is None:
        faults.append(f"{frame.name} has no camera image; every row needs one")
    if frame.camera_labels is None and (scoring or set(plan.parts) - IMAGES_ALONE - {SEGMENTER}):
        faults.append(f"{frame.name} has no camera labels: {prepare} --teacher FILE")
    if not scoring and SEGMENTER in plan.parts and frame.point_labels is None:
        faults.append(f"{frame.name} has no point labels: {prepare}, or name a --segmenter")
    return faults


def _is_finished(run: Path, training: Training) -> bool:
    """Return whether a run has ended, and not by a smaller budget; in epochs, budgets are not compared."""
    progress = read_progress(run)
    if progress is None or progress.finished != progress.step:
        return False
    return training.epochs > 0 or progress.share(training) >= 1


def describe(plan: Plan) -> tuple[list[str], list[str]]:
    """Return the lines of a plan, and of its gaps."""
    lines, minutes, size = list[str](), list[float](), 0
    for part in plan.parts:
        recipe = plan.recipe(part, {})
        settings, size = recipe.training, size + COPIES * _network_bytes(recipe)
        finished = _is_finished(plan.run(part), settings)
        length = f"{settings.epochs:g} epochs" if settings.epochs else f"{settings.steps} steps"
        length = f"{settings.minutes:g} min" if settings.minutes else length
        lines.append(f"{part:20} {recipe.name:24} {length:>14}{'  finished' if finished else ''}")
        minutes += [] if finished else [settings.minutes]
    total = f"{sum(minutes):g} min" if all(minutes) else "as long as their steps take; --budget limits it"
    lines.append(f"{len(minutes)} trainings: {total}, and up to {size / GIB:.1f} GiB in {plan.out}")
    count = len(frames(plan.data, plan.split))
    lines.append(f"{len(plan.rows)} rows scored on {min(plan.frames or count, count)} frames of {plan.split}")
    packages = [f"{name}: pip install 'lidar2pano[train]'" for name in missing_packages(plan)]
    return lines, packages + missing_data(plan)
