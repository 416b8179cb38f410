"""A painter that was trained without grain, given weights for it, so that its training can go on from there.

    python runs/add_noise_input.py PAINTER.safetensors OUT.safetensors

The grain is the last of the channels that every convolution joins; its weights begin as those of a fresh painter, so
much weaker that the picture hardly changes at first.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from lidar2pano.models import build
from lidar2pano.models.card import load, save

WEAKER = 0.3


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("painter", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    before, card = load(arguments.painter, expect="painter")
    settings = {**card.settings, "grain": True}
    torch.manual_seed(0)
    painter = build("painter", **settings)
    state, old = painter.state_dict(), before.state_dict()
    for name, value in old.items():
        if state[name].shape != value.shape:
            value = torch.cat([value, WEAKER * state[name][:, value.shape[1] :]], 1)  # noqa: PLW2901
        state[name] = value
    painter.load_state_dict(state)
    save(arguments.out, painter, replace(card, settings=settings, recipe=f"{card.recipe}, given grain"))


if __name__ == "__main__":
    main()
