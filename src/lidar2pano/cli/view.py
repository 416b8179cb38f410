"""lidar2pano view."""

from __future__ import annotations

from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from lidar2pano.cli import options as opt
from lidar2pano.cli.app import app
from lidar2pano.errors import InputError


@app.command()
def view(  # noqa: PLR0913, PLR0917 one parameter per option
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH", help="Panoramas (PNG, or folders written by translate), or scans."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page.")] = Path("view.html"),
    weights: opt.WeightsOption = opt.BEST,
    device: opt.DeviceOption = "auto",
    calib: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="KITTI's calibration of any form: translate scans as that camera sees them."),
    ] = None,
    look: opt.LookOption = "",
    quality: opt.QualityOption = "fast",
    seed: opt.SeedOption = 0,
    elevation: opt.ElevationOption = "",
    steady: opt.SteadyOption = False,
    topic: opt.TopicOption = "",
    every: opt.EveryOption = 1,
    start_s: opt.FromOption = None,
    end_s: opt.ToOption = None,
    engine: opt.EngineOption = "auto",
    sensor_height: opt.HeightOption = None,
    forward: opt.ForwardOption = "",
    remission: opt.RemissionOption = "",
    strict: opt.StrictOption = False,
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the page.")] = False,
) -> None:
    """Write one HTML page to look around in, without a network, and open it. Scans are translated, without cameras."""
    from lidar2pano.cli.batch import checked_options, common_files, open_page, translate_files
    from lidar2pano.drives.reading import ReadingOptions
    from lidar2pano.formats.interpretation import Overrides
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.name_order import sort_listed
    from lidar2pano.viewer.page import title_of
    from lidar2pano.viewer.saved_frames import panorama_files

    common = common_files(paths, out, None, None)
    panoramas = {path: panorama_files(path) for path in sort_listed(paths)}
    if scans := [path for path, files in panoramas.items() if not files]:
        if len(scans) < len(panoramas):
            raise InputError(f"{scans[0]}: is no panorama, others are; view panoramas or scans, not both in one page")
        overrides = Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission)
        selection = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
        options = checked_options(
            weights,
            **opt.collect_choices(device, engine, look, quality, seed, elevation),
            out=out.parent,
            save=(),
            calibration=opt.parse_camera(calib, ""),
            reading=ReadingOptions(selection=selection, overrides=overrides, poses=steady, strict=strict),
            common=common,
        )
        code = translate_files(scans, options)
    else:
        code = _view_panoramas([file for files in panoramas.values() for file in files], out, title_of(paths))
    if not no_open:
        open_page(out, code)
    raise typer.Exit(code)


def _view_panoramas(panoramas: list[Path], out: Path, title: str) -> int:
    from lidar2pano.cli.batch import ErrorReporter, OutputFiles
    from lidar2pano.cli.console import bar
    from lidar2pano.viewer.page import PageWriter
    from lidar2pano.viewer.saved_frames import read_frame

    reporter = ErrorReporter("", out.parent, OutputFiles())
    with closing(PageWriter(title)) as writer:
        with bar(len(panoramas), "reading") as advance:
            for file in panoramas:
                writer.add(read_frame(file))
                advance()
        with suppress(ValueError, OverflowError, OSError):  # a file's time may lie in any year
            writer.facts = (f"made {datetime.fromtimestamp(panoramas[0].stat().st_mtime, UTC):%Y-%m-%d}",)
        reporter.note_replaced([writer.write(out)])
    print(out)
    return 0
