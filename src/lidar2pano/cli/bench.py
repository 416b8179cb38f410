"""lidar2pano bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.console import announced, print_weights
from lidar2pano.cli.options import DeviceOption, check_file, write_json


@app.command()
def bench(
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="How often each thing is timed, after a warm-up.")] = 5,
    weights: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="Weights; if none are installed: untrained ones, as fast."),
    ] = "",
    device: DeviceOption = "auto",
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME[,NAME...]", help="Engine of the networks (translate --help); several: stages side by side."
        ),
    ] = "auto",
    operations: Annotated[
        bool, typer.Option("--operations", help="Count the tensor operations of each stage of the demo scan instead.")
    ] = False,
    world: Annotated[bool, typer.Option("--world", help="Time the street world instead.")] = False,
    processes: Annotated[int, typer.Option(min=1, metavar="N", help="Processes of the street world.")] = 2,
    as_json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the times as JSON too.")] = None,
) -> None:
    """Time projection, clean-up, the Lovasz loss and every stage of the pipeline, or count tensor operations."""
    from lidar2pano import bench as measures
    from lidar2pano.engines import pick_engine
    from lidar2pano.hardware import keep_buffers, pick_device
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import weight_files

    if as_json:
        check_file(as_json, "--json")
    with announced(0, "measuring, which takes minutes"):
        if world:
            settings = {"device": "cpu", "runs": runs, "processes": processes}
            rows = measures.measure_world(runs, processes)
            text = measures.table(rows)
        elif operations:
            name = weights or measures.default_weights()
            settings = {"device": pick_device(device).type, "weights": name or "untrained"}
            rows = measures.measure_operations(name, device)
            text = measures.operations_table(rows)
        else:
            buffers_kept = keep_buffers()
            name = weights or measures.default_weights()
            engines = list(dict.fromkeys(part.strip() for part in engine.split(",")))
            settings = measures.conditions(device, runs) | {
                "weights": name or "untrained",
                "buffers_kept": buffers_kept,
            }
            if len(engines) > 1:
                rows = measures.compare(runs, device, name, engines)
                text = measures.comparison_table(rows)
            else:
                settings["engine"] = pick_engine(engine, pick_device(device))
                rows = measures.measure(runs, device, name, settings["engine"])  # "auto" would compile nothing
                text = measures.table(rows)
            if name:
                print_weights("", map(read_card, weight_files(name).values()))
    _report(settings, rows, text, as_json)


def _report(settings: dict[str, Any], rows: list[dict[str, Any]], text: str, as_json: Path | None) -> None:
    """Print the conditions and a table; write rows as JSON, too."""
    if as_json:
        write_json(as_json, settings | {"rows": rows}, "--json")
    words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in settings.items())
    print(f"{words}\n\n{text}")
