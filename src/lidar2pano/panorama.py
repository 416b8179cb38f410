"""Panorama: the colour image all around, its classes and depths, and its files."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import (
    COLOUR_FORMATS,
    gpano,
    write_colour,
    write_depth,
    write_ids,
    write_palette,
    write_whole,
)
from lidar2pano.formats.ply import write_ply
from lidar2pano.geometry.camera import CUBE_AXES, PROJECTIONS, Lookup, equirectangular, lookups, panorama_in_camera
from lidar2pano.geometry.projection import project
from lidar2pano.geometry.stitching import Camera, homogeneous, look, metered_gain, points_in, surfaces_in
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import echo_image
from lidar2pano.scene.surfaces import hides
from lidar2pano.views import View

OUTPUTS = ("rgb", "segments", "labels", "depth")
ECHO_OUTPUTS = ("remission", "range", "near-infrared")  # of the scan, without an invention
EXTRA_OUTPUTS = ("confidence", "measured", "source", *ECHO_OUTPUTS, "valid")  # that "all" does not name
RASTERS = tuple(name for name in (*OUTPUTS, *EXTRA_OUTPUTS) if name not in ("rgb", "labels", "valid"))
# Endings of the stems of further outputs of a scan.
STEM_ENDINGS = (
    *(f".{name}" for name in (*RASTERS, *CUBE_AXES)),
    *(".camera", ".camera-segments", ".camera-valid", ".panoptic", "_gtFine_labelIds", "_gtFine_instanceIds"),
)
VIEW_KEYWORD = "lidar2pano-view"  # of the text in a panorama's PNG: its View as JSON
Writer = tuple[str, str, Callable[[Path], object]]  # an output, the name of its file, and its function
FULL_LIGHT = 99  # percentile of the near-infrared light that is shown as white
WRITERS = {"segments": write_palette, "depth": write_depth, "range": write_depth}  # of images that are no plain levels
GREY = 128  # of points without a colour
# A point is occluded when it is farther than the panorama's (predicted) depth at its pixel by so much.
OCCLUDED_FACTOR, OCCLUDED_M = 1.2, 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraImage:
    """A panorama resampled into a camera.

    colour    (h, w, 3) uint8 RGB, black where the panorama does not reach.
    segments  (h, w) uint8 ids of COMMON15, 0 where the panorama does not reach.
    valid     (h, w) bool: where it reaches.
    """

    colour: np.ndarray
    segments: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointColours:
    """What a panorama says about the N points of a scan, in file order.

    colour    (N, 3) uint8 RGB; grey (128) where not valid.
    segments  (N,) uint8 ids of COMMON15; 0 where not valid.
    in_view   (N,) bool: the point is usable and lies in the panorama: not above, below or beside it.
    occluded  (N,) bool: in view, but behind what the panorama has at its pixel, which stands nearer.
    source    (N,) uint8: number of the colour's camera, from 1; 0: the panorama's.
    """

    colour: np.ndarray
    segments: np.ndarray
    in_view: np.ndarray
    occluded: np.ndarray
    source: np.ndarray

    @property
    def valid(self) -> np.ndarray:
        """(N,) bool: seen by a camera, or in view and not occluded."""
        return (self.in_view & ~self.occluded) | (self.source > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Panorama:
    """The panorama of one scan, on the raster `view` (h rows, w columns; left edge and right edge are straight behind).

    name          of the scan;  frame: its number in the stream.
    colour        (h, w, 3) uint8 RGB.
    segments      (h, w) uint8 ids of COMMON15.
    depth_m       (h, w) float32 metres from the view's origin along the ray; 0 = none (sky).
    labels        (N,) int64 ids of SEMANTIC_KITTI of the scan's points, file order.
    confidence    (h, w) float32 in [0, 1]: the translator's probability of the class in `segments`; 0 where nothing is
                  claimed. As the network gives it (ECE 0.05 to 0.11), averaged over time as the classes are. None where
                  it is not known.
    measured      (h, w) bool: pixels with a point of the scan, whose depth is the nearest point's distance; all other
                  depths are predicted. None where it is not known.
    source        (h, w) uint8: number of a pixel's camera, from 1; 0: its colour is invented. None without cameras.
    cameras       in use, in the scan's frame, with their gains;  doubts: sentences about cameras.
    dropped       points that were not used (NaN, Inf, nearer than OWN_VEHICLE_M); they are labelled 0.
    beyond_rows   points above or below the segmenter's rows: labelled like the pixels at the border nearest to them.
    points_between  points that were put between the beams of a sensor that has fewer than the segmenter's raster.
    milliseconds  time per stage.
    """

    name: str
    frame: int
    view: View
    colour: np.ndarray
    segments: np.ndarray
    depth_m: np.ndarray
    labels: np.ndarray
    confidence: np.ndarray | None = None
    measured: np.ndarray | None = None
    source: np.ndarray | None = None
    cameras: tuple[Camera, ...] = ()
    doubts: tuple[str, ...] = ()
    dropped: int = 0
    beyond_rows: int = 0
    points_between: int = 0
    milliseconds: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return name, raster, number of classes and time, without the arrays."""
        rows, columns = self.colour.shape[:2]
        seconds = f", {sum(self.milliseconds.values()) / 1000:.1f} s" if self.milliseconds else ""
        classes = len(np.unique(self.segments[self.segments > 0]))
        return f"Panorama({self.name!r}, {rows} x {columns}, {classes} classes, {len(self.labels)} points{seconds})"

    def _repr_png_(self) -> bytes:
        """Return the colours as PNG, which notebooks show."""
        stream = io.BytesIO()
        self.to_pil().save(stream, "PNG")
        return stream.getvalue()

    def to_pil(self) -> Image.Image:
        """Return the colours as an image of Pillow."""
        return Image.fromarray(self.colour)

    def show(self) -> None:
        """Open the colours in the system's viewer of pictures."""
        self.to_pil().show(title=self.name)

    def to_open3d(self, scan: Scan) -> Any:  # noqa: ANN401 Open3D may be absent
        """Return the panorama's own scan as a coloured `open3d.geometry.PointCloud`, as `save_points` writes it.

        Raises InputError without Open3D; ValueError for the scan of another panorama.
        """
        try:
            import open3d  # pyright: ignore[reportMissingImports] no extra brings it
        except ModuleNotFoundError as error:
            raise InputError("to_open3d needs Open3D: pip install open3d") from error
        columns = self._point_columns(scan)
        cloud = open3d.geometry.PointCloud()
        vector = open3d.utility.Vector3dVector
        cloud.points = vector(np.column_stack([columns[name] for name in "xyz"]).astype(np.float64))
        cloud.colors = vector(np.column_stack([columns[name] for name in ("red", "green", "blue")]) / 255)
        return cloud

    def to_camera(self, calibration: Calibration | LensCalibration, *, metered: bool = False) -> CameraImage:
        """Look into the panorama through a camera (pinhole, or with a distorting or fisheye lens) at its origin.

        metered  in the exposure of the camera, as far as those of the panorama tell it (`metered_gain`), instead of
                 the panorama's.
        A camera that stands elsewhere is taken to stand there; `pipeline.at(calibration)` makes a panorama around it.
        """
        lookup = panorama_in_camera(self.view, calibration)
        colour, segments = (_resampled(values, lookup) for values in (self.colour, self.segments))
        valid = lookup.valid.numpy()
        if metered and valid.any():
            levels = [self._level(camera) for camera in self.cameras]
            gain = metered_gain(float(colour[valid].mean()), self.cameras, levels)
            colour = (colour * gain).round().clip(0, 255).astype(np.uint8)
        return CameraImage(colour=colour, segments=segments, valid=valid)

    def _level(self, camera: Camera) -> float:
        """Return the mean code of a camera's image on the panorama's rows, without the own vehicle; 0 without any."""
        counted = panorama_in_camera(self.view, camera.calibration).valid.numpy()
        if camera.ego_mask is not None:
            counted = counted & ~camera.ego_mask
        return float(camera.image[counted].mean()) if counted.any() else 0.0

    def colour_points(self, scan: Scan) -> PointColours:
        """The colour and class of every point of a scan of the same sensor frame, by default the panorama's own scan.

        A point takes the pixel that it lies in. Points out of view have no colour. A point that is farther than the
        panorama's depth there by 20 % and a metre is occluded (the panorama stands beside the sensor and cannot see
        it) and has none either; where the panorama has no depth (sky), every point is valid. A point in sight
        of one of the panorama's cameras has its colour there.
        """
        image = project(scan, self.view)
        in_view = image.inside.numpy()
        row, column = image.row.numpy()[in_view], image.column.numpy()[in_view]
        depth_m = self.depth_m[row, column]
        occluded = np.zeros(len(scan), dtype=bool)
        farthest_m = depth_m * OCCLUDED_FACTOR + OCCLUDED_M
        occluded[in_view] = (depth_m > 0) & (image.range_m.numpy()[in_view] > farthest_m)
        colour = np.full((len(scan), 3), GREY, dtype=np.uint8)
        segments = np.zeros(len(scan), dtype=np.uint8)
        colour[in_view], segments[in_view] = self.colour[row, column], self.segments[row, column]
        colour[occluded], segments[occluded] = GREY, 0
        source = self._colour_by_cameras(scan, colour)
        return PointColours(colour=colour, segments=segments, in_view=in_view, occluded=occluded, source=source)

    def _colour_by_cameras(self, scan: Scan, colour: np.ndarray) -> np.ndarray:
        """Put the colours of points in sight of cameras into `colour`; return the number of each point's camera."""
        source = np.zeros(len(scan), dtype=np.uint8)
        usable = np.isfinite(scan.xyz).all(axis=1) & scan.xyz.any(axis=1)
        points, depths = torch.from_numpy(scan.xyz[usable].T), homogeneous(torch.from_numpy(self.depth_m))
        nearest = torch.full((points.shape[1],), torch.inf)
        for number, camera in enumerate(self.cameras, 1):
            surfaces = surfaces_in(camera, self.view, depths).flatten(1)
            sight = look(camera, points_in(camera, points), self.view.focal_px, hides, surfaces)
            nearer = sight.angle < nearest[sight.surface]
            nearest[sight.surface[nearer]] = sight.angle[nearer]
            place = np.flatnonzero(usable)[sight.surface[nearer].numpy()]
            shown = camera.colours(sight)[:, nearer].round().clamp(0, 255)
            colour[place], source[place] = shown.to(torch.uint8).T.numpy(), number
        return source

    def save_points(self, path: str | Path, scan: Scan) -> Path:
        """Write the panorama's own scan with colours and classes as binary PLY, complete or not at all; return `path`.

        Vertices in file order, without points that are not finite or at the sensor's origin: x y z (float, metres),
        red green blue (`colour_points`), remission (float), label (SemanticKITTI's raw id, of `labels`),
        valid (1, or 0 where the point is out of view or occluded), and, of a panorama with cameras, source (the number
        of the colour's camera, 0 = invented).
        Raises InputError when the file cannot be written; ValueError for the scan of another panorama.
        """
        columns = self._point_columns(scan)
        return write_whole(Path(path), lambda temporary: write_ply(temporary, columns))

    def _point_columns(self, scan: Scan) -> dict[str, np.ndarray]:
        """Return the columns of `save_points`."""
        if len(scan) != len(self.labels):
            raise ValueError(f"this panorama is of a scan with {len(self.labels)} points, not {len(scan)}")
        points = self.colour_points(scan)
        usable = np.isfinite(scan.xyz).all(axis=1) & scan.xyz.any(axis=1)
        columns = {name: scan.xyz[usable, axis] for axis, name in enumerate("xyz")}
        columns |= {name: points.colour[usable, axis] for axis, name in enumerate(("red", "green", "blue"))}
        columns["remission"] = scan.remission[usable]
        columns["label"] = SEMANTIC_KITTI.to_raw(self.labels[usable]).astype(np.uint16)
        columns["valid"] = points.valid[usable].astype(np.uint8)
        if self.cameras:
            columns["source"] = points.source[usable]
        return columns

    def save(
        self,
        out: str | Path,
        what: str | Collection[str] = ("rgb",),
        calibration: Calibration | None = None,
        stem: str | None = None,
        image_format: str = "png",
        projection: str = "cylinder",
        scan: Scan | None = None,
    ) -> list[Path]:
        """Write the files that `what` names into the folder `out`, each complete or not at all; return their paths.

        what  of "rgb" (<stem>.png, which holds the view as text, VIEW_KEYWORD), "segments" (<stem>.segments.png,
              palette of COMMON15), "labels" (<stem>.label, raw uint32 per point), "depth" (<stem>.depth.png, 16 bit,
              metres x 256), "confidence" (<stem>.confidence.png, 8 bit, 255 = certain), "measured"
              (<stem>.measured.png, 8 bit, 255 = a point was there), "source" (<stem>.source.png, 8 bit, the number of
              the pixel's camera, 0 = invented). Of `scan`, the panorama's own: "remission" (8 bit, 255 = full), "range"
              (like the depth) and "near-infrared" (8 bit, 255 = 99 of 100 pixels have less). With a calibration also
              <stem>.camera.png beside rgb, <stem>.camera-segments.png beside segments, and for "valid"
              <stem>.camera-valid.png (8 bit, 255 = the panorama reaches there).
        image_format  of the colour images: "png", "webp" (.webp) or "jpeg" (.jpg), which lose a little.
        projection    of all images: "cylinder", as `view`; "equirectangular", whose colour images say so to viewers
              (GPano XMP); "cubemap": <stem>.front.png, .right, .back, .left, .up, .down, and as many of each other one.
        Raises InputError when a name is unknown, the scan has no near-infrared light, "valid" no calibration or the
        folder cannot be written; ValueError without the scan or for that of another panorama.
        """
        what = (what,) if isinstance(what, str) else what
        if unknown := sorted(set(what) - {*OUTPUTS, *EXTRA_OUTPUTS}):
            raise InputError(f"nothing to save is called {unknown[0]!r}; there is {', '.join(OUTPUTS)}")
        if image_format not in COLOUR_FORMATS:
            raise InputError(f"no image format {image_format!r}; there is {', '.join(COLOUR_FORMATS)}")
        if projection not in PROJECTIONS:
            raise InputError(f"no projection {projection!r}; there is {', '.join(PROJECTIONS)}")
        if "valid" in what and calibration is None:
            raise InputError(
                f"{self.name}: valid is where the panorama reaches in a camera's image; name its calibration"
            )
        camera = self.to_camera(calibration) if calibration and {"rgb", "segments", "valid"} & set(what) else None
        stem = stem or self.name
        rasters = self._rasters() | self._echo_rasters(scan, set(what).intersection(ECHO_OUTPUTS))
        writers = list(self._raster_writers(stem, rasters, image_format, projection))
        writers += self._other_writers(stem, camera, image_format)
        writers.sort(key=lambda writer: (*OUTPUTS, *EXTRA_OUTPUTS).index(writer[0]))
        return [write_whole(Path(out) / name, write) for output, name, write in writers if output in what]

    def _rasters(self) -> dict[str, np.ndarray]:
        """Return the images of the panorama by output: (h, w, 3) uint8 colours, float32 metres, else ids uint8."""
        levels = (("confidence", self.confidence), ("measured", self.measured))
        source = np.zeros(self.segments.shape, dtype=np.uint8) if self.source is None else self.source
        rasters = {"rgb": self.colour, "segments": self.segments, "depth": self.depth_m, "source": source}
        return rasters | {name: _levels(values) for name, values in levels if values is not None}

    def _echo_rasters(self, scan: Scan | None, names: Collection[str]) -> dict[str, np.ndarray]:
        """Return images of a scan's echoes by the names of ECHO_OUTPUTS."""
        if not names:
            return {}
        if scan is None or len(scan) != len(self.labels):
            raise ValueError(f"{', '.join(ECHO_OUTPUTS)} are of the panorama's own scan of {len(self.labels)} points")
        if "near-infrared" in names and scan.near_infrared is None:
            raise InputError(
                f"{self.name}: has no near-infrared light (fields near_ir or ambient, as Ouster's); leave it out of"
                " --save"
            )
        image = echo_image(scan, self.view)
        rasters = {"remission": _levels(image.remission.numpy()), "range": image.range_m.numpy()}
        if image.near_infrared is not None:
            light = image.near_infrared.numpy().clip(min=0)
            full = np.percentile(light[light > 0], FULL_LIGHT) if (light > 0).any() else 1
            rasters["near-infrared"] = _levels((light / full).clip(max=1))
        return rasters

    def _raster_writers(
        self, stem: str, rasters: Mapping[str, np.ndarray], image_format: str, projection: str
    ) -> Iterator[Writer]:
        """Yield every image in a projection, the name of its file, and a function that writes it."""
        view, xmp = self.view, b""
        if projection == "equirectangular":
            view = equirectangular(view)
            xmp = gpano(view)
        text = {} if projection == "cubemap" else {VIEW_KEYWORD: json.dumps(view.as_dict())}
        colour = partial(write_colour, image_format=image_format, text=text, xmp=xmp)
        images: Mapping[str, Lookup | None] = {"": None} if projection == "cylinder" else lookups(self.view, projection)
        for part, lookup in images.items():
            for name, values in rasters.items():
                ending = COLOUR_FORMATS[image_format][0] if name == "rgb" else f".{name}.png"
                write = WRITERS.get(name, write_ids) if name != "rgb" else colour
                shown = partial(_resampled, values, lookup)
                yield name, f"{stem}{part}{ending}", lambda path, write=write, shown=shown: write(path, shown())

    def _other_writers(self, stem: str, camera: CameraImage | None, image_format: str) -> Iterator[Writer]:
        """Yield the labels and a camera's images, the names of their files, and functions that write them."""
        yield "labels", f"{stem}.label", lambda path: SEMANTIC_KITTI.to_raw(self.labels).astype("<u4").tofile(path)
        if camera:
            ending = COLOUR_FORMATS[image_format][0]
            yield "rgb", f"{stem}.camera{ending}", lambda path: write_colour(path, camera.colour, image_format)
            yield "segments", f"{stem}.camera-segments.png", lambda path: write_palette(path, camera.segments)
            yield "valid", f"{stem}.camera-valid.png", lambda path: write_ids(path, _levels(camera.valid))


def _levels(shares: np.ndarray) -> np.ndarray:
    """Return shares of one as uint8 levels, 255 = 1."""
    return np.round(shares * np.float32(255)).astype(np.uint8)


def _resampled(values: np.ndarray, lookup: Lookup | None) -> np.ndarray:
    """Return an image (H, W) or (H, W, 3) by a look-up: colours linearly, of others the nearest; zero where none is."""
    if lookup is None:
        return values
    if values.ndim == 2:
        return lookup.nearest(torch.from_numpy(values)).numpy()
    colour = lookup.linear(torch.from_numpy(values).movedim(2, 0).float())
    return colour.round().movedim(0, 2).to(torch.uint8).contiguous().numpy()
