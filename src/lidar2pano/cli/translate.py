"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

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

EngineOption = Annotated[
    str,
    typer.Option(
        metavar="auto|torch|compile|onnx|openvino",
        help="What runs the networks; auto: OpenVINO where it is installed and the CPU has bfloat16, else torch.",
    ),
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
    raise typer.Exit(translate_files([street()], options))


@app.command()
def translate(  # noqa: PLR0913, PLR0917 one parameter per option
    scans: Annotated[
        list[Path], typer.Argument(metavar="SCAN...", help="Scan files, folders of scans, sequence folders.")
    ],
    out: OutOption = OUT,
    weights: WeightsOption = "kitti-mini",
    device: DeviceOption = "auto",
    sensor: Annotated[
        str,
        typer.Option(metavar="NAME", help="Rows of this sensor, for weights that know them; else the weights'."),
    ] = "",
    calib: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="KITTI's calib.txt (P2, Tr): look from that camera, and save its view too."),
    ] = None,
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
    engine: EngineOption = "auto",
    image_format: Annotated[
        str, typer.Option("--format", metavar="png|webp|jpeg", help="Format of the colour images.")
    ] = "png",
) -> None:
    """Turn scans into panoramas: DIR/<stem>.png, .segments.png, .label, .depth.png, .camera.png."""
    from lidar2pano.cli.batch import Options, parse_camera, parse_format, parse_save, translate_files
    from lidar2pano.cli.files import check_folder
    from lidar2pano.engines import pick_engine
    from lidar2pano.hardware import pick_device
    from lidar2pano.models.families import weight_files
    from lidar2pano.views import sensor_view

    if sensor:
        sensor_view(sensor)
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
        engine=engine,
        image_format=parse_format(image_format),
    )
    pick_engine(engine, options.device)
    raise typer.Exit(translate_files(scans, options))
