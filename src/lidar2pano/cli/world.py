"""lidar2pano world."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.console import bar
from lidar2pano.cli.options import check_folder


@app.command()
def world(  # noqa: PLR0913, PLR0917 each is an option
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the data set; one that exists is completed.")],
    sequences: Annotated[int, typer.Option(min=1, metavar="N", help="Drives, each through a town of its own.")] = 1,
    frames: Annotated[int, typer.Option(min=1, metavar="M", help="Frames of each drive.")] = 20,
    hz: Annotated[
        float, typer.Option("--hz", metavar="HZ", help="Frames a second; 1 for more variety in fewer frames.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(metavar="S", help="The same seed gives the same bytes.")] = 0,
    sensor: Annotated[
        str, typer.Option(metavar="NAME", help="LiDAR: hdl64e, hdl32e, vlp16, os1-64, os1-128, pandar64.")
    ] = "hdl64e",
    look: Annotated[str, typer.Option(metavar="NAME", help="day, overcast, evening or autumn: same scenes.")] = "day",
    place: Annotated[
        str, typer.Option(metavar="NAME", help="residential, avenue, outskirts, country, motorway, centre; else mixed.")
    ] = "",
    sensor_height: Annotated[float, typer.Option(metavar="M", help="Metres above the road.")] = 1.73,
    save: Annotated[
        str, typer.Option(metavar="LIST", help="scans, camera, panorama, separated by commas; or all.")
    ] = "all",
    view: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Raster of the panorama: panorama, panorama-tall, panorama/2; repeatable."),
    ] = None,
    processes: Annotated[int, typer.Option(min=0, metavar="N", help="Processes (0 = one a core).")] = 0,
) -> None:
    """Make a simulated data set in SemanticKITTI's layout, with ground truth all around."""
    from lidar2pano.simulate.generation import generate
    from lidar2pano.simulate.settings import SAVES, WorldSettings

    check_folder(out, "OUT")
    words = tuple(word.strip() for word in save.split(",") if word.strip())
    settings = WorldSettings(
        seed=seed,
        frames=frames,
        hz=hz,
        sensor=sensor,
        look=look,
        place=place,
        sensor_height=sensor_height,
        save=SAVES if "all" in words else tuple(word for word in words if word != "scans"),
        views=tuple(view or ["panorama"]),
    )
    with bar(sequences * frames, "frames") as advance:
        for done in generate(out, settings, sequences, processes or os.cpu_count() or 1):
            for _ in range(done):
                advance()
    print(out)
