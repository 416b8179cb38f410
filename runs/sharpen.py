"""Set the power that a scene painter raises class probabilities to: sharpen.py PAINTER OUT POWER.

Training draws powers at random, so that no weight depends on it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from lidar2pano.models import build
from lidar2pano.models.card import load, save


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("painter", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("power", type=float)
    arguments = parser.parse_args()
    network, card = load(arguments.painter, expect="scene-painter")
    settings = {**card.settings, "sharp": arguments.power}
    other = build("scene-painter", **settings)
    other.load_state_dict(network.state_dict())
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save(arguments.out, other, replace(card, settings=settings))


if __name__ == "__main__":
    main()
