"""Finish a scene painter: the power of class probabilities, and the mean and spread of its colours.

    python runs/finish_painter.py PAINTER OUT FRAMES --look NAME --power 4

Losses that compare images pixel by pixel make colours too even. Two numbers of the last layer, a gain and an offset
before its tanh, are set so that what is painted of FRAMES has the images' mean, and a deviation nearer to theirs: all
the way, shadows would lose their detail.
FRAMES  what training kept of its frames (`options.cache`), as a pattern: 'frames/painting/*/kitti-mini-*.safetensors'.
Training draws powers at random, so that no weight depends on the power.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from lidar2pano.hardware import fast_arithmetic
from lidar2pano.models import build
from lidar2pano.models.card import load, save
from lidar2pano.models.scene_painter import STRIDE, TONE, ScenePainter, outlined, painter_inputs, with_cars
from lidar2pano.views import VIEWS

EVERY, STEPS, SATURATED = 4, 20, 0.985
SHARE = 0.6  # of the way, in the logarithm of the gain
VIEW = VIEWS["panorama"].scaled(0.5)


@torch.inference_mode()
def pixels(painter: ScenePainter, file: Path, look: str, power: float) -> tuple[Tensor, Tensor]:
    """Painted and real colours (3, N) in [-1, 1] of a frame's pixels that its camera saw."""
    kept = load_file(file)
    rows, columns = kept["camera"].shape
    columns -= columns % STRIDE
    channels = torch.zeros(1, 5, rows, columns)
    channels[0, 0], channels[0, 4] = kept["valid"][:, :columns], kept["remission"][:, :columns]
    window, depth_m = VIEW.window((VIEW.columns - columns) // 2, columns), kept["depth_m"][None, :, :columns].float()
    segments, depth_m, tones = with_cars(kept["segments"][None, ..., :columns].float(), depth_m, window)
    segments = outlined(segments, power, depth_m, window)
    inputs = painter_inputs(segments, depth_m, channels, window, tones=tones, unread=painter.unread)
    shares = torch.tensor([painter.look_shares(look)])
    with fast_arithmetic(torch.device("cpu")):
        painted = painter(*inputs, shares, torch.zeros(1, TONE))[0].float()
    valid = kept["seen"][:, : 2 * columns]
    return painted[:, valid], (kept["colour"][..., : 2 * columns].float() / 127.5 - 1)[:, valid]


def fitted(painted: Tensor, real: Tensor) -> tuple[float, float]:
    """Gain and offset of the values before the tanh: for real colours' deviation, of which SHARE is taken, and mean."""
    before, gain, offset = torch.atanh(painted.clamp(-SATURATED, SATURATED)), 1.0, 0.0
    for _ in range(STEPS):
        now = torch.tanh(gain * before + offset)
        gain *= float(real.std() / now.std())
        offset += float(real.mean() - torch.tanh(gain * before + offset).mean())
    gain = gain**SHARE
    for _ in range(STEPS):
        offset += float(real.mean() - torch.tanh(gain * before + offset).mean())
    return gain, offset


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("painter", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("frames")
    parser.add_argument("--look", default="")
    parser.add_argument("--power", type=float, default=2.0)
    arguments = parser.parse_args()
    network, card = load(arguments.painter, expect="scene-painter")
    settings = {**card.settings, "sharp": arguments.power}
    finished = cast(ScenePainter, build("scene-painter", **settings)).eval()
    finished.load_state_dict(network.state_dict())
    start = Path(arguments.frames).anchor
    files = sorted(Path(start).glob(arguments.frames.removeprefix(start)))[::EVERY]
    pairs = [pixels(finished, file, arguments.look, arguments.power) for file in files]
    painted, real = (torch.cat(parts, 1) for parts in zip(*pairs, strict=True))
    gain, offset = fitted(painted, real)
    print(f"{len(files)} frames: gain {gain:.3f}, offset {offset:.3f}")
    with torch.no_grad():
        finished.colour.weight *= gain
        cast(nn.Parameter, finished.colour.bias).mul_(gain).add_(offset)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save(arguments.out, finished, replace(card, settings=settings))


if __name__ == "__main__":
    main()
