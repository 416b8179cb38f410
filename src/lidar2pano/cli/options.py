"""Common options and arguments of commands: parsers of their texts, checks of named files."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar2pano.errors import InputError, closest

if TYPE_CHECKING:
    from lidar2pano.calibration import Calibration
    from lidar2pano.drives.camera_choice import CameraOptions
    from lidar2pano.drives.reading import ReadingOptions
    from lidar2pano.drives.viewpoints import Place

KITTI_SIZE = "1242x375"
MOST_PIXELS = 1 << 26  # of a camera's image
OUT = Path("panoramas")
BEST = "best"  # models.families.BEST, whose import takes torch
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the panoramas.")]
WeightsOption = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE",
        help="A family of weights (best: the best that is installed), a run's folder, a weight file; or several: A+B"
        " takes B's first.",
    ),
]
DeviceOption = Annotated[
    str, typer.Option(metavar="auto|cpu|cuda", help="Device that computes; auto: CUDA if there is one.")
]
ScansArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="SCAN",
        help="Scans of any format, folders, data sets, recordings; - for standard input. Where names of files are"
        " equal, outputs carry those of folders, too.",
    ),
]
FormatOption = Annotated[str, typer.Option("--format", metavar="png|webp|jpeg", help="Format of the colour images.")]
SensorOption = Annotated[
    str, typer.Option(metavar="NAME", help="Rows of this sensor, for weights that know them; else the weights'.")
]
CalibOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="KITTI's calibration of any form: look from that camera, and save its view too."),
]
ImageSizeOption = Annotated[str, typer.Option(metavar="WxH", help="Size of that camera's image (1242x375).")]
JsonOption = Annotated[bool, typer.Option("--json", help="One line of JSON per scan on stdout.")]
CameraOption = Annotated[
    list[str],
    typer.Option(
        metavar="IMAGE:CALIB",
        help="A camera's image (or folder of them), whose pixels stay real, and its calibration; several times for"
        " several.",
    ),
]
CamerasOption = Annotated[
    str,
    typer.Option(
        metavar="LIST", help="Cameras in the data set or recording: auto, none, or names of a recording's topics."
    ),
]
MaskOption = Annotated[
    list[Path],
    typer.Option(metavar="FILE", help="Image, not black on the own vehicle: one for all cameras, or one each."),
]
LookOption = Annotated[
    str, typer.Option(metavar="NAME", help="Paint in this look, A+B in the mean of two; else the weights' own.")
]
QualityOption = Annotated[str, typer.Option(metavar="fast|best", help="Steps of a latent painter: two, or four.")]
SeedOption = Annotated[int, typer.Option(metavar="S", help="Another plausible panorama by a latent painter.")]
ElevationOption = Annotated[
    str,
    typer.Option(
        metavar="LOW,HIGH|auto",
        help="Elevations of the panorama, degrees; auto: what the sensor sees, and ten more. Else -15.8,13.4.",
    ),
]
SteadyOption = Annotated[
    bool,
    typer.Option("--steady", help="A folder's or recording's scans are a video: smooth it over time, without flicker."),
]
TopicOption = Annotated[
    str, typer.Option(metavar="NAME", help="The recording's topic or sensor, if it has several; or all.")
]
EveryOption = Annotated[int, typer.Option(min=1, metavar="N", help="One of N scans of a recording or folder.")]
FromOption = Annotated[
    float | None, typer.Option("--from", min=0, metavar="SECONDS", help="Scans from so long after the start on.")
]
ToOption = Annotated[
    float | None, typer.Option("--to", min=0, metavar="SECONDS", help="Scans until so long after the start.")
]
FollowOption = Annotated[
    bool, typer.Option("--follow", help="Go on with scans that are written into the folder, until interrupted.")
]
HeightOption = Annotated[
    float | None, typer.Option(metavar="METRES", help="Height of the viewpoint above the ground; else found out.")
]
ForwardOption = Annotated[str, typer.Option(metavar="AXIS", help="The forward axis: x, y, -x, -y; else found out.")]
RemissionOption = Annotated[
    str, typer.Option(metavar="FULL", help="Full remission: 1, 255, 65535; or none, if unusable; else found out.")
]
InventOption = Annotated[
    bool, typer.Option("--invent", help="Depth and segments outside the field of view too; else they are unknown.")
]

EngineOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Engine of the networks: auto, torch, compile, onnx, openvino; auto: OpenVINO if --engine openvino"
        " compiled them before, else torch.",
    ),
]
AtOption = Annotated[
    str,
    typer.Option(
        "--at",
        metavar="X,Y,Z|FILE",
        help="A place in a map, or a file of places: the scans are a map in one frame, seen from there.",
    ),
]
HeadingOption = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="Direction ahead at --at, counter-clockwise from the map's x axis; else 0."),
]
SaveOption = Annotated[
    str,
    typer.Option(
        metavar="LIST",
        help="Outputs: rgb, segments, labels, depth or all; confidence, measured, source; remission, range,"
        " near-infrared, as measured; valid, with --calib.",
    ),
]
ProjectionOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Projection of the panoramas: cylinder, equirectangular (photo spheres for other viewers) or cubemap.",
    ),
]
ViewOption = Annotated[bool, typer.Option("--view", help="Write DIR/view.html to look around in, and open it.")]
PlyOption = Annotated[bool, typer.Option("--ply", help="Write DIR/<stem>.ply: the points with colours and classes.")]
AnnotationsOption = Annotated[
    str, typer.Option(metavar="LIST", help="Annotations of the panoramas: coco, cityscapes, yolo, separated by commas.")
]
StrictOption = Annotated[bool, typer.Option("--strict", help="A scan that is as no LiDAR gives it is an error.")]
VideoOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the panoramas as a video (.mp4), ten a second.")
]
RerunOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write points and panoramas as a recording for Rerun (.rrd).")
]


def collect_choices(  # noqa: PLR0913, PLR0917 one parameter per option
    device: str, engine: str, look: str, quality: str, seed: int, elevation: str
) -> dict[str, Any]:
    """Return where the networks run and what they paint, as arguments of `batch.checked_options`."""
    painted = {"look": look, "quality": quality, "seed": seed, "elevation": elevation}
    return {"device": device, "engine": engine, **painted}


def collect_outputs(save: str, image_format: str, projection: str, ply: bool, annotations: str) -> dict[str, Any]:
    """Return the files of each scan, as arguments of `batch.checked_options`."""
    from lidar2pano.annotations import parse_forms

    forms = parse_forms(annotations)
    if forms and projection != "cylinder":
        raise InputError("--annotations: are those of the cylinder; leave --projection out")
    pictures = collect_pictures(image_format, projection)
    return {"save": parse_save(save, extra=True), **pictures, "ply": ply, "annotations": forms}


def parse_places(text: str, heading: float | None, follow: bool, reading: ReadingOptions) -> list[Place]:
    """Return the places of --at, [] without it; InputError for options that have no meaning with it."""
    from lidar2pano.drives.viewpoints import parse_places
    from lidar2pano.formats.readers import ReadOptions

    if not text:
        if heading is not None:
            raise InputError(f"--heading {heading:g}: is the direction ahead at a place of a map; name it with --at")
        return []
    if follow or reading.selection != ReadOptions():
        raise InputError("--at takes a whole map; leave out --follow, --topic, --every, --from and --to")
    if reading.overrides.forward or reading.overrides.sensor_height_m is not None:
        raise InputError("--at says where the sensor stands; leave out --forward and --sensor-height")
    if reading.cameras and (reading.cameras.named or reading.cameras.topics):
        raise InputError("--at: cameras see no map from another place; leave out --camera and --cameras")
    return parse_places(text, heading or 0.0)


def parse_camera(calib: Path | None, image_size: str) -> Calibration | None:
    """Return the camera of --calib with an image of --image-size."""
    from lidar2pano.calibration import read_calib

    if image_size and calib is None:
        raise InputError(f"--image-size {image_size} is the size of a camera's image; name its --calib too")
    size = parse_size(image_size or KITTI_SIZE)
    return read_calib(calib, size) if calib else None


def parse_cameras(named: list[str], word: str, masks: list[Path], viewpoint: bool) -> CameraOptions | None:
    """Return the cameras of --camera, --cameras and --mask; None for none.

    viewpoint  whether an only camera decides where the panorama stands.
    """
    from lidar2pano.drives.camera_choice import CameraOptions, parse_camera

    topics = () if word in ("auto", "none") else tuple(name.strip() for name in word.split(",") if name.strip())
    if word not in ("auto", "none") and (named or not topics):
        raise InputError(f"--cameras {word!r}: is auto, none or topics of a recording, without --camera")
    if masks and word == "none" and not named:
        raise InputError("--mask: there is no camera with --cameras none; leave one of them out")
    if missing := next((mask for mask in masks if not mask.is_file()), None):
        raise InputError(f"--mask {missing}: is missing; name an image")
    cameras = tuple(parse_camera(text) for text in named)
    if cameras:
        from lidar2pano.drives.cameras import check_named

        for camera in cameras:
            check_named(camera)
    options = CameraOptions(named=cameras, topics=topics, masks=tuple(masks), viewpoint=viewpoint)
    return options if cameras or word != "none" else None


def parse_save(text: str, extra: bool = False) -> tuple[str, ...]:
    """Return --save's list, in the order of OUTPUTS; with `extra` it may name EXTRA_OUTPUTS, which "all" does not."""
    from lidar2pano.panorama import EXTRA_OUTPUTS, OUTPUTS

    outputs = (*OUTPUTS, *EXTRA_OUTPUTS) if extra else OUTPUTS
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names:
        raise InputError(f"--save: empty list; choose from {', '.join(outputs)} and all")
    if unknown := sorted(names - {*outputs, "all"}):
        raise InputError(f"--save: unknown output {unknown[0]!r}{closest(unknown[0], (*outputs, 'all'))}")
    return tuple(name for name in outputs if name in names or ("all" in names and name in OUTPUTS))


def collect_pictures(image_format: str, projection: str) -> dict[str, str]:
    """Return --format and --projection as fields of `batch.Options`."""
    from lidar2pano.formats.image_files import COLOUR_FORMATS
    from lidar2pano.geometry.camera import PROJECTIONS

    if image_format not in COLOUR_FORMATS:
        guess = closest(image_format, COLOUR_FORMATS)
        raise InputError(f"--format {image_format!r}: no format for colour images{guess}")
    if projection not in PROJECTIONS:
        raise InputError(f"--projection {projection!r}: is no projection{closest(projection, PROJECTIONS)}")
    return {"image_format": image_format, "projection": projection}


def parse_size(text: str) -> tuple[int, int]:
    """Return --image-size's width and height in pixels."""
    size = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text.strip())
    if not size:
        raise InputError(f"--image-size {text!r} is not of the form WIDTHxHEIGHT in pixels, e.g. {KITTI_SIZE}")
    width, height = int(size[1]), int(size[2])
    if width * height > MOST_PIXELS:
        raise InputError(f"--image-size {text!r} has more than {MOST_PIXELS} pixels; name that of the camera's image")
    return width, height


def check_folder(folder: Path, option: str) -> Path:
    """Return `folder`; InputError unless it is, or can become, a folder to write into. Nothing is made yet."""
    ancestor = folder
    while not ancestor.exists() and ancestor != ancestor.parent:
        ancestor = ancestor.parent
    if not ancestor.is_dir():
        raise InputError(f"{folder}: cannot be written ({ancestor} is not a folder); choose another {option}")
    try:
        with tempfile.TemporaryFile(dir=ancestor):  # permissions do not say everything: read-only disks, /proc
            return folder
    except OSError as error:
        reason = f"{error.strerror}, in {ancestor}"
        raise InputError(f"{folder}: cannot be written ({reason}); choose another {option}") from error


def check_file(path: Path, option: str) -> None:
    """Raise InputError unless a file can be written to `path`."""
    from lidar2pano.formats.image_files import check_target

    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file for {option}")
    check_folder(path.parent, option)
    try:
        check_target(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another {option}") from error


def write_json(path: Path, value: Any, option: str) -> None:  # noqa: ANN401
    """Write `value` as JSON, beside and then renamed; InputError for an unwritable file."""
    from lidar2pano.formats.image_files import write_text

    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n", option)
