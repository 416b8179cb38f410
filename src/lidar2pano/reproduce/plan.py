"""The options of a reproduction, and the recipe of each of its networks."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lidar2pano.data.clips import runs
from lidar2pano.data.layouts import frames
from lidar2pano.data.semantic_kitti import SEQUENCES
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.formats.json_files import read_json
from lidar2pano.reproduce.paper_tables import ROWS, PaperRow
from lidar2pano.train.options import ScenePaintingOptions, VideoOptions
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named

SELECTION = "selection"  # split of training frames on which checkpoints are selected
UNITS = {"s": 1 / 60, "m": 1.0, "h": 60.0}
SEGMENTER = "salsanext"
MOST_BUDGET = 1e7  # seconds, minutes, hours or steps
PUBLISHED_SEGMENTER = "salsanext-published"  # its recipe at full length


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One reproduction.

    data, out  the data set and the output folder;  split: the split on which rows are scored.
    budget     training of every network: "90s", "20m", "2h" or "5000steps"; "" as in the recipe.
    rows       which rows;  mini: the recipes' small forms;  frames: number of frames that are scored (0 = all).
    segmenter  weights of the LiDAR segmenter; "" trains one;  devices: number of GPUs or processes that train.
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
        """Every network that the rows need, in the order in which they can be trained."""
        used = dict.fromkeys(part for row in self.rows.values() for part in row.parts if part != "oracle")
        first = [] if self.segmenter else [SEGMENTER]
        return [*first, *sorted(used, key=lambda part: part == "scene-painter")]  # which is trained behind a translator

    def run(self, part: str) -> Path:
        """The folder in which a network is trained."""
        return self.out / "runs" / part

    def weights(self, part: str) -> str:
        """Where a part's weights are: its run, or for the segmenter the given weights."""
        return self.segmenter if part == SEGMENTER and self.segmenter else str(self.run(part))

    def chain(self, row: PaperRow) -> str:
        """The row's system, as an argument of `evaluate`; rows that use point labels get the segmenter prepended."""
        runs = ["oracle" if part == "oracle" else str(self.run(part)) for part in row.parts]
        uses_labels = row.segments and row.parts[0] != "oracle"
        return "+".join([self.weights(SEGMENTER), *runs] if uses_labels else runs)

    def recipe(self, part: str, files: Mapping[str, Path]) -> Recipe:
        """The recipe of a part on this data; files: weight files of the trained parts."""
        full = PUBLISHED_SEGMENTER if part == SEGMENTER else part
        found = recipe_named(f"{part}-mini" if self.mini else full)
        there = splits(self.data)
        train = tuple(name for name in found.data.train if name in there) or ("train",)
        found = replace(found, data=replace(found.data, train=train, val=(SELECTION,)))
        given = {"segmenter": files.get(SEGMENTER), "translator": files.get("titan-pano")}
        options: dict[str, Any] = {
            name: str(file) for name, file in given.items() if file and hasattr(found.options, name)
        }
        if isinstance(found.options, ScenePaintingOptions):
            options["cache"] = str(self.out / "painting-frames")
        if SEGMENTER in files and hasattr(found.options, "segments"):
            options["segments"] = "predicted"  # as in the paper's section 3.1
        if isinstance(found.options, VideoOptions):
            options["single_frame_splits"] = self._stills(found.data.train, found.options.clip_length)
        found = replace(found, options=replace(found.options, **options))
        for change in budget(self.budget):
            found = override(found, change)
        for change in self.changes:
            name, _, rest = change.partition(".")
            if name == part:
                found = override(found, rest)
        return found

    def _stills(self, train: Sequence[str], length: int) -> tuple[str, ...]:
        """Splits of which no `length` frames follow each other: vid2vid pans over each of their frames."""
        lists = _training_frames(self) if (self.data / "sequences").is_dir() else {}
        return tuple(name for name in dict.fromkeys((*train, SELECTION)) if not runs(lists.get(name, ()), length))


def training_data(plan: Plan) -> Path:
    """DIR/data, the data set with a split `selection`: the last training sequence, or the last tenth of the only one.

    No checkpoint is selected on frames that are scored: other splits but the scored one lose these frames, and the
    training splits lose those of the scored one. Everything but splits.json are links.
    """
    rest = _training_frames(plan)
    folder = plan.out / "data"
    folder.mkdir(parents=True, exist_ok=True)
    for path in plan.data.resolve().iterdir():
        if path.name != "splits.json" and not (folder / path.name).is_symlink():
            (folder / path.name).symlink_to(path)
    text = json.dumps(rest, indent=1)
    write_whole(folder / "splits.json", lambda beside: beside.write_text(text, encoding="utf-8"))
    return folder


def _training_frames(plan: Plan) -> dict[str, list[str]]:
    """Names of the frames of every split as `training_data` has them."""
    lists = _frames_by_split(plan)
    scored = set(lists[plan.split])
    train = [name for name in lists["train"] if name not in scored]
    if not train:
        raise InputError(f"{plan.data}: all frames of `train` are in `{plan.split}`, which is scored; name another")
    sequences = [name.partition("/")[0] for name in train]
    first = sequences.index(sequences[-1]) or len(train) - max(1, len(train) // 10)
    held = set(train[first:])
    kept = {name: [one for one in found if one not in held | scored] for name, found in lists.items()}
    return kept | {"train": kept["train"] or train, SELECTION: train[first:], plan.split: lists[plan.split]}


def _frames_by_split(plan: Plan) -> dict[str, list[str]]:
    """Names of the frames of every split; of SemanticKITTI's own splits those may be empty that nothing needs."""
    lists: dict[str, list[str]] = {}
    for name in dict.fromkeys(["train", plan.split, *sorted(splits(plan.data))]):
        try:
            lists[name] = list(frames(plan.data, name).names)
        except InputError:
            if name in ("train", plan.split) or (plan.data / "splits.json").is_file():
                raise
    return lists


def budget(text: str) -> list[str]:
    """Changes of a recipe that give it "90s", "20m", "2h" or "5000steps"; InputError for other text."""
    if not text:
        return []
    found = re.fullmatch(r"([0-9.]+)(s|m|h|steps)", text)
    try:
        amount = float(found[1]) if found else 0.0
    except ValueError:
        amount = 0.0
    if not found or not 0 < amount <= MOST_BUDGET:
        raise InputError(f"--budget {text!r} is not of the form 90s, 20m, 2h or 5000steps")
    if found[2] == "steps":
        return [f"training.steps={int(amount)}", "training.epochs=0", "training.minutes=0"]
    return ["training.steps=10000000", "training.epochs=0", f"training.minutes={amount * UNITS[found[2]]:.4f}"]


def splits(root: Path) -> set[str]:
    """Names of the data set's splits."""
    listing = root / "splits.json"
    if not listing.is_file():
        return set(SEQUENCES)
    found = read_json(listing, "write split -> list of seq/NNNNNN")
    if not isinstance(found, dict):
        raise InputError(f"{listing}: must be an object of split -> list of seq/NNNNNN; write it so")
    return set(found)
