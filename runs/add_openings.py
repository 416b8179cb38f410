"""A scene painter with the input for openings, which paints as the one without did: add_openings.py WEIGHTS OUT"""

import sys
from pathlib import Path

import torch
from safetensors.torch import load_file

from lidar2pano.models import build
from lidar2pano.models.card import read_card, save

WIDER = ("stem.0.weight", "up1.0.0.weight", "mix1.0.0.weight", "mix0.0.weight")  # what sees the inputs, last of all


def main(weights: str, out: str) -> None:
    card, state = read_card(weights), load_file(weights)
    network = build("scene-painter", **card.settings)
    for name in WIDER:
        old = state[name]
        state[name] = torch.cat([old, old.new_zeros(old.shape[0], 1, *old.shape[2:])], 1)
    network.load_state_dict(state)
    save(Path(out), network, card)


if __name__ == "__main__":
    main(*sys.argv[1:])
