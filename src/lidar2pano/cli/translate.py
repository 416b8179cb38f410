"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar2pano.cli.app import app

if TYPE_CHECKING:
    from lidar2pano.cli.batch import Options

OUT = Path("panoramas")
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pictures.")]
WeightsOption = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE", help="A family of weights, a run's folder, a weight file; or several: A+B takes B's first."
    ),
]
DeviceOption = Annotated[
    str, typer.Option(metavar="auto|cpu|cuda", help="Where to compute; auto: CUDA if there is one.")
]
ScansArgument = Annotated[
    list[Path],
    typer.Argument(metavar="SCAN...", help="Scans of any format, folders of them, sequence folders, recordings."),
]
FormatOption = Annotated[str, typer.Option("--format", metavar="png|webp|jpeg", help="Format of the colour images.")]
SensorOption = Annotated[
    str, typer.Option(metavar="NAME", help="Rows of this sensor, for weights that know them; else the weights'.")
]
CalibOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="KITTI's calib.txt (P2, Tr): look from that camera, and save its view too."),
]
LookOption = Annotated[
    str, typer.Option(metavar="NAME", help="Paint in this look, A+B in the mean of two; else the weights' own.")
]
SteadyOption = Annotated[
    bool,
    typer.Option("--steady", help="A folder's or recording's scans are a video: smooth it over time, without flicker."),
]
TopicOption = Annotated[
    str, typer.Option(metavar="NAME", help="The recording's topic or sensor, where it has several.")
]
EveryOption = Annotated[int, typer.Option(min=1, metavar="N", help="One of N scans of a recording or folder.")]
FromOption = Annotated[
    float | None, typer.Option("--from", min=0, metavar="SECONDS", help="Scans from so long after the start on.")
]
ToOption = Annotated[
    float | None, typer.Option("--to", min=0, metavar="SECONDS", help="Scans until so long after the start.")
]
FollowOption = Annotated[
    bool, typer.Option("--follow", help="Go on with what is written into the folder, until interrupted.")
]
HeightOption = Annotated[
    float | None, typer.Option(metavar="METRES", help="Height of the viewpoint above the ground; else found out.")
]
ForwardOption = Annotated[str, typer.Option(metavar="AXIS", help="What points forward: x, y, -x, -y; else found out.")]
RemissionOption = Annotated[
    str, typer.Option(metavar="FULL", help="Full remission: 1, 255, 65535; or none, if unusable; else found out.")
]
InventOption = Annotated[
    bool, typer.Option("--invent", help="Depth and segments outside the field of view too; else they are unknown.")
]

EngineOption = Annotated[
    str,
    typer.Option(
        metavar="auto|torch|compile|onnx|openvino",
        help="What runs the networks; auto: OpenVINO where --engine openvino compiled the networks before, else torch.",
    ),
]
SaveOption = Annotated[
    str, typer.Option(metavar="LIST", help="What to write: rgb,segments,labels,depth or all; confidence.")
]
ViewOption = Annotated[bool, typer.Option("--view", help="Write DIR/view.html to look around in, and open it.")]
PlyOption = Annotated[bool, typer.Option("--ply", help="Write DIR/<stem>.ply: the points with colours and classes.")]
StrictOption = Annotated[bool, typer.Option("--strict", help="A scan that is as no LiDAR gives it is an error.")]
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
    from lidar2pano.cli import batch
    from lidar2pano.cli.files import check_folder
    from lidar2pano.cli.view import common_files
    from lidar2pano.formats.interpretation import Overrides
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files

    options = batch.Options(
        out=check_folder(out, "--out"),
        calibration=batch.parse_camera(calib, image_size),
        device=pick_device(device),
        weights=weights,
        files=weight_files(weights, look=look),
        sensor=sensor,
        save=batch.parse_save(save, confidence=True),
        as_json=as_json,
        smooth=steady,
        look=look,
        selection=ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s),
        overrides=Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission, invent=invent),
        engine=engine,
        image_format=batch.parse_format(image_format),
        ply=ply,
        strict=strict,
        common=common_files(out / "view.html" if view else None, scans, video, rerun),
    )
    raise typer.Exit(_translated(scans, options, follow))


def _translated(scans: list[Path], options: Options, follow: bool) -> int:
    """Translate and open the page, if one was wanted; the exit code."""
    from lidar2pano.cli.batch import translate_files, translate_followed
    from lidar2pano.cli.follow import check_followed
    from lidar2pano.cli.view import open_page
    from lidar2pano.engines import pick_engine
    from lidar2pano.views import sensor_view

    if options.sensor:
        sensor_view(options.sensor)
    pick_engine(options.engine, options.device)
    if follow:
        code = translate_followed(check_followed(scans, options.selection), options)
    else:
        code = translate_files(scans, options)
    open_page(options.common.page, code)
    return code
