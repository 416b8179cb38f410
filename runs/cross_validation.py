"""Compare settings of a recipe by cross-validation over places: each place is scored by a run that never saw it.

    python runs/cross_validation.py RECIPE OUT --place NAME=SPLITS ... --arm NAME [OVERRIDE ...] ... [--always SPLITS]

A place is a street, city or sensor: SPLITS as in `data.train`, "FOLDER:split,FOLDER:split". Each arm is a list of
overrides of the recipe; overrides behind `--set` are of all arms. For each place and arm the recipe is trained on all
other places and on `--always` (simulated towns, say), and its own validation scores the place left out. Runs resume.
The table, also in OUT/folds.md, has each place's scores, their mean and the difference to the first arm, for three
places or more with its 95 % interval (Student's t over places: frames of one place are no independent samples).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from lidar2pano.evaluate.folds import compared, table
from lidar2pano.models.card import load
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named


def fold(arguments: argparse.Namespace, arm: list[str], left_out: str) -> dict[str, float]:
    """Train one arm without one place, and return its validation on that place."""
    places = dict(one.split("=", 1) for one in arguments.place)
    seen = [splits for name, splits in places.items() if name != left_out]
    recipe = recipe_named(arguments.recipe)
    data = [f"data.train={','.join(filter(None, [*seen, arguments.always]))}", f"data.val={places[left_out]}"]
    for change in (*data, *arguments.set, *arm[1:]):
        recipe = override(recipe, change)
    weights = train(recipe, arguments.root, arguments.out / f"{arm[0]}-without-{left_out}", "auto")
    _, card = load(next(iter(sorted(weights.glob("*.safetensors")))))
    return {f"validation {name}": value for name, value in card.score.items() if isinstance(value, float)}


def main() -> None:
    """Train what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe")
    parser.add_argument("out", type=Path)
    parser.add_argument("--place", action="append", required=True, metavar="NAME=SPLITS")
    parser.add_argument("--arm", action="append", nargs="+", required=True, metavar="NAME OVERRIDE")
    parser.add_argument("--always", default="", metavar="SPLITS")
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="OVERRIDE")
    parser.add_argument("--root", type=Path, default=Path(), help="folder of splits named without one")
    arguments = parser.parse_args()
    names = [one.split("=", 1)[0] for one in arguments.place]
    found = {arm[0]: {name: fold(arguments, arm, name) for name in names} for arm in arguments.arm}
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = table(compared(found))
    (arguments.out / "folds.md").write_text(f"{text}\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
