#!/usr/bin/env python
"""What the paper's trainings cost: operations of a step, steps of the recipe, days on one H100; writes the table of
docs/semantic_kitti.md:
  runs/paper_arithmetic.py [--write]
Operations are counted by torch on networks without numbers (device meta), at the recipe's sizes; nothing is trained.
A backward pass counts twice a forward pass, the penalty of the critic's gradient (forward, gradient, and backward of
both) nine times. The share of the GPU's peak that such networks reach is an assumption, and said.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from lidar2pano.models import build
from lidar2pano.train.recipes import recipe_named
from lidar2pano.views import VIEWS

PAGE = Path(__file__).parent.parent / "docs" / "semantic_kitti.md"
MARK = "<!-- computed: runs/paper_arithmetic.py -->"
SCANS = {"fit": 17_929, "all": 43_552, "test": 20_351}  # of SemanticKITTI: sequences 00-07 and 09; 00-21; 11-21
PEAK_TFLOPS, SHARE = 400.0, 0.15  # H100, TF32 without sparsity, and what is assumed to be reached of it
QUADRO_TFLOPS = 16.3  # Quadro RTX 6000, float32
IMAGE = (376, 1241)


def gmacs(network: nn.Module, *shapes: tuple[int, ...]) -> float:
    """Billions of multiply-adds of a forward pass."""
    inputs: list[Tensor] = [torch.empty(shape, device="meta") for shape in shapes]
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network.to("meta").eval()(*inputs)
    return counter.get_total_flops() / 2e9


def forward_costs() -> dict[str, float]:
    """GMAC of each network for one frame, at the size at which the paper uses it."""
    front = (VIEWS["titan-front"].rows, VIEWS["titan-front"].columns)
    return {
        "SalsaNext": gmacs(build("salsanext", classes=20, channels=5), (1, 5, 64, 2048)),
        "TITAN-Net": gmacs(build("titan"), (1, 5, *front), (1, 20, *front)),
        "its critic": gmacs(build("titan-critic"), (1, 15, *IMAGE), (1, 20, *front)),
        "Pix2Pix": gmacs(build("pix2pix", inputs=25, outputs=15, size=IMAGE), (1, 25, *front)),
        "its critic ": gmacs(build("pix2pix-critic", channels=40), (1, 40, *IMAGE)),
        "SC-UNET": gmacs(build("scunet", inputs=1), (1, 1, *IMAGE)),
    }


def trainings(cost: dict[str, float]) -> list[tuple[str, float, float, int]]:
    """Network, epochs, GMAC per sample in training, samples of an epoch."""
    titan = 4 * cost["TITAN-Net"] + (2 * 3 + 9 + 2) * cost["its critic"]  # generated twice; real, fake, penalty, fake
    pix2pix = 3 * cost["Pix2Pix"] + (2 * 3 + 2) * cost["its critic "]
    epochs = {name: recipe_named(name).training.epochs for name in ("titan", "pix2pix-segments", "scunet")}
    salsanext = recipe_named("salsanext-published").training.epochs
    return [
        ("SalsaNext, as published", salsanext, 3 * cost["SalsaNext"], SCANS["fit"]),
        ("TITAN-Net (and each ablation)", epochs["titan"], titan, SCANS["fit"]),
        ("Pix2Pix", epochs["pix2pix-segments"], pix2pix, SCANS["fit"]),
        ("SC-UNET", epochs["scunet"], 3 * cost["SC-UNET"], SCANS["fit"]),
    ]


def table() -> str:
    """Markdown."""
    cost = forward_costs()
    rows = [
        "| training | epochs | GMAC a sample and step | EFLOP | days on one H100 |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name, epochs, per_sample, samples in trainings(cost):
        flop = 2e9 * per_sample * epochs * samples
        days = flop / (PEAK_TFLOPS * 1e12 * SHARE) / 86400
        rows.append(f"| {name} | {epochs:g} | {per_sample:.0f} | {flop / 1e18:.1f} | {days:.1f} |")
    theirs = 2e9 * trainings(cost)[1][2] * 118 * 19_000 / (6 * 86400 * 2 * QUADRO_TFLOPS * 1e12)
    forward = ", ".join(f"{name.strip()} {value:.1f}" for name, value in cost.items())
    return (
        f"Computed, not measured: {SHARE:.0%} of an H100's {PEAK_TFLOPS:g} TFLOPS (TF32) are assumed to be reached, and"
        " that samples\ncome as fast as they are used. The paper's training of TITAN-Net took six days on two Quadro"
        f" RTX 6000, which by the\nsame count is {theirs:.0%} of their {QUADRO_TFLOPS:g} TFLOPS each (float32).\n\n"
        + "\n".join(rows)
        + f"\n\nForward, GMAC a frame: {forward}."
    )


def main() -> None:
    """Print the table and, with --write, put it into the page."""
    text = table()
    print(text)
    if "--write" in sys.argv:
        page = PAGE.read_text(encoding="utf-8")
        head, _, rest = page.partition(MARK)
        tail = rest[rest.index("\n## ") :]
        PAGE.write_text(f"{head}{MARK}\n\n{text}\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
