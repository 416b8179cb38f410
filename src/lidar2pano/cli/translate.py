"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Annotated

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.files import check_folder
from lidar2pano.cli.options import (
    OUT,
    CalibOption,
    DeviceOption,
    EngineOption,
    EveryOption,
    FollowOption,
    FormatOption,
    ForwardOption,
    FromOption,
    HeightOption,
    InventOption,
    LookOption,
    OutOption,
    PlyOption,
    RemissionOption,
    RerunOption,
    SaveOption,
    ScansArgument,
    SensorOption,
    SteadyOption,
    StrictOption,
    ToOption,
    TopicOption,
    VideoOption,
    ViewOption,
    WeightsOption,
    parse_camera,
    parse_format,
    parse_save,
)

if TYPE_CHECKING:
    from pathlib import Path

    from lidar2pano.cli.batch import Options


@app.command()
def demo(out: OutOption = OUT, weights: WeightsOption = "world", device: DeviceOption = "auto") -> None:
    """Turn the scan that ships with the package into a panorama; say where the pictures are."""
    from lidar2pano.cli.batch import Options, translate_files
    from lidar2pano.demo import street
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files
    from lidar2pano.panorama import OUTPUTS

    options = Options(
        out=check_folder(out, "--out"),
        save=OUTPUTS,
        device=pick_device(device),
        weights=weights,
        files=weight_files(weights),
    )
    code = translate_files([street()], options)
    if not code:
        print(f"look around in it: lidar2pano view {shlex.quote(str(out))}")
    raise typer.Exit(code)


@app.command()
def translate(  # noqa: PLR0913, PLR0917 one parameter per option
    scans: ScansArgument,
    out: OutOption = OUT,
    weights: WeightsOption = "kitti-mini",
    device: DeviceOption = "auto",
    sensor: SensorOption = "",
    calib: CalibOption = None,
    image_size: Annotated[str, typer.Option(metavar="WxH", help="Size of that camera's image (1242x375).")] = "",
    save: SaveOption = "rgb",
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON per scan on stdout.")] = False,
    steady: SteadyOption = False,
    sensor_height: HeightOption = None,
    forward: ForwardOption = "",
    remission: RemissionOption = "",
    invent: InventOption = False,
    look: LookOption = "",
    topic: TopicOption = "",
    every: EveryOption = 1,
    start_s: FromOption = None,
    end_s: ToOption = None,
    follow: FollowOption = False,
    engine: EngineOption = "auto",
    image_format: FormatOption = "png",
    view: ViewOption = False,
    ply: PlyOption = False,
    strict: StrictOption = False,
    video: VideoOption = None,
    rerun: RerunOption = None,
) -> None:
    """Turn scans into panoramas: DIR/<stem>.png, .segments.png, .label, .depth.png, .camera.png."""
    from lidar2pano.cli.batch import Options, common_files
    from lidar2pano.drives.reading import ReadingOptions
    from lidar2pano.formats.interpretation import Overrides
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files

    options = Options(
        out=check_folder(out, "--out"),
        calibration=parse_camera(calib, image_size),
        device=pick_device(device),
        weights=weights,
        files=weight_files(weights, look=look),
        sensor=sensor,
        save=parse_save(save, confidence=True),
        as_json=as_json,
        look=look,
        reading=ReadingOptions(
            selection=ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s),
            overrides=Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission, invent=invent),
            poses=steady,
            strict=strict,
        ),
        engine=engine,
        image_format=parse_format(image_format),
        ply=ply,
        common=common_files(scans, out / "view.html" if view else None, video, rerun),
    )
    raise typer.Exit(_translate(scans, options, follow))


def _translate(scans: list[Path], options: Options, follow: bool) -> int:
    """Translate scans and open the page that was asked for; return the exit code."""
    from lidar2pano.cli.batch import open_page, translate_files, translate_followed
    from lidar2pano.drives.following import check_followed
    from lidar2pano.engines import pick_engine
    from lidar2pano.views import sensor_view

    if options.sensor:
        sensor_view(options.sensor)
    pick_engine(options.engine, options.device)
    if follow:
        code = translate_followed(check_followed(scans, options.reading.selection), options)
    else:
        code = translate_files(scans, options)
    open_page(options.common.page, code)
    return code
