"""Viewpoints: scans of a map as a sensor would give them at any place, hidden points left out."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.drives.folders import drive_files
from lidar2pano.drives.reading import Reading, ReadingOptions, ScanSource
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.ground_plane import best_ground
from lidar2pano.formats.interpretation import SAMPLE, Interpretation, interpret, scale_remission
from lidar2pano.formats.map_blocks import Block
from lidar2pano.formats.plausibility import doubts_about_ground, find_gaps
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.surfels import Rays, first_hits, fit_surfels, thin_by_range
from lidar2pano.progress import working
from lidar2pano.recordings import reading_process
from lidar2pano.recordings.recorded_scans import recording_reader
from lidar2pano.scan import Scan
from lidar2pano.simulate.sensor_models import SENSOR_MODELS, SensorModel
from lidar2pano.views import FULL_TURN, sensor_view

SENSOR = "hdl64e"  # where none is named: KITTI's, best known to the weights
CELL_STEPS = 2  # firings: points are thinned out to cells so wide, finer than the rows of all sensors but one
MARGIN_DEG = 2.0  # beyond the beams: surfels there reach in between them
AT_ONCE = 8  # places in one reading of the map
MOST_HELD = 1 << 20  # points added before they are thinned out again
MOST_SWEEP = 1 << 20  # points; the densest LiDAR's sweep has 0.6 million: more are a map
FEWEST = 500  # points in view; with fewer there is nothing to be seen
FORM = "is not of the form X,Y,Z in metres, nor a file with the columns x, y, z and, if you like, heading and name"
MOST_PLACES_BYTES = 1 << 20  # some ten thousand lines
COLUMNS = ("x", "y", "z", "heading", "name")
NAME = re.compile(r"\w(?:[\w -]*\w)?")


@dataclass(frozen=True, kw_only=True)
class Place:
    """A sensor's place in a map.

    position_m   in the map's own axes, z up.
    heading_deg  the direction ahead: counter-clockwise from the map's x axis, as azimuth; 90 is along y.
    name         of its outputs, "" for a number.
    """

    position_m: tuple[float, float, float]
    heading_deg: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse infinite numbers, and names of no file (InputError)."""
        if not all(map(math.isfinite, (*self.position_m, self.heading_deg))):
            raise InputError(f"--at {self}: a place needs finite numbers; write X,Y,Z in metres, headings in degrees")
        if self.name and not NAME.fullmatch(self.name):
            raise InputError(f"--at: {self.name!r} names no file; use letters, digits, - and _")

    def __str__(self) -> str:
        """Return x,y,z as the option has them."""
        return ",".join(f"{value:.10g}" for value in self.position_m)

    @property
    def T_map_sensor(self) -> np.ndarray:
        """The pose (4, 4) float64: x ahead, y left, z up."""
        cosine, sine = math.cos(math.radians(self.heading_deg)), math.sin(math.radians(self.heading_deg))
        T = np.eye(4)
        T[:2, :2], T[:3, 3] = [[cosine, -sine], [sine, cosine]], self.position_m
        return T


def parse_places(text: str, heading_deg: float = 0.0) -> list[Place]:
    """Return the place "X,Y,Z", or those of a file; heading_deg: of places without one.

    The file has a place a line: x, y, z, then heading and name if wanted, or these columns in the order of a header.
    """
    words = text.split(",")
    if all(map(_is_number, words)) and len(words) == 3:
        return [_place(dict(zip(COLUMNS, words, strict=False)), heading_deg)]
    if not Path(text).is_file():
        raise InputError(f"--at {text!r}: {FORM}")
    return _read_places(Path(text), heading_deg)


def _read_places(path: Path, heading_deg: float) -> list[Place]:
    lines = read_input(path, "name a file of places", MOST_PLACES_BYTES).decode("utf-8-sig", "replace").splitlines()
    rows = [re.split(r"\s*[,;\t]\s*", line.strip()) for line in lines if line.strip() and line[0] != "#"]
    header = list(COLUMNS)
    if rows and not any(map(_is_number, rows[0])):
        header = [name.lower() for name in rows.pop(0)]
    if not {"x", "y", "z"} <= set(header) <= set(COLUMNS):
        raise InputError(f"--at {path}: its columns are {', '.join(header)}; there are {', '.join(COLUMNS)}")
    places = []
    for number, row in enumerate(rows, 1):
        cells = dict(zip(header, row, strict=False))
        if len(row) > len(header) or not all(_is_number(cells.get(axis, "")) for axis in "xyz"):
            raise InputError(f"--at {path}: place {number} is {','.join(row)!r}; write x,y,z in metres")
        places.append(_place(cells, heading_deg))
    if not places:
        raise InputError(f"--at {path}: holds no places; write one a line: x,y,z")
    counts = Counter(place.name for place in places if place.name)
    if twice := next((name for name, count in counts.items() if count > 1), ""):
        raise InputError(f"--at {path}: two places are called {twice!r}; give each a name of its own")
    return places


def _place(cells: dict[str, str], heading_deg: float) -> Place:
    heading = cells.get("heading", "")
    if heading and not _is_number(heading):
        raise InputError(f"--at: the heading {heading!r} is no number; write degrees")
    x, y, z = (float(cells[axis]) for axis in "xyz")
    return Place(
        position_m=(x, y, z), heading_deg=float(heading) if heading else heading_deg, name=cells.get("name", "")
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def scans_at(
    paths: str | Path | Iterable[str | Path], places: Place | Sequence[Place], sensor: str = SENSOR
) -> Iterator[Scan]:
    """Yield the scans of a map by a sensor of VIEWS at each place, in its own frame.

    paths  of the map, or of all its parts in one frame, metres, z up: files of any format, or folders of them. LAS,
           LAZ, PLY, PCD and E57 are read in blocks: the memory does not grow with the map.
    Raises InputError for a place outside the map or with no point in reach, an unreadable map, and a single sweep.
    """
    places = [places] if isinstance(places, Place) else list(places)
    paths = [paths] if isinstance(paths, str | Path) else list(paths)
    files = [file for path in paths for file in drive_files(Path(path), ReadOptions())]
    for reading in place_readings(files, places, sensor, ReadingOptions()):
        if reading.error or reading.scan is None:
            raise reading.error or AssertionError
        yield reading.scan


def place_readings(
    files: Sequence[Path], places: Sequence[Place], sensor: str, options: ReadingOptions
) -> Iterator[Reading]:
    """Yield the reading of each place in a map of `files`, or its error; InputError for an unusable map.

    options  `overrides` about remission and invention hold, `poses` and `strict`; others are of scans.
    """
    model = sensor_model(sensor or SENSOR)
    check_map(files)
    stem = stem_of(files[0])
    numbered = [
        place.name or (f"{stem}-{number:06d}" if len(places) > 1 else stem) for number, place in enumerate(places)
    ]
    for start in range(0, len(places), AT_ONCE):
        surroundings = [Surroundings(place, model) for place in places[start : start + AT_ONCE]]
        extent = read_surroundings(files, surroundings)
        for number, surrounding in enumerate(surroundings, start):
            source = ScanSource(
                path=files[0],
                title=f"{files[0]} at {surrounding.place}",
                stem=numbered[number],
                cloud=_no_cloud,
                stream=(files[0], "places") if options.poses else None,
                number=number,
            )
            yield _reading(source, surrounding, extent, options)


def sensor_model(name: str) -> SensorModel:
    """Return the model of a sensor in VIEWS; where there is none, one with a beam in each row of its view."""
    view = sensor_view(name)
    if name in SENSOR_MODELS:
        return SENSOR_MODELS[name]
    step = (view.up - view.down) / view.rows
    return SensorModel(
        elevation=tuple(view.up - (row + 0.5) * step for row in range(view.rows)),
        firings=round(view.columns * FULL_TURN / (view.left - view.right)),
    )


def check_map(files: Sequence[Path]) -> None:
    """Raise InputError for recordings, and for a single sweep, with the shadows of its own place."""
    if not files:
        raise InputError("--at: no map is named; name its files")
    if recording := next((file for file in files if recording_reader(file)), None):
        raise InputError(f"{recording}: is a recording, which --at does not read; join its scans to a map")
    if len(files) > 1:
        return
    parts = list[np.ndarray]()
    with closing(reading_process.near_blocks(files[0], np.zeros((1, 3)), math.inf)) as blocks:
        for block in blocks:
            parts.append(block.xyz)
            if sum(map(len, parts)) > MOST_SWEEP:
                return
    try:
        interpret(PointCloud(xyz=np.concatenate(parts)))
    except InputError:
        return  # it is anything but a sweep
    raise InputError(
        f"{files[0]}: is a single sweep, seen from its own place, and no map; leave --at out, or name scans joined in"
        " one frame"
    )


@dataclass(kw_only=True)
class Extent:
    """The bounds of a map."""

    low: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, block: Block) -> None:
        """Add a block of points."""
        self.low, self.high = np.minimum(self.low, block.low), np.maximum(self.high, block.high)

    def __str__(self) -> str:
        """Return the bounds of each axis."""
        return ", ".join(
            f"{axis} {low:.10g} to {high:.10g}" for axis, low, high in zip("xyz", self.low, self.high, strict=True)
        )


class Surroundings:
    """The points of a map in reach of a sensor's place, thinned out as they come: so many are never held at a time."""

    def __init__(self, place: Place, model: SensorModel) -> None:
        self.place, self.model = place, model
        self.rays = Rays(
            elevation=np.radians(model.elevation), azimuth=np.radians(model.per_beam("azimuth")), firings=model.firings
        )
        self.cell = CELL_STEPS * self.rays.step
        slope = np.radians((model.elevation[-1] - MARGIN_DEG, model.elevation[0] + MARGIN_DEG))
        self._slope = np.tan(np.clip(slope, -1.57, 1.57))
        self._T = place.T_map_sensor
        self._xyz, self._intensity = list[np.ndarray](), list[np.ndarray]()
        self._added = 0

    def add(self, block: Block) -> None:
        """Add the points of a block in view of the sensor."""
        xyz = (block.xyz - self._T[:3, 3]) @ self._T[:3, :3]
        squared, level = np.einsum("ij,ij->i", xyz, xyz), np.hypot(xyz[:, 0], xyz[:, 1])
        near, far = self.model.min_range, self.model.max_range
        kept = (squared >= near * near) & (squared <= far * far)
        kept &= (xyz[:, 2] >= self._slope[0] * level) & (xyz[:, 2] <= self._slope[1] * level)
        if not kept.any():
            return
        self._xyz.append(xyz[kept].astype(np.float32))
        missing = np.full(len(block.xyz), np.nan, np.float32)
        self._intensity.append((missing if block.intensity is None else block.intensity)[kept])
        self._added += len(self._xyz[-1])
        if self._added > MOST_HELD:
            self.points()

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (N, 3) float32 in the sensor's frame, metres, and their intensities as stored."""
        if not self._xyz:
            return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        xyz, intensity = np.concatenate(self._xyz), np.concatenate(self._intensity)
        chosen = thin_by_range(xyz, self.cell)
        self._xyz, self._intensity, self._added = [xyz[chosen]], [intensity[chosen]], 0
        return self._xyz[0], self._intensity[0]


def read_surroundings(files: Sequence[Path], surroundings: Sequence[Surroundings]) -> Extent:
    """Read a map once for some places; returns its extent."""
    extent = Extent()
    positions = np.array([surrounding.place.position_m for surrounding in surroundings])
    with working("reading the map") as advance:
        for file in files:
            for block in reading_process.near_blocks(file, positions, surroundings[0].model.max_range):
                extent.add(block)
                for surrounding in surroundings:
                    surrounding.add(block)
                advance()
    return extent


def see(surrounding: Surroundings, remission: np.ndarray) -> Scan:
    """Return the scan of the surroundings, beam by beam; remission: (N,) of their points."""
    xyz = surrounding.points()[0].astype(np.float64)
    surfels = fit_surfels(xyz, remission, surrounding.cell * np.linalg.norm(xyz, axis=1))
    range_m, value = first_hits(surfels, surrounding.rays)
    beam, firing = np.nonzero((range_m >= surrounding.model.min_range) & (range_m <= surrounding.model.max_range))
    hits = surrounding.rays.directions(beam, firing) * range_m[beam, firing, None]
    return Scan(xyz=hits.astype(np.float32), remission=np.clip(value[beam, firing], 0, 1), ring=beam.astype(np.int64))


def _reading(source: ScanSource, surrounding: Surroundings, extent: Extent, options: ReadingOptions) -> Reading:
    """Return the reading of a place; an unusable place is its error."""
    reading = Reading(source=source, pose=surrounding.place.T_map_sensor if options.poses else None)
    try:
        with reading.timer("read"):
            scan, interpretation = _seen(surrounding, extent, options)
    except InputError as error:
        return replace(reading, error=InputError(f"{source.title}: {error}"))
    return replace(reading, scan=replace(scan, name=source.title), interpretation=interpretation)


def _seen(surrounding: Surroundings, extent: Extent, options: ReadingOptions) -> tuple[Scan, Interpretation]:
    position, model, overrides = np.array(surrounding.place.position_m), surrounding.model, options.overrides
    if not ((position[:2] >= extent.low[:2]) & (position[:2] <= extent.high[:2])).all():
        raise InputError(f"the place is outside of the map ({extent}); name one within")
    xyz, intensity = surrounding.points()
    if len(xyz) < FEWEST:
        reach = f"{model.min_range:g} to {model.max_range:g} m away"
        raise InputError(f"only {len(xyz)} points of the map are in view ({reach}); the map has {extent}")
    remission = scale_remission(intensity, np.ones(len(xyz), bool), overrides.remission, None)
    scan = see(surrounding, remission.values)
    gaps_deg = find_gaps(scan.xyz, overrides.invent) if len(scan) else ()
    sample = scan.xyz[:: max(1, len(scan) // SAMPLE)]
    ground = best_ground(sample.astype(np.float64))
    doubts = (*remission.doubts, *(() if ground and ground.height_m < 0 else doubts_about_ground(sample)))
    if options.strict and doubts:
        raise InputError(f"{doubts[0]} (an error because of --strict)")
    interpretation = Interpretation(
        format="map",
        fields=("x", "y", "z", "intensity"),
        frame="",
        stamp_s=None,
        points=len(scan),
        no_returns=0,
        viewpoint_by="--at",
        viewpoint_m=surrounding.place.position_m,
        forward_by="--heading",
        ground_m=round(-ground.height_m, 2) if ground else None,
        remission=remission.scale.name,
        remission_full=remission.scale.full,
        remission_zero=remission.scale.zero,
        remission_odd=remission.odd,
        gaps_deg=gaps_deg,
        invented=overrides.invent,
        doubts=doubts,
    )
    return replace(scan, gaps_deg=() if overrides.invent else gaps_deg), interpretation


def _no_cloud() -> NoReturn:
    raise InputError("a place of a map has no file of its own; name the map")
