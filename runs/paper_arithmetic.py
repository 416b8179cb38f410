#!/usr/bin/env python
"""What the full reproduction's stages cost: operations of a sample, samples, hours on one H100; writes the table
of docs/semantic_kitti.md:
  runs/paper_arithmetic.py [--write]
Operations are counted by torch without computing (fake tensors), at the recipe's sizes; nothing is trained.
A backward pass counts twice a forward pass, the penalty of the critic's gradient (forward, gradient, and backward of
both) nine times. The share of the GPU's peak that such networks reach is an assumption, and said.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import cast

import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from lidar2pano.models import build
from lidar2pano.models.latent_painter import CONDITIONS, FOLD, LatentPainter
from lidar2pano.train.recipe import Network, Recipe
from lidar2pano.train.recipes import recipe_named
from lidar2pano.views import VIEWS

PAGE = Path(__file__).parent.parent / "docs" / "semantic_kitti.md"
MARK = "<!-- computed: runs/paper_arithmetic.py -->"
SCANS = {"fit": 17_929, "all": 43_552, "test": 20_351}  # of SemanticKITTI: sequences 00-07 and 09; 00-21; 11-21
PEAK_TFLOPS, SHARE = 400.0, 0.15  # H100, TF32 without sparsity, and what is assumed to be reached of it
QUADRO_TFLOPS = 16.3  # Quadro RTX 6000, float32
IMAGE = (376, 1241)
# Trainings of `reproduce --form full --segmenter FILE --sdnet FILE`: TITAN-Net and three ablations, two of Pix2Pix ...
TIMES_IN_TABLES = {
    "TITAN-Net (and each ablation)": 4, "TITAN-Next": 1, "vid2vid": 1, "Pix2Pix": 2, "SC-UNET": 1, "titan-pano": 1,
    "autoencoder, without its critic": 1, "latent-painter": 1,
}  # fmt: skip


def gmacs(network: nn.Module, *shapes: tuple[int, ...]) -> float:
    """Billions of multiply-adds of a forward pass."""
    with FakeTensorMode(allow_non_fake_inputs=True), FlopCounterMode(display=False) as counter, torch.no_grad():
        network.eval()(*(torch.empty(shape) for shape in shapes))
    return counter.get_total_flops() / 2e9


def forward_costs() -> dict[str, float]:
    """GMAC of each network for one frame, at the size at which the paper, or our recipe, uses it."""
    front = (VIEWS["titan-front"].rows, VIEWS["titan-front"].columns)
    sdnet, video, pano = (recipe_named(name) for name in ("sdnet", "vid2vid", "titan-pano"))
    clip = (video.options.rows, video.options.columns)
    crop = (VIEWS[pano.view].scaled(pano.scale).rows, pano.options.columns)
    size, painter = recipe_named("autoencoder").options.size, recipe_named("latent-painter")
    image_critic, temporal_critic = (video.networks[role] for role in ("critic", "temporal_1"))
    return {
        "SalsaNext": gmacs(build("salsanext", classes=20, channels=5), (1, 5, 64, 2048)),
        "TITAN-Net": gmacs(build("titan"), (1, 5, *front), (1, 20, *front)),
        "its critic": gmacs(build("titan-critic"), (1, 15, *IMAGE), (1, 20, *front)),
        "TITAN-Next": gmacs(build("titan-next"), (1, 5, *front), (1, 20, *front)),
        "Pix2Pix": gmacs(build("pix2pix", inputs=25, outputs=15, size=IMAGE), (1, 25, *front)),
        "its critic ": gmacs(build("pix2pix-critic", channels=40), (1, 40, *IMAGE)),
        "SC-UNET": gmacs(build("scunet", inputs=1), (1, 1, *IMAGE)),
        "SD-Net": gmacs(network_of(sdnet.networks["camera"]), (1, 3, sdnet.options.rows, sdnet.options.columns)),
        "vid2vid": gmacs(network_of(video.networks["painter"]), (1, 3, 16, *clip), (1, 2, 3, *clip)),
        "its critics": gmacs(network_of(image_critic), (1, 19, *clip)),
        "its temporal critics": gmacs(network_of(temporal_critic), (1, 13, *clip)),
        "titan-pano": gmacs(network_of(pano.networks["translator"]), (1, 5, *crop), (1, 20, *crop)),
        "autoencoder": gmacs(build("autoencoder"), (1, 3, size, size)),
        "latent-painter": gmacs(network_of(painter.networks["painter"]), *painter_inputs(painter)),
    }


def network_of(network: Network) -> nn.Module:
    """Build a recipe's network."""
    return build(network.model, **network.settings)


def painter_inputs(recipe: Recipe) -> list[tuple[int, ...]]:
    """Shapes of what the latent painter reads in a step, for a crop of its recipe: as of LatentPainter.forward."""
    rows, columns = VIEWS[recipe.view].scaled(recipe.scale).rows, recipe.options.columns
    network = cast("LatentPainter", network_of(recipe.networks["painter"]))
    raster = rows // FOLD, columns // FOLD
    looks, latents = (1, len(network.looks)), network.latents
    noisy, photograph = (1, latents, *raster), (1, latents + 1, *raster)
    return [(1, CONDITIONS, rows, columns), looks, noisy, (1,), (1,), (1,), photograph, (1, 2 * latents + 1)]


def trainings(cost: dict[str, float]) -> list[tuple[str, float, float]]:
    """Training, samples that it sees, GMAC per sample."""
    titan, next_, pix2pix = (
        4 * cost[name] + (2 * 3 + 9 + 2) * cost["its critic"]  # generated twice; real, fake, penalty, fake
        if "TITAN" in name
        else 3 * cost[name] + (2 * 3 + 2) * cost["its critic "]
        for name in ("TITAN-Net", "TITAN-Next", "Pix2Pix")
    )
    labelled = IMAGE[0] * IMAGE[1] / recipe_named("sdnet").options.rows / recipe_named("sdnet").options.columns
    # the critic sees a real and two fakes, each temporal critic a real and a fake; then the painter's turn
    critics = (3 * 3 + 1 + 2 * 3) * cost["its critics"] + 2 * (2 * 3 + 1 + 3) * cost["its temporal critics"]
    return [
        ("SalsaNext, as published", seen("salsanext-published"), 3 * cost["SalsaNext"]),
        ("SD-Net, on Cityscapes", seen("sdnet"), 3 * cost["SD-Net"]),
        ("TITAN-Net (and each ablation)", seen("titan"), titan),
        ("TITAN-Next", seen("titan-next"), next_),
        ("vid2vid", seen("vid2vid") * recipe_named("vid2vid").options.clip_length, 3 * cost["vid2vid"] + critics),
        ("Pix2Pix", seen("pix2pix-segments"), pix2pix),
        ("SC-UNET", seen("scunet"), 3 * cost["SC-UNET"]),
        ("titan-pano", seen("titan-pano"), 3 * cost["titan-pano"]),
        ("autoencoder, without its critic", seen("autoencoder"), 3 * cost["autoencoder"]),
        ("latent-painter", seen("latent-painter"), 3 * cost["latent-painter"]),
        ("`prepare`: labels of all images and scans", SCANS["all"], labelled * cost["SD-Net"] + cost["SalsaNext"]),
        ("`evaluate` of a row on `test`", SCANS["test"], cost["SalsaNext"] + cost["TITAN-Net"] + cost["vid2vid"]),
    ]


def seen(name: str) -> float:
    """Samples that a recipe's training sees."""
    training = recipe_named(name).training
    return training.epochs * SCANS["fit"] if training.epochs else training.steps * training.batch


def table() -> str:
    """Markdown."""
    cost = forward_costs()
    rows = [
        "| stage | samples, thousands | GMAC a sample | EFLOP | hours on one H100 |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    hours, titan = 0.0, 0.0
    for name, samples, per_sample in trainings(cost):
        flop = 2e9 * per_sample * samples
        stage_hours = flop / (PEAK_TFLOPS * 1e12 * SHARE) / 3600
        rows.append(f"| {name} | {samples / 1000:.0f} | {per_sample:.0f} | {flop / 1e18:.2f} | {stage_hours:.1f} |")
        hours += TIMES_IN_TABLES.get(name, 0) * stage_hours
        titan = per_sample if name.startswith("TITAN-Net") else titan
    theirs = 2e9 * titan * 118 * 19_000 / (6 * 86400 * 2 * QUADRO_TFLOPS * 1e12)
    forward = ", ".join(f"{name.strip()} {value:.1f}" for name, value in cost.items())
    return (
        f"Computed, not measured: {SHARE:.0%} of an H100's {PEAK_TFLOPS:g} TFLOPS (TF32) are assumed to be reached, and"
        " that samples\ncome as fast as they are used, which reading and scoring on a few cores will not do for the"
        " last two rows: there the hours are\na lower bound. The paper's training of TITAN-Net took six days on two"
        f" Quadro RTX 6000, which by the\nsame count is {theirs:.0%} of their {QUADRO_TFLOPS:g} TFLOPS each (float32)."
        "\n\n" + "\n".join(rows) + f"\n\nAll trainings of step 5 with a given segmenter and SD-Net: {hours:.0f} hours."
        f"\n\nForward, GMAC a frame: {forward}."
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
