"""lidar2pano translate, lidar2pano demo."""

from __future__ import annotations

import shlex

import typer

from lidar2pano.cli import options as opt
from lidar2pano.cli.app import app


@app.command()
def demo(out: opt.OutOption = opt.OUT, weights: opt.WeightsOption = "world", device: opt.DeviceOption = "auto") -> None:
    """Turn the scan in the package into a panorama; print the files' paths."""
    from lidar2pano.cli.batch import checked_options, translate_files
    from lidar2pano.demo import street
    from lidar2pano.panorama import OUTPUTS

    options = checked_options(weights, device=device, out=opt.check_folder(out, "--out"), save=OUTPUTS)
    code = translate_files([street()], options)
    if not code:
        print(f"look around in it: lidar2pano view {shlex.quote(str(out))}")
    raise typer.Exit(code)


@app.command()
def translate(  # noqa: PLR0913, PLR0917 one parameter per option
    scans: opt.ScansArgument,
    out: opt.OutOption = opt.OUT,
    weights: opt.WeightsOption = opt.BEST,
    device: opt.DeviceOption = "auto",
    sensor: opt.SensorOption = "",
    calib: opt.CalibOption = None,
    image_size: opt.ImageSizeOption = "",
    camera: opt.CameraOption = [],  # noqa: B006 typer copies it
    cameras: opt.CamerasOption = "auto",
    mask: opt.MaskOption = [],  # noqa: B006
    save: opt.SaveOption = "rgb",
    as_json: opt.JsonOption = False,
    steady: opt.SteadyOption = False,
    viewpoint: opt.AtOption = "",
    heading: opt.HeadingOption = None,
    sensor_height: opt.HeightOption = None,
    forward: opt.ForwardOption = "",
    remission: opt.RemissionOption = "",
    invent: opt.InventOption = False,
    look: opt.LookOption = "",
    quality: opt.QualityOption = "fast",
    seed: opt.SeedOption = 0,
    elevation: opt.ElevationOption = "",
    topic: opt.TopicOption = "",
    every: opt.EveryOption = 1,
    start_s: opt.FromOption = None,
    end_s: opt.ToOption = None,
    follow: opt.FollowOption = False,
    engine: opt.EngineOption = "auto",
    image_format: opt.FormatOption = "png",
    projection: opt.ProjectionOption = "cylinder",
    view: opt.ViewOption = False,
    ply: opt.PlyOption = False,
    annotations: opt.AnnotationsOption = "",
    strict: opt.StrictOption = False,
    video: opt.VideoOption = None,
    rerun: opt.RerunOption = None,
) -> None:
    """Turn scans into panoramas: DIR/<stem>.png, .segments.png, .label, .depth.png, .camera.png."""
    from lidar2pano.cli import batch
    from lidar2pano.drives.reading import Overrides, ReadingOptions, ReadOptions

    selection = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
    overrides = Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission, invent=invent)
    chosen = opt.parse_cameras(camera, cameras, mask, viewpoint=calib is None)
    reading = ReadingOptions(selection=selection, overrides=overrides, poses=steady, strict=strict, cameras=chosen)
    places = opt.parse_places(viewpoint, heading, follow, reading)
    options = batch.checked_options(
        weights,
        **opt.collect_choices(device, engine, look, quality, seed, elevation),
        sensor=sensor,
        out=opt.check_folder(out, "--out"),
        calibration=opt.parse_camera(calib, image_size),
        **opt.collect_outputs(save, image_format, projection, ply, annotations),
        as_json=as_json,
        reading=reading,
        common=batch.common_files(scans, out / "view.html" if view else None, video, rerun),
    )
    raise typer.Exit(batch.open_page(options.common.page, batch.translate_all(scans, options, places, follow)))
