"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

from dataclasses import replace
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


@app.command()
def demo(out: OutOption = OUT, weights: WeightsOption = "world", device: DeviceOption = "auto") -> None:
    """Turn the scan that ships with the package into a panorama; say where the pictures are."""
    from lidar2pano.cli.batch import Wish, translate_files
    from lidar2pano.demo import street

    raise typer.Exit(translate_files([street()], Wish.of(out=out, save="all", weights=weights, device=device)))


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
    look: Annotated[
        str, typer.Option(metavar="NAME", help="Paint in this look, A+B in the mean of two; else the weights' own.")
    ] = "",
    image_size: Annotated[str, typer.Option(metavar="WxH", help="Size of that camera's image (1242x375).")] = "",
    save: Annotated[str, typer.Option(metavar="LIST", help="What to write: rgb,segments,labels,depth or all.")] = "rgb",
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON per scan on stdout.")] = False,
    steady: Annotated[
        bool,
        typer.Option("--steady", help="A folder's scans are a film: each picture goes on from those before."),
    ] = False,
) -> None:
    """Turn scans into panoramas: DIR/<stem>.png, .segments.png, .label, .depth.png, .camera.png."""
    from lidar2pano.cli.batch import Wish, translate_files

    wish = Wish.of(
        out=out,
        save=save,
        weights=weights,
        device=device,
        sensor=sensor,
        calib=calib,
        image_size=image_size,
        as_json=as_json,
    )
    raise typer.Exit(translate_files(scans, replace(wish, steady=steady, look=look)))
