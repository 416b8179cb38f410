"""lidar2pano prepare."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar2pano.cli.app import MISTAKE, app
from lidar2pano.cli.console import bar, print_error, print_note
from lidar2pano.cli.options import BEST, DeviceOption
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from lidar2pano.data.frames import FrameList
    from lidar2pano.data.semantic_kitti import SemanticKittiFrame
    from lidar2pano.prepare import LabelledFile, Teacher

NO_TEACHER = "none"
OPTIONS = {".label": "--labels-folder", ".png": "--camera-labels-folder"}
TAKEN = ("velodyne", "image_2", "image_3", "calib", "pano")  # folders of a sequence with other contents


@app.command()
def prepare(  # noqa: PLR0913, PLR0917 one parameter per option
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="A data set in SemanticKITTI's layout.")],
    lidar: Annotated[
        str, typer.Option(metavar="NAME|FILE|none", help="Teacher of scans: a family, a run or a weight file.")
    ] = BEST,
    teacher: Annotated[
        str,
        typer.Option(
            metavar="FILE|KIND:PATH|none",
            help="Teacher of camera images: weights of sdnet, mask2former:PATH or oneformer:PATH (a folder, or a model"
            " in the hub's cache).",
        ),
    ] = NO_TEACHER,
    split: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this split; repeatable (all sequences).")
    ] = None,
    scales: Annotated[
        str, typer.Option(metavar="LIST", help="Scales of camera images for the teacher, e.g. 0.5,1,2 (its own).")
    ] = "",
    min_probability: Annotated[
        float,
        typer.Option("--unsure", metavar="P", help="Pixels whose best class is less probable than this become 255."),
    ] = 0.4,
    labels_folder: Annotated[
        str, typer.Option(metavar="NAME", help="Folder of each sequence for the labels of scans.")
    ] = "labels",
    camera_labels_folder: Annotated[
        str, typer.Option(metavar="NAME", help="Folder of each sequence for the labels of camera images.")
    ] = "camera_labels",
    device: DeviceOption = "auto",
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON per frame on stdout.")] = False,
) -> None:
    """Let teachers label a data set's scans and camera images. Repeat the command to go on; files of others stay."""
    if lidar == NO_TEACHER == teacher:
        raise InputError("--lidar none --teacher none: no teacher is left; name one of the two")
    folders = (
        _folder_name(labels_folder, "--labels-folder"),
        _folder_name(camera_labels_folder, "--camera-labels-folder"),
    )
    if folders[0] == folders[1]:
        raise InputError(f"--camera-labels-folder {folders[1]}: is the folder for the labels of scans; choose another")
    factors = _factors(scales)
    from lidar2pano.prepare import camera_teacher, frames_to_label, lidar_teacher
    from lidar2pano.prepare.teachers import check_camera_settings

    check_camera_settings(factors, min_probability)
    teachers: list[Teacher] = []
    if lidar != NO_TEACHER:
        teachers.append(lidar_teacher(lidar, folder=folders[0], device=device))
    if teacher != NO_TEACHER:
        camera = camera_teacher(
            teacher, folder=folders[1], scales=factors, min_probability=min_probability, device=device
        )
        teachers.append(camera)
    frames = frames_to_label(root, split or [])
    if teacher == NO_TEACHER and any(frame.image_file for frame in frames):
        print_note("images are left alone: name their teacher with --teacher")
    raise typer.Exit(_work(frames, teachers, as_json))


def _work(frames: FrameList[SemanticKittiFrame], teachers: list[Teacher], as_json: bool) -> int:
    """Label everything, print a summary, and return the exit code."""
    from lidar2pano.hardware import keep_buffers
    from lidar2pano.prepare import State, label

    keep_buffers()
    counts: dict[str, Counter[State]] = {teacher.folder: Counter() for teacher in teachers}
    with bar(len(frames), "preparing") as advance:
        for frame, done in label(frames, teachers):
            for file in done:
                counts[file.folder][file.state] += 1
                if file.problem:
                    print_error(file.problem)
                elif file.state is State.WRITTEN and counts[file.folder][State.WRITTEN] == 1:
                    _note_licence(next(teacher for teacher in teachers if teacher.folder == file.folder))
            if as_json:
                print(json.dumps(record_of(frame, done)), flush=True)
            advance()
    for teacher in teachers:
        count = counts[teacher.folder]
        if count[State.KEPT]:
            print_note(
                f"{count[State.KEPT]} files in {teacher.folder}/ are not prepare's own and stay as they are; to have"
                f" labels beside them choose another {OPTIONS[teacher.suffix]}"
            )
        if not as_json:
            print(summary(teacher.folder, count))
    return MISTAKE if any(count[State.FAILED] for count in counts.values()) else 0


def record_of(frame: SemanticKittiFrame, done: list[LabelledFile]) -> dict[str, Any]:
    """Return the record of one frame for --json."""
    return {
        "frame": frame.name,
        "outputs": [
            {"file": str(file.file), "state": file.state.value} | ({"problem": file.problem} if file.problem else {})
            for file in done
        ],
    }


def summary(folder: str, count: Counter[Any]) -> str:
    """Return one folder's summary for people."""
    from lidar2pano.prepare import State

    words = {State.WRITTEN: "written", State.CURRENT: "up to date", State.KEPT: "kept", State.FAILED: "failed"}
    parts = [f"{count[state]} {word}" for state, word in words.items() if count[state]]
    return f"{folder}: {', '.join(parts) or 'nothing to label'}"


def _note_licence(teacher: Teacher) -> None:
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import licence_note

    if note := licence_note(read_card(path) for path in teacher.weights if path.suffix == ".safetensors"):
        print_note(f"{teacher.folder}: {note}")


def _folder_name(name: str, option: str) -> str:
    if not name or Path(name).name != name or name in (*TAKEN, ".", ".."):
        raise InputError(f"{option} {name}: is no name for a folder of labels; choose one such as predicted_labels")
    return name


def _factors(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",")) if text.strip() else ()
    except ValueError:
        raise InputError(f"--scales {text}: is no list of numbers; write it like 0.5,1,2") from None
