"""What a reproduction is told, and the recipe that follows for each of its networks."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from lidar2pano.data.sequences import SEQUENCES
from lidar2pano.errors import InputError
from lidar2pano.reproduce.rows import ROWS, Row
from lidar2pano.train.options import VideoOptions
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named

UNITS = {"s": 1 / 60, "m": 1.0, "h": 60.0}
SEGMENTER = "salsanext"


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One reproduction.

    data, out  the data set and the folder that everything goes into;  split: what rows are scored on.
    budget     of every trained network alike: "90s", "20m", "2h" or "5000steps"; "" as the recipe has it.
    rows       which rows;  mini: the recipes' small forms;  frames: how many of the split are scored (0 = all).
    segmenter  weights of the LiDAR's segmenter; "" trains one like the rest.
    changes    "PART.a.b=c" for single recipes, e.g. "titan.training.batch=4".
    """

    data: Path
    out: Path
    split: str = "val"
    budget: str = ""
    rows: Mapping[str, Row] = field(default_factory=lambda: ROWS)
    mini: bool = True
    frames: int = 0
    segmenter: str = ""
    device: str = "auto"
    sdnet: Path | None = None
    inception: Path | None = None
    changes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what cannot be (InputError)."""
        budget(self.budget)
        if self.frames < 0:
            raise InputError(f"--frames {self.frames} cannot be negative")

    @property
    def parts(self) -> list[str]:
        """Every network that the rows need, in the order in which they can be trained."""
        used = dict.fromkeys(part for row in self.rows.values() for part in row.parts if part != "truth")
        first = [] if self.segmenter else [SEGMENTER]
        return [*first, *sorted(used, key=lambda part: part == "painter")]  # which learns behind a translator

    def run(self, part: str) -> Path:
        """The folder that a network is trained in."""
        return self.out / "runs" / part

    def weights(self, part: str) -> str:
        """Where a part's weights are: its run, or for the segmenter what was named."""
        return self.segmenter if part == SEGMENTER and self.segmenter else str(self.run(part))

    def chain(self, row: Row) -> str:
        """The row's system, as `evaluate` takes it; what reads classes of the points is told by whom."""
        runs = ["truth" if part == "truth" else str(self.run(part)) for part in row.parts]
        reads = row.segments and row.parts[0] != "truth"
        return "+".join([self.weights(SEGMENTER), *runs] if reads else runs)

    def recipe(self, part: str, files: Mapping[str, Path]) -> Recipe:
        """The recipe of a part on this data; files: weight files of what is trained already, by part."""
        found = recipe_named(f"{part}-mini" if self.mini else part)
        there = splits(self.data)
        train = tuple(name for name in found.data.train if name in there) or ("train",)
        found = replace(found, data=replace(found.data, train=train, val=(self.split,)))
        given = {"segmenter": files.get(SEGMENTER), "translator": files.get("titan-pano")}
        options: dict[str, object] = {
            name: str(file) for name, file in given.items() if file and hasattr(found.options, name)
        }
        if isinstance(found.options, VideoOptions):
            single = tuple(name for name in found.options.single_frame_splits if name in there)
            options["single_frame_splits"] = single
        found = replace(found, options=replace(found.options, **options))
        for change in budget(self.budget):
            found = override(found, change)
        for change in self.changes:
            name, _, rest = change.partition(".")
            if name == part:
                found = override(found, rest)
        return found


def budget(text: str) -> list[str]:
    """Changes of a recipe that give it "90s", "20m", "2h" or "5000steps"; InputError for other words."""
    if not text:
        return []
    found = re.fullmatch(r"([0-9.]+)(s|m|h|steps)", text)
    try:
        amount = float(found[1]) if found else 0.0
    except ValueError:
        amount = 0.0
    if not found or amount <= 0:
        raise InputError(f"--budget {text!r} is not of the form 90s, 20m, 2h or 5000steps")
    if found[2] == "steps":
        return [f"training.steps={int(amount)}", "training.minutes=0"]
    return ["training.steps=10000000", f"training.minutes={amount * UNITS[found[2]]:.4f}"]


def splits(root: Path) -> set[str]:
    """Names of the data set's splits."""
    listing = root / "splits.json"
    if not listing.is_file():
        return set(SEQUENCES)
    try:
        return set(json.loads(listing.read_text(encoding="utf-8")))
    except ValueError as error:
        raise InputError(f"{listing}: is no JSON ({error}); write split -> list of seq/NNNNNN") from error
