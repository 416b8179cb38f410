"""Take back a part of the class weights that a translator was trained with.

    python runs/prior.py TRANSLATOR.safetensors OUT.safetensors --data ROOT [--share 0.5]

Cross-entropy weighted by w teaches p(class) * w, so that rare classes are found more often than they occur. log w
times `share` is subtracted from the bias of the last layer: 0 leaves the network alone, 1 gives p(class) back. The
weights are those of the training task (train.panorama), from the data set's `train` split.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from lidar2pano.data.panorama_crops import PanoramaDataset
from lidar2pano.labels import COMMON15
from lidar2pano.losses.supervised import class_weights
from lidar2pano.models.card import load, save
from lidar2pano.models.titan_pano import TitanPano
from lidar2pano.views import View

COLUMNS, EXPONENT = 576, 0.5  # of the recipe titan-pano


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("translator", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--share", type=float, default=0.5)
    arguments = parser.parse_args()
    network, card = load(arguments.translator, expect="titan-pano")
    assert isinstance(network, TitanPano)
    samples = PanoramaDataset(arguments.data, ("train",), View(**card.views["panorama"]), COLUMNS)
    counts = samples.class_counts()[: len(COMMON15)]
    weights = class_weights(counts, EXPONENT, least=1e-4, most=4.0).clamp(min=0.05)
    assert network.classes.bias is not None
    with torch.no_grad():
        network.classes.bias -= arguments.share * weights.log()
    save(
        arguments.out,
        network,
        replace(card, recipe=f"{card.recipe}, {arguments.share:g} of the class weights taken back"),
    )


if __name__ == "__main__":
    main()
