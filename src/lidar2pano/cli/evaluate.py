"""lidar2pano evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lidar2pano.cli.app import app, note_licences


@app.command()
def evaluate(
    weights: Annotated[
        list[str],
        typer.Argument(metavar="WEIGHTS|RUN...", help="Families, runs or weight files; several make columns."),
    ],
    data: Annotated[Path, typer.Option(metavar="ROOT", help="A data set in SemanticKITTI's layout.")],
    split: Annotated[str, typer.Option(metavar="NAME", help="Which of its splits.")] = "val",
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the scores as JSON.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="auto|cpu|cuda", help="Where to compute.")] = "auto",
) -> None:
    """Score what is made from the scan alone against the camera's classes; print a table in Markdown."""
    from lidar2pano.allocator import keep_buffers
    from lidar2pano.cli.files import check_file, write_json
    from lidar2pano.cli.progress import bar
    from lidar2pano.evaluate import contender, score

    if as_json:
        check_file(as_json, "--json")
    keep_buffers()
    from lidar2pano.data.sequences import frames

    found = frames(data, split)
    contenders = [contender(name, device) for name in dict.fromkeys(weights)]
    with bar(len(found), f"evaluating {split}") as advance:
        evaluation = score(contenders, found, data=data.resolve().name, split=split, after_each=advance)
    if as_json:
        write_json(as_json, evaluation.as_dict(), "--json")
    note_licences(weights)
    print(evaluation.table())
