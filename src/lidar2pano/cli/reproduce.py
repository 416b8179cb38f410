"""lidar2pano reproduce."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar2pano.cli.app import BROKEN, MISTAKE, app
from lidar2pano.cli.console import print_error, show_log
from lidar2pano.cli.options import check_folder, write_json
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from lidar2pano.reproduce import Plan


@app.command()
def reproduce(  # noqa: PLR0913, PLR0917 one parameter per option
    data: Annotated[Path, typer.Option(metavar="ROOT", help="A data set in SemanticKITTI's layout.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for runs, rows, images and RESULTS.md.")],
    split: Annotated[str, typer.Option(metavar="NAME", help="Which of its splits is scored.")] = "val",
    budget: Annotated[
        str,
        typer.Option(metavar="90s|20m|2h|5000steps", help="Training of each network; as in the recipe if not given."),
    ] = "",
    rows: Annotated[str, typer.Option(metavar="NAME,...", help="Rows of the tables; all when not given.")] = "",
    frames: Annotated[int, typer.Option(metavar="N", help="Score N frames, evenly over the split; 0 for all.")] = 0,
    segmenter: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="The LiDAR segmenter; one is trained when not given.")
    ] = "",
    form: Annotated[str, typer.Option(metavar="auto|mini|full", help="Which recipes; auto: mini on a CPU.")] = "auto",
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="PART.A.B=C", help="Change a recipe; repeatable.")
    ] = None,
    sdnet: Annotated[Path | None, typer.Option(metavar="FILE", help="A camera segmenter, as for evaluate.")] = None,
    inception: Annotated[Path | None, typer.Option(metavar="FILE", help="For FID, as for evaluate.")] = None,
    device: Annotated[str, typer.Option(metavar="auto|cpu|cuda", help="Where to compute.")] = "auto",
    devices: Annotated[int, typer.Option(min=1, metavar="N", help="GPUs or processes that train.")] = 1,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print the trainings, their length and disk, and what is missing; then leave."),
    ] = False,
) -> None:
    """Make the paper's tables: train what is missing, score every row, write DIR/RESULTS.md. Repeat to resume."""
    from lidar2pano.hardware import keep_buffers, pick_device
    from lidar2pano.reproduce import Plan
    from lidar2pano.reproduce.paper_tables import chosen
    from lidar2pano.reproduce.run import check_packages

    if form not in ("auto", "mini", "full"):
        raise InputError(f"--form {form!r} is none of auto, mini and full")
    check_folder(out, "--out")
    picked = pick_device(device).type
    keep_buffers()
    plan = Plan(
        data=data,
        out=out,
        split=split,
        budget=budget,
        rows=chosen(rows),
        mini=form == "mini" or (form == "auto" and picked == "cpu"),
        frames=frames,
        segmenter=segmenter,
        device=picked,
        devices=devices,
        sdnet=sdnet,
        inception=inception,
        changes=tuple(changes or ()),
    )
    if dry_run:
        print_plan(plan)
    else:
        check_packages(plan)
        run_plan(plan)


def print_plan(plan: Plan) -> None:
    """Print a plan; typer.Exit if it lacks something."""
    from lidar2pano.reproduce.run import describe

    lines, missing = describe(plan)
    print("\n".join(lines))
    for lack in missing:
        print_error(f"missing: {lack}")
    if missing:
        raise typer.Exit(MISTAKE)


def run_plan(plan: Plan) -> None:
    """Run the plan and write its results; typer.Exit if a part or a row failed."""
    from lidar2pano.cli.evaluate import write_csv
    from lidar2pano.reproduce import reproduce as run
    from lidar2pano.reproduce.results_page import records, write_results_page

    show_log()
    outcome = run(plan)
    written = write_results_page(plan, outcome)
    write_json(plan.out / "results.json", {"results": outcome.results, "failures": outcome.failures}, "--out")
    write_csv(plan.out / "results.csv", records(plan, outcome), "--out")
    print(written)
    if outcome.failures:
        print_error(f"{len(outcome.failures)} parts or rows failed: {', '.join(outcome.failures)}; see {written}")
        raise typer.Exit(BROKEN)
