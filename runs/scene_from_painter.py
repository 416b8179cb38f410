"""The weights of an old painter as the beginning of a scene painter: scene_from_painter.py OLD OUT LOOK...

What both have in common is carried over (the encoder, the trunk, the way back up to the translator's raster); the rest
is fresh. The old grain's weights go to the finest noise on that raster.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch

from lidar2pano.models import build
from lidar2pano.models.card import load, save


def transferred(old: dict[str, torch.Tensor], new: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The new state with what fits of the old."""
    result = dict(new)
    for name, value in new.items():
        source = old.get(name.replace("mix0.", "mix0.0."))
        if source is None:
            continue
        if source.shape == value.shape:
            result[name] = source
        elif source.ndim == 4 and source.shape[0] == value.shape[0] and source.shape[2:] == value.shape[2:]:
            extra = value.shape[1] - source.shape[1]  # shown channels stand last: 16 + 4 are shared, then grain
            kept = source.shape[1] - 1
            weight = value * 0.1
            weight[:, :kept] = source[:, :kept]
            weight[:, kept + extra - 2] = source[:, kept]
            result[name] = weight
    return result


def main(old: str, out: str, *looks: str) -> None:
    network, card = load(old, expect="painter")
    settings = {"looks": list(looks), "look": looks[0]}
    torch.manual_seed(0)
    scene = build("scene-painter", **settings)
    fresh = scene.state_dict()
    state = transferred(network.state_dict(), fresh)
    print(f"{sum(state[name] is not fresh[name] for name in fresh)} of {len(fresh)} tensors carried over")
    scene.load_state_dict(state)
    begun = replace(card, network="scene-painter", settings=settings, recipe=f"begun from {card.recipe}")
    save(Path(out), scene, begun)


if __name__ == "__main__":
    main(*sys.argv[1:])
