"""lidar2pano view."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.translate import (
    DeviceOption,
    EngineOption,
    EveryOption,
    FromOption,
    LookOption,
    SteadyOption,
    ToOption,
    TopicOption,
    WeightsOption,
)
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from lidar2pano.viewer.outputs import OutputFiles


@app.command()
def view(  # noqa: PLR0913, PLR0917 one parameter per option
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH...", help="Panoramas (PNG, or folders of what translate wrote), or scans."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page.")] = Path("view.html"),
    weights: WeightsOption = "kitti-mini",
    device: DeviceOption = "auto",
    calib: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="KITTI's calib.txt (P2, Tr): translate scans as that camera sees them."),
    ] = None,
    look: LookOption = "",
    steady: SteadyOption = False,
    topic: TopicOption = "",
    every: EveryOption = 1,
    start_s: FromOption = None,
    end_s: ToOption = None,
    engine: EngineOption = "auto",
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the page.")] = False,
) -> None:
    """Write one HTML page to look around in, which needs no network, and open it. Scans are translated first."""
    from lidar2pano.cli.batch import Options, parse_camera, translate_files
    from lidar2pano.engines import pick_engine
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files
    from lidar2pano.viewer.page import title_of
    from lidar2pano.viewer.saved_frames import panorama_files

    common = common_files(out, paths, None, None)
    found = {path: panorama_files(path) for path in paths}
    if scans := [path for path, files in found.items() if not files]:
        if len(scans) < len(found):
            raise InputError(f"{scans[0]}: is no panorama, others are; view panoramas or scans, not both in one page")
        options = Options(
            out=out.parent,
            save=(),
            device=pick_device(device),
            weights=weights,
            files=weight_files(weights, look=look),
            calibration=parse_camera(calib, ""),
            smooth=steady,
            look=look,
            selection=ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s),
            engine=engine,
            common=common,
        )
        pick_engine(options.engine, options.device)
        code = translate_files(scans, options)
    else:
        code = _view_panoramas([file for files in found.values() for file in files], out, title_of(paths))
    if not no_open:
        open_page(out, code)
    raise typer.Exit(code)


def _view_panoramas(panoramas: list[Path], out: Path, title: str) -> int:
    from lidar2pano.cli.progress import bar
    from lidar2pano.viewer.page import PageWriter
    from lidar2pano.viewer.saved_frames import read_frame

    with closing(PageWriter(title)) as writer:
        with bar(len(panoramas), "reading") as advance:
            for file in panoramas:
                writer.add(read_frame(file))
                advance()
        print(writer.write(out))
    return 0


def common_files(page: Path | None, scans: Sequence[Path], video: Path | None, rerun: Path | None) -> OutputFiles:
    """The files about all scans that `translate` was asked for; InputError where one cannot be written."""
    from lidar2pano.cli.files import check_file
    from lidar2pano.viewer.outputs import OutputFiles
    from lidar2pano.viewer.page import title_of

    for file, option in ((page, "--out"), (video, "--video"), (rerun, "--rerun")):
        if file:
            check_file(file, option)
    return OutputFiles(page=page, title=title_of(scans), video=video, rerun=rerun)


def open_page(path: Path | None, code: int) -> None:
    """Open a page in the user's browser, if it was written (exit code 0) and there is a screen."""
    headless = sys.platform.startswith("linux") and not ({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())
    if path and not code and not headless:
        webbrowser.open(path.resolve().as_uri())
