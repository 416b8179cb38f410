"""Finish a scene painter: the power of class probabilities, and its colours.

    python runs/finish_painter.py PAINTER OUT FRAMES --look NAME [--power 4 | --class-colours | --glass]

Losses that compare images pixel by pixel make colours too even. Two numbers of the last layer, a gain and an offset
before its tanh, are set so that what is painted of FRAMES has the images' mean, and a deviation nearer to theirs: all
the way, shadows would lose their detail.
They also draw each class towards its median: an overexposed sky becomes white, and foliage dark. With --class-colours
it is the table of what the look adds to each class that is set instead, so that each class has the images' mean.
With --glass panes lose their texture: their colour is the linear function of what it hangs on that is nearest to what
is painted, the same for all looks.
FRAMES  what training kept of its frames (`options.cache`), as a pattern: 'frames/painting/*/kitti-mini-*.safetensors'.
Training draws powers at random, so that no weight depends on the power.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from lidar2pano.data.frames import IGNORE
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.losses import inside
from lidar2pano.models import build
from lidar2pano.models.card import load, save
from lidar2pano.models.scene_painter import (
    DEPTH,
    EDGE_PX,
    FAR_CODE,
    GLASS,
    OPENINGS,
    STRIDE,
    TONE,
    Known,
    ScenePainter,
    framed,
    outlined,
    painter_inputs,
    twice,
    with_cars,
)
from lidar2pano.views import VIEWS

EVERY, STEPS, SATURATED = 4, 20, 0.985
LEAST = 100_000  # pixels that a class needs: what one vehicle looks like is not what a class does
DAMPED = 1e-3  # ridge of the least squares for panes, by pixel
SHARE = 0.6  # of the way, in the logarithm of the gain
VIEW = VIEWS["panorama"].scaled(0.5)


@torch.inference_mode()
def paint(painter: ScenePainter, kept: dict[str, Tensor], look: str) -> tuple[Tensor, Tensor, Tensor]:
    """A frame painted (3, 2H, 2W) in [-1, 1], its segments (classes, H, W), and the painter's inputs (C, H, W)."""
    rows, columns = kept["camera"].shape
    columns -= columns % STRIDE
    channels = torch.zeros(1, 5, rows, columns)
    channels[0, 0], channels[0, 4] = kept["valid"][:, :columns], kept["remission"][:, :columns]
    window, depth_m = VIEW.window((VIEW.columns - columns) // 2, columns), kept["depth_m"][None, :, :columns].float()
    segments, depth_m, tones, _ = with_cars(kept["segments"][None, ..., :columns].float(), depth_m, window)
    segments = outlined(segments, painter.sharp, depth_m, window)
    inputs = painter_inputs(segments, depth_m, channels, window, known=Known(tones), unread=painter.unread)
    shares = torch.tensor([painter.look_shares(look)])
    with fast_arithmetic(torch.device("cpu")):
        painted = painter(*framed(*inputs), shares, torch.zeros(1, TONE))[0].float()
    return painted, segments[0], inputs[0][0].float()


def pixels(painter: ScenePainter, file: Path, look: str) -> tuple[Tensor, Tensor, Tensor]:
    """Of a frame's pixels that its camera saw: painted and real colours (3, N) in [-1, 1], and classes (N,) int64.

    Classes are those of the camera's image where the painted class is the same, and IGNORE elsewhere.
    """
    kept = load_file(file)
    painted, segments, _ = paint(painter, kept, look)
    columns = segments.shape[2]
    valid = kept["seen"][:, : 2 * columns]
    classes = kept["camera"][:, :columns].long()
    classes = twice(classes.where(classes == segments.argmax(0), IGNORE))
    return painted[:, valid], (kept["colour"][..., : 2 * columns].float() / 127.5 - 1)[:, valid], classes[valid]


def panes(painter: ScenePainter, file: Path, look: str) -> tuple[Tensor, Tensor]:
    """Of a frame's pixels inside of near panes: what their colour hangs on (GLASS, N), and painted colours (3, N)."""
    painted, _, inputs = paint(painter, load_file(file), look)
    known = inputs[-GLASS:]
    glass = (inside(known[None, OPENINGS], EDGE_PX)[0] > 0) & (inputs[DEPTH] < FAR_CODE)
    return known[:, glass], avg_pool2d(painted, 2)[:, glass]


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


def added(painted: Tensor, real: Tensor) -> Tensor:
    """What is added to values (3, N) before the tanh, (3,), for real colours' mean."""
    before, shift = torch.atanh(painted.clamp(-SATURATED, SATURATED)), torch.zeros(3)
    for _ in range(4 * STEPS):
        shift += real.mean(1) - torch.tanh(before + shift[:, None]).mean(1)
    return shift


def colours_of_all(finished: ScenePainter, painted: Tensor, real: Tensor) -> None:
    """Set the gain and the offset of the last layer."""
    gain, offset = fitted(painted, real)
    print(f"gain {gain:.3f}, offset {offset:.3f}")
    with torch.no_grad():
        finished.colour.weight *= gain
        cast(nn.Parameter, finished.colour.bias).mul_(gain).add_(offset)


def colours_of_classes(finished: ScenePainter, painted: Tensor, real: Tensor, classes: Tensor, look: str) -> None:
    """Set what the look adds to each class that enough pixels show."""
    assert finished.class_colours is not None
    table = finished.class_colours.weight.detach().view(len(finished.looks), TONE, len(COMMON15))
    for number, name in enumerate(COMMON15.classes):
        if int((here := classes == number).sum()) >= LEAST:
            shift = added(painted[:, here], real[:, here])
            table[finished.looks.index(look), :, number] += shift
            print(name, int(here.sum()), *(f"{value:.2f}" for value in shift.tolist()))


def colours_of_glass(finished: ScenePainter, known: Tensor, painted: Tensor) -> None:
    """Set the colours of panes."""
    assert finished.glass is not None
    before = torch.atanh(painted.clamp(-SATURATED, SATURATED))
    squares = known @ known.T + DAMPED * known.shape[1] * torch.eye(GLASS)  # tones are nearly alike in red, green, blue
    table = torch.linalg.solve(squares, known @ before.T).T
    rest = (before - table @ known).var() / before.var()
    print(f"{known.shape[1]} pixels, of whose variance {rest:.3f} is left")
    with torch.no_grad():
        finished.glass.weight.copy_(table.flatten())


def _joined(found: Iterable[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    return tuple(torch.cat(parts, -1) for parts in zip(*found, strict=True))


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("painter", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("frames")
    parser.add_argument("--look", default="")
    parser.add_argument("--power", type=float, default=0.0, help="default: the painter's own")
    parser.add_argument("--class-colours", action="store_true")
    parser.add_argument("--glass", action="store_true")
    arguments = parser.parse_args()
    network, card = load(arguments.painter, expect="scene-painter")
    settings = {**card.settings, "sharp": arguments.power or cast(ScenePainter, network).sharp}
    for switch in ("class_colours", "glass"):
        if getattr(arguments, switch):
            settings[switch] = True
    finished = cast(ScenePainter, build("scene-painter", **settings)).eval()
    finished.load_state_dict(finished.state_dict() | network.state_dict())
    look = arguments.look or finished.look
    start = Path(arguments.frames).anchor
    files = sorted(Path(start).glob(arguments.frames.removeprefix(start)))
    files = files if arguments.class_colours else files[::EVERY]
    print(f"{len(files)} frames")
    if arguments.glass:
        colours_of_glass(finished, *_joined(panes(cast(ScenePainter, network), file, look) for file in files))
    else:
        painted, real, classes = _joined(pixels(finished, file, look) for file in files)
        if arguments.class_colours:
            colours_of_classes(finished, painted, real, classes, look)
        else:
            colours_of_all(finished, painted, real)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save(arguments.out, finished, replace(card, settings=settings))


if __name__ == "__main__":
    main()
