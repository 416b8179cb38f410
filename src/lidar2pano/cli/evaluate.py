"""lidar2pano evaluate."""

from __future__ import annotations

import csv
import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.console import bar, print_note
from lidar2pano.cli.options import ElevationOption, EngineOption, check_file, check_folder, write_json
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from lidar2pano.data.frames import Frame
    from lidar2pano.evaluate import Evaluation, MetricConfig, System
    from lidar2pano.evaluate.evaluation import EvaluatedSystem
    from lidar2pano.evaluate.folds import Fold
    from lidar2pano.evaluate.metric_collection import PatchFeatures
    from lidar2pano.evaluate.pictures import Preferences
    from lidar2pano.pipeline import Pipeline


MetricsOption = Annotated[
    str | None,
    typer.Option(
        metavar="LIST",
        help="Of points, classes, pictures, depth, seams, time, roll and camera, panorama, with commas between; all but"
        " roll when not given.",
    ),
]
PairsOption = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Also write a page on which a person chooses between two systems' panoramas."),
]
OutOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for the images of --worst, or of the views of --leave-out.")
]
LeaveOutOption = Annotated[
    str,
    typer.Option(
        metavar="CAMERA|each",
        help="Hide this camera, or each in turn, and predict its view without and with the other cameras.",
    ),
]
FoldsOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=ROOT:SPLIT",
        help="A place, city or sensor that is scored whole, instead of --data; repeatable. {fold} in WEIGHTS is its"
        " name: weights that have not seen it.",
    ),
]


@app.command()
def evaluate(  # noqa: PLR0913, PLR0917 one parameter per option
    weights: Annotated[
        list[str],
        typer.Argument(
            metavar="WEIGHTS|RUN",
            help="Families, runs, weight files, or chains TRANSLATOR+PAINTER (oracle+PAINTER: ground-truth labels;"
            " NAME+steady: video smoothed over time by poses).",
        ),
    ],
    data: Annotated[
        Path | None, typer.Option(metavar="ROOT", help="A data set: SemanticKITTI's layout, or surround cameras.")
    ] = None,
    split: Annotated[str, typer.Option(metavar="NAME", help="One of its splits.")] = "val",
    metrics: MetricsOption = None,
    sensor: Annotated[str, typer.Option(metavar="NAME", help="Sensor of the scans, e.g. pandar64.")] = "",
    sdnet: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A camera segmenter: FSD, and re-segmentation mIoU.")
    ] = None,
    inception: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Inception's published weights, for FID (or in torch's cache).")
    ] = None,
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the scores as JSON.")
    ] = None,
    as_csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Also write every value as CSV.")] = None,
    worst: Annotated[int, typer.Option(min=0, metavar="N", help="Also list the N worst frames, with images.")] = 0,
    out: OutOption = None,
    pairs: PairsOption = None,
    leave_out: LeaveOutOption = "",
    folds: FoldsOption = None,
    elevation: ElevationOption = "",
    device: Annotated[str, typer.Option(metavar="auto|cpu|cuda", help="Where to compute.")] = "auto",
    engine: EngineOption = "torch",  # scores do not depend on what is installed
) -> None:
    """Score predictions from the scan alone against camera images and labels; print a table in Markdown."""
    from lidar2pano.evaluate import MetricConfig, system
    from lidar2pano.evaluate.folds import Fold, parse_folds
    from lidar2pano.hardware import keep_buffers

    if worst and not (out or folds or leave_out):
        raise InputError("--worst needs a folder for its images; add --out DIR")
    if out and not worst and not leave_out:
        raise InputError("--out is for images of --worst or --leave-out; add one of them")
    check_outputs(as_json, as_csv, out, pairs)
    keep_buffers()
    config = MetricConfig.parse(metrics, inception=inception, sdnet=sdnet, device=device)
    build = partial(system, device=device, sensor=sensor, engine=engine, elevation=elevation)
    if folds:
        refuse_beside("--folds", {"--data": data, "--worst": worst, "--pairs": pairs, "--leave-out": leave_out})
        scores = score_folds(weights, parse_folds(folds), build, config)
    elif data is None:
        raise InputError("nothing to score: say --data ROOT, or --folds NAME=ROOT:SPLIT for each of some places")
    elif leave_out:
        unused = {"--metrics": metrics, "--worst": worst, "--pairs": pairs}
        refuse_beside("--leave-out", unused | {"--sdnet": sdnet, "--inception": inception, "--sensor": sensor})
        pipeline = load_reaching(weights, device, engine, elevation)
        scores = leave_out_cameras(pipeline, Fold(split, data, split), leave_out, out, config.patches)
    else:
        scores = score_split(dict.fromkeys(weights), Fold(split, data, split), build, config, worst, out, pairs)
    scores.report(as_json, as_csv)


class Scores(NamedTuple):
    """The summary for JSON, the rows for CSV, the table in Markdown, notes of licences, and what writes pictures."""

    summary: dict[str, Any]
    rows: list[dict[str, object]]
    table: str
    licences: list[str | None]
    pictures: Sequence[Callable[[], None]] = ()

    def report(self, as_json: Path | None, as_csv: Path | None) -> None:
        """Write the requested files, print licences and the table; pictures are last, so that no score is lost."""
        if as_json:
            write_json(as_json, self.summary, "--json")
        if as_csv:
            write_csv(as_csv, self.rows, "--csv")
        for note in filter(None, dict.fromkeys(self.licences)):
            print_note(note)
        print(self.table)
        for write in self.pictures:
            write()


def score_split(
    names: Iterable[str],
    place: Fold,
    build: Callable[[str], System],
    config: MetricConfig,
    worst: int,
    out: Path | None,
    pairs: Path | None,
) -> Scores:
    """Score one split; pictures are the sheets of the worst frames, and the page of pairs."""
    from lidar2pano.evaluate import report
    from lidar2pano.evaluate.pictures import Preferences
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import licence_note

    systems = [build(name) for name in names]
    preferences = Preferences(pairs, [system.info.name for system in systems]) if pairs else None
    evaluation = score_place(systems, place, config, worst, preferences)
    summary = report.as_dict(evaluation)
    pictures: list[Callable[[], None]] = []
    if out:
        pictures.append(partial(write_worst, evaluation, out))
    if preferences:
        pictures.append(lambda: print_note(f"choose between the panoramas: {preferences.write()}"))
    licences = [licence_note(map(read_card, system.info.files.values())) for system in systems]
    return Scores(summary, report.records(summary), report.table(summary), licences, pictures)


def score_folds(
    names: Sequence[str], folds: Sequence[Fold], build: Callable[[str], System], config: MetricConfig
) -> Scores:
    """Score every fold, and the means over folds."""
    from lidar2pano.evaluate.folds import PLACEHOLDER, common_values, compared, scores_of, table

    folded: dict[str, dict[str, dict[str, float]]] = {name: {} for name in names}
    parts: list[Scores] = []
    for fold in folds:
        weights = [name.replace(PLACEHOLDER, fold.name) for name in folded]
        parts.append(score_split(weights, fold, build, config, 0, None, None))
        for name, result in zip(folded, parts[-1].summary["results"], strict=True):
            folded[name][fold.name] = scores_of(result)
        common_values(folded)  # says now, not after the last fold, that there is none
    comparison = compared(folded)
    rows = [{"fold": fold.name, **row} for fold, part in zip(folds, parts, strict=True) for row in part.rows]
    return Scores(comparison, rows, table(comparison), [note for part in parts for note in part.licences])


def score_place(
    systems: Sequence[System], place: Fold, config: MetricConfig, worst: int, preferences: Preferences | None
) -> Evaluation:
    """Score systems on all frames of a split, with a bar."""
    from lidar2pano.data.layouts import frames
    from lidar2pano.evaluate import score

    scored, data = frames(place.root, place.split), place.root.resolve().name
    with bar(len(scored), f"evaluating {place.name}") as advance:

        def note(frame: Frame, evaluated: Sequence[EvaluatedSystem]) -> None:
            if preferences:
                preferences.take(frame.name, frame.image, [system.image for system in evaluated])
            advance()

        return score(systems, scored, data=data, split=place.split, config=config, worst=worst, after_each=note)


def load_reaching(weights: Sequence[str], device: str, engine: str, elevation: str) -> Pipeline:
    """Load the only family's pipeline, of taller panoramas if an elevation is named."""
    from lidar2pano.pipeline import load

    if len(weights) != 1:
        raise InputError(f"--leave-out scores one family of weights, not {len(weights)}; name one")
    pipeline = load(weights[0], device, engine)
    return pipeline.reaching(elevation) if elevation else pipeline


def leave_out_cameras(
    pipeline: Pipeline, place: Fold, leave_out: str, out: Path | None, patches: Mapping[str, PatchFeatures]
) -> Scores:
    """Score the views of hidden cameras, and write a sheet of each into `out`."""
    from lidar2pano.data.layouts import frames
    from lidar2pano.evaluate.hidden_cameras import records, score_hidden, table
    from lidar2pano.models.families import licence_note

    scored = frames(place.root, place.split)
    with bar(len(scored), f"hiding {leave_out}") as advance:
        summary = score_hidden(pipeline, scored, leave_out, patches, sheets=out, after_each=advance).as_dict()
    return Scores(summary, records(summary), table(summary), [licence_note(pipeline.cards.values())])


def refuse_beside(option: str, values: Mapping[str, object]) -> None:
    """Raise InputError if any of these options, by name, has a value: `option` does not use them."""
    if used := [name for name, value in values.items() if value]:
        raise InputError(f"{option} has no use for {', '.join(used)}; leave that out")


def check_outputs(as_json: Path | None, as_csv: Path | None, *folders: Path | None) -> None:
    """Check the places of the requested files; InputError for one without write access."""
    for path, option in ((as_json, "--json"), (as_csv, "--csv")):
        if path:
            check_file(path, option)
    for folder, option in zip(folders, ("--out", "--pairs"), strict=False):
        if folder:
            check_folder(folder, option)


def write_worst(evaluation: Evaluation, out: Path) -> None:
    """Write the sheets of the worst frames, a folder per system (1, 2, ...), and worst.csv with the list of them."""
    from lidar2pano.formats.image_files import write_png, write_whole

    rows: list[dict[str, object]] = []
    for number, system in enumerate(evaluation.systems, 1):
        for rank, frame in enumerate(system.worst.held, 1):
            image, sheet = "", frame.sheet
            if sheet is not None:
                image = f"{number}/{rank:03d}-{frame.name.replace('/', '-')}.png"
                write_whole(out / image, lambda file, sheet=sheet: write_png(file, sheet))
            ranked = {"rank": rank, "frame": frame.name, "metric": frame.metric, "value": frame.value}
            rows.append({"system": system.system.info.name, **ranked, "image": image})
    write_csv(out / "worst.csv", rows, "--out")


def write_csv(path: Path, rows: list[dict[str, object]], option: str) -> None:
    """Write rows with the same keys as CSV, beside and then renamed; InputError where that fails."""
    from lidar2pano.formats.image_files import write_text

    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0] if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue(), option)
