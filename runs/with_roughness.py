"""Make a segmenter read roughness as a sixth channel: with_roughness.py WEIGHTS OUT

The new channel's weights are zero, so that OUT predicts what WEIGHTS does; a training that begins from OUT uses it.
"""

import sys
from dataclasses import replace
from pathlib import Path

from safetensors.torch import load_file
from torch.nn.functional import pad

from lidar2pano.geometry.projection import Normalisation
from lidar2pano.models import build
from lidar2pano.models.card import read_card, save

FIRST = "downCntx.conv1.weight"  # of SalsaNext: (32, channels, 1, 1)


def main(weights: str, out: str) -> None:
    card, state = read_card(weights), load_file(weights)
    channels = state[FIRST].shape[1] + 1
    network = build("salsanext", **(settings := {**card.settings, "channels": channels}))
    network.load_state_dict(state | {FIRST: pad(state[FIRST], (0, 0, 0, 0, 0, 1))})
    normalisation = Normalisation.of(channels).as_dict()
    save(Path(out), network, replace(card, settings=settings, normalisation=normalisation))


if __name__ == "__main__":
    main(*sys.argv[1:])
