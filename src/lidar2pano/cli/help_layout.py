"""The help of commands: groups of options and examples."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

LONG = 6  # options; a shorter list has no groups
PANELS: dict[str, str] = {  # group -> its options, of whatever command
    "Scans": "--data --split --folds --frames --sequences --hz --place --at --heading --topic --every --from --to"
    " --follow",
    "How scans are read": "--sensor --sensor-height --forward --remission --strict --labels",
    "Cameras": "--camera --cameras --mask --calib --image-size --leave-out",
    "Panoramas": "--weights --elevation --look --quality --seed --steady --invent",
    "Teachers": "--lidar --teacher --scales --unsure",
    "Training": "--set --budget --rows --segmenter --form --dry-run",
    "Scores": "--metrics --sdnet --inception --worst --runs --operations --world",
    "Output": "--out --save --as --format --projection --view --ply --annotations --video --rerun --json --csv"
    " --pairs --no-open --labels-folder --camera-labels-folder",
    "Service": "--host --port --max-megabytes --max-points --queue --seconds",
    "Machine": "--device --devices --nodes --engine --processes --ray --workers --cores --shard",
}
PANEL_BY_OPTION = {option: panel for panel, options in PANELS.items() for option in options.split()}
EXAMPLES: dict[str, tuple[str, ...]] = {
    "translate": (
        "lidar2pano translate scan.bin",
        "lidar2pano translate drive/ --save all --json",
        "lidar2pano translate map.laz --at 12.5,-3,1.8 --heading 90",
        "lidar2pano translate drive.mcap --topic /lidar/points --steady --video drive.mp4",
    ),
    "view": ("lidar2pano view scan.pcd", "lidar2pano view drive/velodyne --out drive.html"),
    "bulk": ("lidar2pano bulk drives/ --out panoramas", "lidar2pano bulk drives/ --out panoramas --shard 3/8"),
    "serve": ("lidar2pano serve", "curl --data-binary @scan.bin http://127.0.0.1:8360/panorama -o panorama.png"),
    "evaluate": ("lidar2pano evaluate streets world --data ROOT --split val",),
    "reproduce": (
        "lidar2pano reproduce --data ROOT --out DIR --budget 20m --dry-run",
        "lidar2pano reproduce --data ROOT --out DIR --rows titan,pix2pix",
    ),
    "train": (
        "lidar2pano train titan-pano-mini --data ROOT --out RUN --set training.minutes=60",
        "lidar2pano train titan-pano --config run.yaml",
    ),
    "world": ("lidar2pano world OUT --sequences 4 --frames 20 --seed 1",),
}


def arrange(command: Any) -> Any:  # noqa: ANN401 typer's classes are click's or its own
    """Arrange the help of a program and of all its commands in place; return the program."""
    for inner in commands_of(command):
        options = options_of(inner)
        for option in [*options, inner.get_help_option(inner.context_class(inner))]:
            if option.is_flag and option.metavar is None:
                option.metavar = ""
            if len(options) >= LONG and (panel := PANEL_BY_OPTION.get(option.opts[0])):
                option.rich_help_panel = panel
        if inner.name in EXAMPLES:
            examples = "\n\n".join(EXAMPLES[inner.name])
            inner.epilog = "\n\n".join(part for part in (inner.epilog, f"Examples:\n\n{examples}") if part)
    return command


def options_of(command: Any) -> list[Any]:  # noqa: ANN401
    """Return the options of a command, without --help."""
    return [item for item in command.params if item.param_type_name == "option" and "--help" not in item.opts]


def commands_of(command: Any) -> Iterator[Any]:  # noqa: ANN401
    """Yield a command and all commands below it."""
    yield command
    for inner in getattr(command, "commands", {}).values():
        yield from commands_of(inner)
