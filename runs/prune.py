"""Make a network of a family narrower: a start for training with options.teacher.

    python runs/prune.py FAMILY ROLE OUT --data ROOT:SPLIT,... --settings '{"widths": [32, 48, 64, 128]}'

FAMILY  as for `lidar2pano translate --weights`;  ROLE: segmenter, translator or painter.
What the family makes of some scans of the data (--scans, 12) decides which channels stay (lidar2pano.models.pruning).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.data.layouts import frames_of
from lidar2pano.hardware import Timer
from lidar2pano.memory import Memory
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.card import save
from lidar2pano.models.families import weight_files
from lidar2pano.models.pruning import pruned
from lidar2pano.pipeline import Pipeline, load

IMAGE = 4  # dimensions of a batch of images
SHARE = 4  # one of so many parts of each scan's columns is used


def cropped(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """A random sector of all images of a call."""
    part = int(torch.randint(SHARE, ()))

    def sector(x: Tensor) -> Tensor:
        columns = x.shape[-1] // SHARE
        return x[..., part * columns : (part + 1) * columns].clone() if x.dim() == IMAGE else x.clone()

    return tuple(map(sector, inputs))


def with_network(pipeline: Pipeline, role: str, network: nn.Module) -> Pipeline:
    """The pipeline with another network."""
    if role == "segmenter":
        return replace(pipeline, segmenter=replace(pipeline.segmenter, network=network))
    parts: dict[str, Any] = {role: network}
    return replace(pipeline, **parts)


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family")
    parser.add_argument("role", choices=("segmenter", "translator", "painter"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", required=True)
    parser.add_argument("--settings", type=json.loads, required=True)
    parser.add_argument("--scans", type=int, default=12)
    arguments = parser.parse_args()
    files = weight_files(arguments.family)
    network, card = load_weights(files[arguments.role])
    pipeline = with_network(load(files, "cpu", "torch"), arguments.role, network)
    frames = [
        frame
        for root, split in (each.rsplit(":", 1) for each in arguments.data.split(","))
        for frame in frames_of(Path(root), (split,))
    ]

    inputs: list[tuple[Tensor, ...]] = []
    hook = network.register_forward_pre_hook(lambda _, given: inputs.append(cropped(given)))
    for number, index in enumerate(evenly_spaced(len(frames), arguments.scans)):
        timer = Timer(pipeline.device)
        translated = pipeline.translate(frames[index].scan, timer)
        if arguments.role == "painter":
            looks = cast(Any, network).looks
            of_look = replace(pipeline, look=looks[number % len(looks)] if number % 2 else "")
            of_look.paint(translated, Memory(), None, timer)
    hook.remove()
    settings = {**card.settings, **arguments.settings}
    smaller = pruned(card.network, network, settings, inputs)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save(arguments.out, smaller, replace(card, settings=settings, recipe=f"{card.recipe}, pruned"))


if __name__ == "__main__":
    main()
