"""A scene painter with one look more, which begins as the mean of the others: add_look.py WEIGHTS OUT LOOK"""

import sys
from dataclasses import replace
from pathlib import Path

import torch

from lidar2pano.models import build
from lidar2pano.models.card import load, save


def main(weights: str, out: str, look: str) -> None:
    network, card = load(weights, expect="scene-painter")
    settings = {**card.settings, "looks": [*card.settings["looks"], look], "look": look}
    wider, state = build("scene-painter", **settings), network.state_dict()
    for name in {"codes.weight", "class_colours.weight", "glass.weight"} & state.keys():
        state[name] = torch.cat([state[name], state[name].mean(0, keepdim=True)])
    wider.load_state_dict(state)
    save(Path(out), wider, replace(card, settings=settings))


if __name__ == "__main__":
    main(*sys.argv[1:])
