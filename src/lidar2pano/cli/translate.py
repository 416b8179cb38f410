"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from lidar2pano.cli.app import app

OUT = Path("panoramas")
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pictures.")]
WeightsOption = Annotated[
    str, typer.Option(metavar="NAME|FILE", help="A family of weights, a run's folder, or a weight file.")
]
DeviceOption = Annotated[
    str, typer.Option(metavar="auto|cpu|cuda", help="Where to compute; auto: CUDA if there is one.")
]
SensorOption = Annotated[
    str, typer.Option(metavar="NAME", help="Rows of this sensor, for weights that know them; else the weights'.")
]
CalibOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="KITTI's calib.txt (P2, Tr): look from that camera, and save its view too."),
]
ViewOption = Annotated[bool, typer.Option("--view", help="Write DIR/view.html to look around in, and open it.")]
PlyOption = Annotated[bool, typer.Option("--ply", help="Write DIR/<stem>.ply: the points with colours and classes.")]
VideoOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the panoramas as a video (.mp4), ten a second.")
]
RerunOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write points and panoramas as a recording for Rerun (.rrd).")
]


@app.command()
def demo(out: OutOption = OUT, weights: WeightsOption = "world", device: DeviceOption = "auto") -> None:
    """Turn the scan that ships with the package into a panorama; say where the pictures are."""
    from lidar2pano.cli.batch import OUTPUTS, Options, translate_files
    from lidar2pano.cli.files import check_folder
    from lidar2pano.demo import street
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files

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
    scans: Annotated[
        list[Path], typer.Argument(metavar="SCAN...", help="Scan files, folders of scans, sequence folders.")
    ],
    out: OutOption = OUT,
    weights: WeightsOption = "kitti-mini",
    device: DeviceOption = "auto",
    sensor: SensorOption = "",
    calib: CalibOption = None,
    image_size: Annotated[str, typer.Option(metavar="WxH", help="Size of that camera's image (1242x375).")] = "",
    save: Annotated[str, typer.Option(metavar="LIST", help="What to write: rgb,segments,labels,depth or all.")] = "rgb",
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON per scan on stdout.")] = False,
    steady: Annotated[
        bool,
        typer.Option("--steady", help="A folder's scans are a video: smooth it over time, without flicker."),
    ] = False,
    look: Annotated[
        str, typer.Option(metavar="NAME", help="Paint in this look, A+B in the mean of two; else the weights' own.")
    ] = "",
    view: ViewOption = False,
    ply: PlyOption = False,
    video: VideoOption = None,
    rerun: RerunOption = None,
) -> None:
    """Turn scans into panoramas: DIR/<stem>.png, .segments.png, .label, .depth.png, .camera.png."""
    from lidar2pano.cli.batch import Options, parse_camera, parse_save, translate_files
    from lidar2pano.cli.files import check_file, check_folder
    from lidar2pano.cli.view import open_page
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files
    from lidar2pano.viewer.page import title_of
    from lidar2pano.views import sensor_view

    if sensor:
        sensor_view(sensor)
    for file, option in ((video, "--video"), (rerun, "--rerun")):
        if file:
            check_file(file, option)
    options = Options(
        out=check_folder(out, "--out"),
        calibration=parse_camera(calib, image_size),
        device=pick_device(device),
        weights=weights,
        files=weight_files(weights),
        sensor=sensor,
        save=parse_save(save),
        as_json=as_json,
        smooth=steady,
        look=look,
        ply=ply,
        page=out / "view.html" if view else None,
        title=title_of(scans),
        video=video,
        rerun=rerun,
    )
    code = translate_files(scans, options)
    if options.page and not code:
        open_page(options.page)
    raise typer.Exit(code)
