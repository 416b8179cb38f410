"""lidar2pano train."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.console import show_log
from lidar2pano.cli.options import DeviceOption
from lidar2pano.train.recipes import RECIPES

if TYPE_CHECKING:
    from lidar2pano.train.recipe import Recipe


@app.command(epilog=f"Recipes (-mini: minutes on two CPU cores): {', '.join(RECIPES)}.")
def train(
    recipe: Annotated[str, typer.Argument(metavar="RECIPE", help="Name of a recipe (list below), e.g. titan-pano.")],
    data: Annotated[
        Path,
        typer.Option(metavar="ROOT", help="A data set: SemanticKITTI's layout, KITTI-360, nuScenes or PandaSet."),
    ],
    out: Annotated[Path, typer.Option(metavar="RUN", help="The run's folder; one that exists is resumed.")],
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="A.B=C", help="Change a value of the recipe; repeatable.")
    ] = None,
    device: DeviceOption = "auto",
    devices: Annotated[int, typer.Option(min=1, metavar="N", help="GPUs or processes per node.")] = 1,
    nodes: Annotated[int, typer.Option(min=1, metavar="N", help="Machines that train together.")] = 1,
) -> None:
    """Train a network. Repeat the command to resume, whatever ended it."""
    from lidar2pano.train.recipe import override
    from lidar2pano.train.recipes import recipe_named

    chosen = recipe_named(recipe)
    for change in changes or []:
        chosen = override(chosen, change)
    first = os.environ.get("LOCAL_RANK", "0") == "0"
    if first:
        print(brief(chosen), flush=True)
    from lidar2pano.hardware import keep_buffers
    from lidar2pano.train.engine import train as run

    keep_buffers()
    show_log()
    weights = run(chosen, data, out, device=device, devices=devices, num_nodes=nodes)
    if first:
        print(f"weights: {weights}")


def brief(recipe: Recipe) -> str:
    """Return the resolved recipe in a few lines."""
    options = ", ".join(f"{name}={value}" for name, value in asdict(recipe.options).items() if value != "")
    lines = [f"recipe {recipe.name}: {recipe.task} on {recipe.view} x {recipe.scale:g}; {options}"]
    for name, network in recipe.networks.items():
        optimizer = network.optimizer
        start = f", from {network.start}" if network.start else ""
        lines.append(f"  {name}: {network.model}, {optimizer.algorithm} {optimizer.rate:g} {optimizer.schedule}{start}")
    training = recipe.training
    limit = f" or {training.epochs:g} epochs" if training.epochs else ""
    limit += f" or {training.minutes:g} minutes" if training.minutes else ", no limit of time"
    lines.append(
        f"  {training.steps} steps{limit}, batches of {training.batch}, seed {training.seed}, {training.precision};"
        f" data: {' + '.join(recipe.data.train)}, scored on {' + '.join(recipe.data.val)}"
    )
    return "\n".join(lines)
