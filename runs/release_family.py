"""Put a trained family into the package: the weights, with licence in their cards, measured scores, and their page.

python runs/release_family.py FOLDER NAME SCORES.json --licence SPDX
FOLDER holds segmenter, translator and painter (.safetensors); SCORES.json is what
`lidar2pano evaluate FOLDER ... --json` wrote.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from lidar2pano.models.card import load, save, write_scores
from lidar2pano.models.families import RELEASED, families, weight_files
from lidar2pano.models.hub import PAGE, model_page


def main() -> None:
    """Read the arguments and write the family's files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("name")
    parser.add_argument("scores", type=Path)
    parser.add_argument("--licence", required=True)
    arguments = parser.parse_args()
    measured = json.loads(arguments.scores.read_text(encoding="utf-8"))["results"][0]["score"]
    home = families().get(arguments.name, RELEASED / arguments.name)
    cards = {}
    for role, file in weight_files(arguments.folder).items():
        network, card = load(file)
        card = save(home / f"{role}.safetensors", network, replace(card, licence=arguments.licence))
        cards[role] = replace(card, score=measured.get(role, {}))
    write_scores(home, cards.values())
    (home / PAGE).write_text(model_page(arguments.name, cards), encoding="utf-8")


if __name__ == "__main__":
    main()
