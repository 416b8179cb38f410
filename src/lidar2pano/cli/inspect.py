"""lidar2pano inspect."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.options import ForwardOption, HeightOption, RemissionOption
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from lidar2pano.formats.interpretation import Interpretation, Overrides
    from lidar2pano.scan import Scan

EPOCH_S = 1e8  # stamps beyond this count from 1970
UNITS = {  # of coordinates, by their length in metres
    1.0: "metres", 1e-2: "centimetres", 1e-3: "millimetres", 1e-4: "0.1 millimetres", 1e-5: "0.01 millimetres",
    1e-6: "micrometres",
}  # fmt: skip


@app.command()
def inspect(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A scan file of any format, a folder of them, a recording, or -.")
    ],
    topic: Annotated[str, typer.Option(metavar="NAME", help="The recording's topic whose first scan is shown.")] = "",
    sensor_height: HeightOption = None,
    forward: ForwardOption = "",
    remission: RemissionOption = "",
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON on stdout.")] = False,
) -> None:
    """Show the contents of a file and how it will be read; of a folder or recording, its first scan."""
    from lidar2pano.cli.console import spooled
    from lidar2pano.drives.folders import drive_files
    from lidar2pano.formats.interpretation import Overrides
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.recordings.reading_process import describe

    overrides = Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission, invent=True)
    with spooled([path]) as (source,):
        first, *further = drive_files(source, ReadOptions())
        if about := describe(first):
            record = {"input": str(first), **about.as_dict(), "recordings": 1 + len(further)}
            record["first"] = first_scan(first, topic, overrides)
            lines = lines_of_recording(record)
        else:
            record = first_scan(first, "", overrides) | {"scans": 1 + len(further)}
            if "problem" in record:
                raise InputError(record["problem"])
            lines = lines_of(record)
    print(json.dumps(record) if as_json else "\n".join(lines))


def first_scan(path: Path, topic: str, overrides: Overrides) -> dict[str, Any]:
    """Describe the first scan of a file or recording, or its fault under "problem"."""
    from lidar2pano.formats.interpretation import interpret
    from lidar2pano.formats.readers import ReadOptions
    from lidar2pano.recordings import reading_process
    from lidar2pano.recordings.recorded_scans import recording_reader

    title = str(path)
    try:
        if recording_reader(path) is None:
            cloud = reading_process.read_cloud(path)
        else:
            frame = next(reading_process.frames(path, ReadOptions(topic=topic)))
            title, cloud = frame.title, frame.cloud()
    except InputError as error:
        return {"problem": str(error)}
    try:
        return {"input": title, "scans": 1, **described(*interpret(cloud, overrides))}
    except InputError as error:
        return {"problem": f"{title}: {error}"}


def lines_of_recording(record: dict[str, Any]) -> list[str]:
    """Return a recording's record for people: its topics, then its first scan."""
    more = f" (the first of {record['recordings']} files)" if record["recordings"] > 1 else ""
    lines = [f"{record['input']}{more}", _line("format", record["format"])]
    count = sum(topic["count"] for topic in record["topics"])
    lines.append(_line("messages", f"{count} in {record['duration_s']:.3f} s"))
    if count:
        lines.append(_line("start", _stamp(record["start_s"])))
    lines += [_line("topic", f"{topic['name']}: {topic['count']} {topic['type']}") for topic in record["topics"]]
    first = record["first"]
    return [*lines, *([_line("scans", first["problem"])] if "problem" in first else lines_of(first))]


def described(scan: Scan, interpretation: Interpretation) -> dict[str, Any]:
    """Describe how a scan was read, and its contents: ranges, beams, sensor."""
    from lidar2pano.formats.beams import find_beams
    from lidar2pano.formats.plausibility import narrow_view
    from lidar2pano.formats.sensor_placement import LEVELLED

    tilted = interpretation.turn_by == LEVELLED  # a sensor's beams are cones about its own axis
    own = find_beams(scan.xyz @ interpretation.rotation, scan.ring) if tilted else None
    beams = own or find_beams(scan.xyz, scan.ring)
    reading = interpretation.as_dict()
    reading["gaps_deg"], _ = [list(gap) for gap in interpretation.gaps_deg], reading.pop("invented")
    if narrow := narrow_view(interpretation.gaps_deg):
        reading["doubts"] = [*interpretation.doubts, narrow]  # an error of translate
    return {
        **reading,
        "ranges_m": ranges_m(scan.xyz),
        "times_s": [round(float(edge), 6) for edge in (scan.time_s.min(), scan.time_s.max())]
        if scan.time_s is not None and len(scan.time_s)
        else [],
        "beams": len(beams.elevations_deg) if beams else None,
        "beams_by": beams.found_by if beams else "",
        "elevations_deg": [round(value, 2) for value in beams.elevations_deg] if beams else [],
        "sensor": beams.sensor() if beams else "",
    }


def ranges_m(xyz: np.ndarray) -> list[float]:
    """Return the least, middle and largest range of points (N, 3); [] if there are none."""
    import numpy as np

    with np.errstate(invalid="ignore"):
        squared = np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64)  # no copy of all points
    squared = squared[np.isfinite(squared) & (squared > 0)]
    return [round(float(value), 2) for value in np.percentile(np.sqrt(squared), (0, 50, 100))] if len(squared) else []


def lines_of(record: dict[str, Any]) -> list[str]:
    """Return a record for people: one line per property."""
    more = f" (the first of {record['scans']} scans)" if record["scans"] > 1 else ""
    lines = [f"{record['input']}{more}", _line("format", record["format"])]
    lines.append(_line("fields", " ".join(record["fields"]) or "none"))
    none = f", {record['no_returns']} of them no returns (at the origin, NaN or Inf)" if record["no_returns"] else ""
    lines.append(_line("points", f"{record['points']}{none}"))
    if record["ranges_m"]:
        least, middle, most = record["ranges_m"]
        lines.append(_line("ranges", f"{least:g} to {most:g} m, half of them within {middle:g} m"))
    lines.append(_line("unit", UNITS[record["unit_m"]]))
    frame = f"{record['frame']}: " if record["frame"] else ""
    lines.append(_line("frame", f"{frame}{record['forward']} is forward ({record['forward_by']})"))
    if record["turn_by"]:
        lines.append(_line("turned", record["turn_by"]))
    x, y, z = record["viewpoint_m"]
    lines.append(_line("viewpoint", f"({x:g}, {y:g}, {z:g}) m: {record['viewpoint_by']}"))
    if record["ground_m"] is not None:
        assumed = " (assumed; name the height with --sensor-height)" if record["assumed_height_m"] else ""
        tilt = f"tilted by {record['tilt_deg']:g} degrees"
        lines.append(_line("ground", f"{record['ground_m']:g} m below it{assumed}, {tilt}"))
    else:
        lines.append(_line("ground", "none found"))
    lines.append(_line("remission", _remission(record)))
    gaps = record["gaps_deg"]
    view_deg = 360 - sum(left - right for left, right in gaps)
    nothing = " and ".join(f"from {left:g} down to {right:g}" for left, right in gaps)
    lines.append(_line("in view", f"{view_deg:g} of 360 degrees, nothing {nothing}" if gaps else "all around"))
    lines.append(_line("beams", _beams(record)))
    lines.append(_line("sensor", f"like {record['sensor']}" if record["sensor"] else "unknown"))
    lines += [_line("doubt", text) for text in record["doubts"]]
    if record["stamp_s"] is not None:
        lines.append(_line("stamp", _stamp(record["stamp_s"])))
    if record["times_s"]:
        lines.append(_line("times", "{:g} to {:g} s".format(*record["times_s"])))
    return lines


def _line(name: str, text: str) -> str:
    return f"  {name:<11}{text}"


def _remission(record: dict[str, Any]) -> str:
    if record["remission_full"] is None:
        return "none or constant; a constant stands in"
    odd = f", {record['remission_odd']} beyond or missing" if record["remission_odd"] else ""
    most = record["remission_zero"] + record["remission_full"]
    scaled = f"{most:g} becomes 1" if most != 1 or record["remission_zero"] else "as it is"
    return f"{record['remission']} ({scaled}{odd})"


def _beams(record: dict[str, Any]) -> str:
    if not record["beams"]:
        return "none found"
    up, down = record["elevations_deg"][0], record["elevations_deg"][-1]
    return f"{record['beams']}, from {up:g} to {down:g} degrees of elevation (by {record['beams_by']})"


def _stamp(stamp_s: float) -> str:
    if stamp_s < EPOCH_S:
        return f"{stamp_s:.6f} s"
    when = datetime.datetime.fromtimestamp(stamp_s, datetime.UTC)
    return f"{stamp_s:.6f} s ({when.isoformat(sep=' ', timespec='milliseconds')})"
