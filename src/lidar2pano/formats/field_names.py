"""The meanings of columns by their names: axes, remission, beam, time; and units in names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

# Names of fields, the best first; compared in lower case, without CloudCompare's "scalar_" ("Scalar field": unnamed).
INTENSITY = ("reflectivity", "reflectance", "remission", "intensity", "intensities", "signal", "i", "field")
NEAR_INFRARED = ("near_ir", "ambient", "near_infrared", "nir")  # Ouster's in packets and in ROS, and others'
RING = ("ring", "channel", "laser_number", "laser_id", "beam", "line", "row")
TIME = (
    "offset_ns",
    "offset_time",
    "time_offset",
    "time",
    "time_stamp",
    "timestamp",
    "timestamps",
    "t",
    "gps_time",
    "gpstime",
)
# Beginnings of words within longer names: "pcloud_attr.reflectance", "Intensität", "Signal Photons", "refl", and of
# Chinese and Japanese, Korean and Russian ones
INTENSITY_WORDS, RING_WORDS, TIME_WORDS = (
    (
        "refl",
        "remis",
        "inten",
        "signal",
        "amplitude",
        "\u53cd\u5c04",
        "\u5f3a\u5ea6",
        "\u5f37\u5ea6",
        "\ubc18\uc0ac",
        "\uac15\ub3c4",
        "\u0438\u043d\u0442\u0435\u043d",
        "\u043e\u0442\u0440\u0430\u0436",
    ),
    ("ring", "laser"),
    ("time",),
)
NEAR_INFRARED_WORDS = ("ambient", "infrared")
FIELDS = (
    (INTENSITY, INTENSITY_WORDS),
    (RING, RING_WORDS),
    (TIME, TIME_WORDS),
    (NEAR_INFRARED, NEAR_INFRARED_WORDS),
)
# Names of axes: "X", "x_coord", "position.x", "Point:0" (Ouster Studio), "Points_m_XYZ:0" (VeloView), "xyz[0]"
PLACE = r"(?:points?|pos(?:ition)?|coordinates?|coords?|location|cartesian|scalar|xyz|m)"
AXIS = re.compile(rf"(?:{PLACE}[ _.:/-]*)*(?:([xyz])|(?<=\w)[ _.:/\[-]*([012])\]?)(?:[ _.-]*(?:{PLACE}|axis))*")
EARTH = (re.compile("east(?:ing)?"), re.compile("north(?:ing)?"), re.compile("elevation|altitude|height|up"))
# Names of ranges and angles, where there are no axes: "Range (m)", "distance_mm", "azimuth_deg", "vertical_angle"
SPHERICAL = tuple(
    re.compile(rf"(?:{names})(?:[ _.-]*(?:m|deg(?:rees?)?|rad(?:ians?)?))?")
    for names in ("range|dist(?:ance)?|radius", "azimuth|azi?", "elevation|elev?|(?:vertical|altitude)[ _]angle")
)
# Other vectors than places: normals, velocities, accelerations, turns, errors
VECTOR = re.compile(
    r"(?:.*[^a-z])?(?:n|normals?|v|vel\w*|a|acc\w*|g|gyro\w*|w|ang\w*|q|rot\w*|ori\w*|dir\w*|std|sigma)"
)
POSE = "pose"  # begins the names of all columns of a table of poses without names
# "qx", "q_RS_w []", "pose.orientation.x"
QUATERNION = re.compile(r"(?:.*[^a-z])?(?:q|quat\w*|orient\w*)[^a-z]*(?:[a-z]+[^a-z]+)?([xyzw])[^a-z]*")
UNIT = re.compile(  # "x [mm]", "Range (m)", "y_mm"
    r"(.*\S)\s*[\[(]\s*([^\])]*?)\s*[\])]"
    r"|(\w+?)[ _](m|[dcmu\u00b5\u03bc]m|km|ft|feet|inch(?:es)?|(?:milli|centi|micro)?met(?:re|er)s?)"
)
MICRO = str.maketrans("\u00b5\u03bc", "uu")  # the sign and the Greek letter
METRES = {
    "m": 1.0, "met": 1.0, "dm": 0.1, "cm": 1e-2, "centimet": 1e-2, "mm": 1e-3, "millimet": 1e-3, "um": 1e-6,
    "micromet": 1e-6, "micron": 1e-6, "nm": 1e-9, "km": 1e3, "ft": 0.3048, "feet": 0.3048, "foot": 0.3048,
    "ftus": 1200 / 3937, "us survey feet": 1200 / 3937, "us-ft": 1200 / 3937, "in": 0.0254, "inch": 0.0254,
    "inche": 0.0254, "yd": 0.9144,
}  # fmt: skip
SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3, "us": 1e-6, "usec": 1e-6,
    "microsecond": 1e-6, "ns": 1e-9, "nsec": 1e-9, "nanosec": 1e-9, "nanosecond": 1e-9,
}  # fmt: skip
# "sec" and "nsec", "timestamp_s" and "timestamp_ns", "stamp.secs" and "stamp.nsecs", "tv_sec" and "tv_usec"
SECONDS_OF = re.compile(r"(|.*[ _.:/-])(n(?:ano)?|u|micro)?(s|secs?|seconds?)")
FRACTIONS = {"n": 1, "u": 1000, "m": 1000}  # nanoseconds


class Column(NamedTuple):
    """The name of a column, x, y or z for an axis, and its unit in metres or seconds."""

    name: str
    factor: float = 1.0


def column(cell: str) -> Column:
    """Return the meaning of a name alone."""
    plain, factor = _without_unit(cell)
    if axis := AXIS.fullmatch(plain.lower()):
        plain = axis[1] or "xyz"[int(axis[2])]
    return Column(plain, factor)


def _without_unit(cell: str) -> Column:
    plain, unit = cell.strip(), ""
    if not AXIS.fullmatch(plain.lower()) and (named := UNIT.fullmatch(plain)):
        plain, unit = (named[1], named[2]) if named[1] else (named[3], named[4])
    return Column(plain, unit_factor(plain, unit, 1.0))


def unit_factor(name: str, unit: str, otherwise: float) -> float:
    """Return the length in metres, or for a time the seconds, of a unit of a column; `otherwise` for an unknown one."""
    unit = unit.lower().translate(MICRO)
    factors = SECONDS if "time" in name.lower() else METRES
    stem = re.sub(r"(?<=met)(?:re|er)s?$|(?<=\w\w)s$", "", unit)  # metres, meters, seconds
    return factors.get(unit, factors.get(stem, otherwise))


def meanings(names: Sequence[str]) -> list[Column]:
    """Return the meanings of the names of a table's columns.

    Where not all axes are named by themselves, three names that differ by an axis's letter ("lidar_x", "lidar_y",
    "lidar_z") or by a number alone are the axes.
    """
    columns = list(map(column, names))
    if {"x", "y", "z"} <= {name for name, _ in columns}:
        return columns
    plain = list(map(_without_unit, names))
    axes = _alike([name for name, _ in plain])
    return [Column(axes.get(place, name), factor) for place, (name, factor) in enumerate(plain)]


def has_axes(names: Sequence[str]) -> bool:
    """Return whether names of columns have those of all axes among them, or of a range and two angles."""
    return {"x", "y", "z"} <= {name for name, _ in meanings(names)} or bool(spherical(names))


def spherical(names: Sequence[str]) -> list[str]:
    """Return the names of a range, an azimuth and an elevation; [] if there are none."""
    keys = [next((name for name in names if form.fullmatch(plain_name(column(name).name))), "") for form in SPHERICAL]
    return keys if all(keys) else []


def are_numbered(names: Sequence[str]) -> bool:
    """Return whether names say nothing but numbers from 0 or 1 on: "Col1", "Col2", ..."""
    parts = [re.fullmatch(r"(.*?)(\d+)", name.strip()) for name in names]
    numbers = [int(part[2]) if part else -1 for part in parts]
    return len({part and part[1] for part in parts}) == 1 and numbers in (
        list(range(len(names))),
        list(range(1, len(names) + 1)),
    )


def _alike(names: Sequence[str]) -> dict[int, str]:
    """Return place -> axis for three names that differ by an axis alone; {} if there are none."""
    for letters in ("xyz", "012", "123"):
        groups: dict[tuple[str, str], dict[str, int]] = {}
        for place, name in enumerate(names):
            lower = name.lower()
            for at, letter in enumerate(lower):
                if letter in "0123456789" if letters != "xyz" else letter in letters:
                    groups.setdefault((lower[:at], lower[at + 1 :]), {})[letter] = place
        triples = [(len(before) + len(behind), before, places) for (before, behind), places in groups.items()
                   if set(places) == set(letters)]  # fmt: skip
        for _, before, places in sorted(triples, key=lambda triple: triple[0]):
            if not VECTOR.fullmatch(before.rstrip(" _.:/-[")):
                return {places[letter]: axis for letter, axis in zip(letters, "xyz", strict=True)}
    places = [next((place for place, name in enumerate(names) if form.fullmatch(name.lower())), None) for form in EARTH]
    return {} if None in places else dict(zip((place for place in places if place is not None), "xyz", strict=True))


def are_poses(names: Iterable[str]) -> bool:
    """Return whether names are of poses: "pose 1", or the four parts of a quaternion, which points do not have."""
    names = [plain_name(name) for name in names]
    parts = {part[1] for name in names if (part := QUATERNION.fullmatch(name))}
    return parts == set("xyzw") or f"{POSE} 1" in names


def second_pairs(names: Sequence[str]) -> list[tuple[tuple[str, str], str, int]]:
    """Return pairs of names of a time's whole seconds and of the rest, what they share, and the rest's nanoseconds."""
    whole: dict[str, str] = {}
    parts: dict[str, tuple[str, int]] = {}
    for name in names:
        if named := SECONDS_OF.fullmatch(plain_name(name)):
            prefix, fraction, _ = named.groups()
            if fraction:
                parts[prefix] = name, FRACTIONS[fraction[0]]
            else:
                whole[prefix] = name
    return [
        ((whole[key], part), key.strip(" _.:/-") or "time", unit) for key, (part, unit) in parts.items() if key in whole
    ]


def plain_name(name: str) -> str:
    """Return a field's name in lower case, without CloudCompare's "scalar_"."""
    return name.strip().lower().removeprefix("scalar_").strip()


def find_named(keys: Iterable[str], exact: Sequence[str], words: Sequence[str]) -> list[str]:
    """Return the keys of one meaning, the best first: those of exact names, then those with a word that begins so."""
    keys = list(keys)
    by_name = {plain_name(key): key for key in reversed(keys)}
    found = [by_name[name] for name in exact if name in by_name]
    parts = {key: re.split(r"[\W\d_]+", plain_name(key)) for key in keys if key not in found}
    longer = (key for word in words for key, beginnings in parts.items() if any(p.startswith(word) for p in beginnings))
    return list(dict.fromkeys([*found, *longer]))
