"""Packets of Ouster sensors, decoded by their published format with the sensor's metadata.

Ouster, "Firmware user manual", chapters "LiDAR data packet format" and "Coordinate frames and XYZ calculation"; offsets
and masks of fields as in the table of profiles of Ouster's SDK.
"""

from __future__ import annotations

import glob
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.point_cloud import PointCloud, cloud_of_columns
from lidar2pano.name_order import sort_names

LEAST_SHARE = 0.5  # of a turn's columns: a capture begins and ends within turns
MOST_PENDING = 256  # datagrams whose fragments are incomplete


def _record(size: int, **fields: tuple[Any, int]) -> np.dtype:
    """Return the layout of so many bytes by (dtype, offset) of each field."""
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": list(formats), "offsets": list(offsets), "itemsize": size})  # pyright: ignore[reportArgumentType, reportCallIssue]


class Profile(NamedTuple):
    """Layout of a packet.

    pixel                   its fields; those of the second return have a 2 at the end.
    range_bits, range_m     of a range, and its unit.
    header, column, footer  bytes before the columns, before the pixels of one, and behind them.
    """

    pixel: np.dtype
    range_bits: int
    range_m: float
    header: int = 32
    column: int = 12
    footer: int = 0


WIDE = {"signal": ("<u2", 6), "near_ir": ("<u2", 8)}
LOW = {"range": ("<u2", 0), "reflectivity": ("u1", 2), "near_ir": ("u1", 3)}
LOW_DUAL = Profile(_record(8, **LOW, range2=("<u2", 4), reflectivity2=("u1", 6)), 15, 8e-3)
DUAL = {"range2": ("<u4", 4), "reflectivity2": ("u1", 7), "signal": ("<u2", 8), "near_ir": ("<u2", 12)}
PROFILES = {
    "LEGACY": Profile(_record(12, range=("<u4", 0), reflectivity=("<u2", 4), **WIDE), 20, 1e-3, 0, 16, 4),
    "RNG19_RFL8_SIG16_NIR16": Profile(_record(12, range=("<u4", 0), reflectivity=("u1", 4), **WIDE), 19, 1e-3),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(_record(16, range=("<u4", 0), reflectivity=("u1", 3), **DUAL), 19, 1e-3),
    "RNG15_RFL8_NIR8": Profile(_record(4, **LOW), 15, 8e-3),
    "RNG15_RFL8_NIR8_DUAL": LOW_DUAL,
    "FUSA_RNG15_RFL8_NIR8_DUAL": LOW_DUAL,
}


@dataclass(frozen=True, eq=False)
class Optics:
    """Directions of a sensor's beams, by its metadata.

    beams  (H, 2) float64 altitude and azimuth of each, radians;  columns: of a turn.
    origin_m  distance of a beam's origin from the axis;  T: (4, 4) sensor from LiDAR, metres.
    """

    beams: np.ndarray
    columns: int
    origin_m: float
    T: np.ndarray

    def cloud(
        self, columns: np.ndarray, stamps_ns: np.ndarray, returns: list[dict[str, np.ndarray]], name: str
    ) -> PointCloud:
        """Return the points of columns (n,) of a turn, beam after beam; no return is at the origin.

        returns  of each return the fields (beams, n), `range` in metres; points of the second follow, without those
                 of nothing. A field that the second lacks is the first's.
        """
        start_ns = int(stamps_ns.min())
        fields = {field: values.reshape(-1) for field, values in returns[0].items() if field != "range"}
        fields["ring"] = np.repeat(np.arange(len(self.beams)), len(columns))
        fields["offset_ns"] = np.tile((stamps_ns - start_ns).astype(np.int64), len(self.beams))
        xyz = self._places(columns, returns[0]["range"])
        for layer in returns[1:]:
            further = self._places(columns, layer["range"])
            held = further.any(1)
            second = fields | {field: values.reshape(-1) for field, values in layer.items() if field in fields}
            fields = {field: np.concatenate([fields[field], second[field][held]]) for field in fields}
            xyz = np.concatenate([xyz, further[held]])
        points: dict[str, np.ndarray] = {**dict(zip("xyz", xyz.T, strict=True)), **fields}
        return cloud_of_columns(points, format="Ouster packets", name=name, frame="os_sensor", stamp_s=start_ns * 1e-9)

    def _places(self, columns: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """Return the points (beams * n, 3) float32 at ranges (beams, n)."""
        encoder = 2 * np.pi * (1 - columns / self.columns)
        altitude, azimuth = (self.beams[:, axis, None] for axis in (0, 1))
        along = range_m - self.origin_m
        x = along * np.cos(encoder - azimuth) * np.cos(altitude) + self.origin_m * np.cos(encoder)
        y = along * np.sin(encoder - azimuth) * np.cos(altitude) + self.origin_m * np.sin(encoder)
        xyz = np.stack([x, y, along * np.sin(altitude)], axis=-1) @ self.T[:3, :3].T + self.T[:3, 3]
        return np.where(range_m[..., None] > 0, xyz, 0).reshape(-1, 3).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor that sends packets of so many columns."""

    profile: Profile
    optics: Optics
    packet_columns: int

    @property
    def packet_bytes(self) -> int:
        """Length of its packets of points; as much as before the columns is behind them."""
        return self.packet_columns * self.block.itemsize + 2 * self.profile.header

    @cached_property
    def block(self) -> np.dtype:
        """A column of a packet."""
        layout, count = self.profile, len(self.optics.beams)
        end = layout.column + count * layout.pixel.itemsize
        status = ("<u2", end if layout.footer else 10)
        pixels = ((layout.pixel, count), layout.column)
        return _record(end + layout.footer, stamp_ns=("<u8", 0), column=("<u2", 8), status=status, pixels=pixels)

    def columns_of(self, payload: bytes) -> np.ndarray:
        """Return the valid columns of a packet."""
        rows = np.frombuffer(payload, self.block, self.packet_columns, self.profile.header)
        return rows[(rows["status"] & 1 == 1) & (rows["column"] < self.optics.columns)]

    def cloud(self, rows: np.ndarray, name: str) -> PointCloud:
        """Return the points of the columns (n,) of a turn, as `Optics.cloud` does."""
        pixels, names = rows["pixels"].T, self.profile.pixel.names or ()  # (beams, n)
        first = {name: pixels[name] for name in names if not name.endswith("2")}
        returns = [first | {"range": self._range_m(pixels["range"])}]
        if "range2" in names:
            returns.append({"reflectivity": pixels["reflectivity2"], "range": self._range_m(pixels["range2"])})
        return self.optics.cloud(rows["column"], rows["stamp_ns"], returns, name)

    def _range_m(self, ranges: np.ndarray) -> np.ndarray:
        return (ranges & (1 << self.profile.range_bits) - 1) * self.profile.range_m


def read_sensor(path: Path) -> Sensor:
    """Return the sensor of a metadata .json, of any firmware; InputError for another file or an unknown profile."""
    optics, settings = optics_of(read_json(path), str(path))
    name = str(settings.get("udp_profile_lidar") or "LEGACY")
    if name not in PROFILES:
        raise InputError(f"{path}: packets of profile {name} are not decoded; there is {', '.join(PROFILES)}")
    return Sensor(PROFILES[name], optics, settings["columns_per_packet"])


def optics_of(content: Any, source: str) -> tuple[Optics, dict[str, Any]]:  # noqa: ANN401
    """Return the optics of a sensor's metadata, and all its settings; InputError with `source` for other JSON."""
    try:
        settings: dict[str, Any] = {}
        layouts = content.get("data_format"), content.get("lidar_data_format")
        for part in (content, *(part for part in content.values() if isinstance(part, dict)), *layouts):
            settings |= {key: value for key, value in (part or {}).items() if value not in (None, [])}
        beams = np.radians([settings["beam_altitude_angles"], settings["beam_azimuth_angles"]]).T
        T = np.array(settings["lidar_to_sensor_transform"], np.float64).reshape(4, 4)
        T[:3, 3] *= 1e-3
        mode = str(settings.get("lidar_mode", "1024x10")).removeprefix("MODE_")
        columns = int(settings.get("columns_per_frame") or mode.split("x")[0])
        settings["columns_per_packet"] = int(settings.get("columns_per_packet", 16))
        if columns < 1:
            raise ValueError(f"{columns} columns")
        return Optics(
            beams=beams.reshape(-1, 2),
            columns=columns,
            origin_m=float(settings.get("lidar_origin_to_beam_origin_mm", 0)) * 1e-3,
            T=T,
        ), settings
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{source}: is no metadata of an Ouster sensor ({error}); take the sensor's own .json"
        ) from error


def datagrams(frames: Iterator[bytes]) -> Iterator[tuple[str, bytes]]:
    """Yield (ADDRESS:PORT of the source, payload) of UDP datagrams over IPv4, put together from their fragments."""
    pending: dict[bytes, dict[int, tuple[bytes, bool]]] = {}
    for frame in frames:
        start = _ip_header(frame)
        if start is None:
            continue
        size, (total, number, flags) = (frame[start] & 15) * 4, struct.unpack_from(">HHH", frame, start + 2)
        body, source = frame[start + size : start + total], frame[start + 12 : start + 16]
        offset, more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
        if offset or more:
            key = frame[start + 12 : start + 20] + number.to_bytes(2, "big")
            pending.setdefault(key, {})[offset] = body, more
            if (body := _whole(pending[key])) is None:
                while len(pending) > MOST_PENDING:
                    del pending[next(iter(pending))]
                continue
            del pending[key]
        if len(body) >= 8:
            port, _, length = struct.unpack_from(">HHH", body)
            yield f"{'.'.join(map(str, source))}:{port}", body[8:length]


def _ip_header(frame: bytes) -> int | None:
    """Return the start of the IPv4 header of a UDP packet, whatever the link: Ethernet, a VLAN, Linux cooked, raw."""
    for start in (14, 18, 16, 20, 4, 0):
        head = frame[start : start + 20]
        if len(head) == 20 and head[0] >> 4 == 4 and head[0] & 15 >= 5 and head[9] == 17:  # IPv4 with UDP
            return start
    return None


def _whole(parts: dict[int, tuple[bytes, bool]]) -> bytes | None:
    """Return the fragments of a datagram in order, None if one is missing."""
    data, more = b"", True
    while more:
        if len(data) not in parts:
            return None
        part, more = parts[len(data)]
        data += part
        if not part:
            return None
    return data


def turns(sensor: Sensor, payloads: Iterator[bytes]) -> Iterator[np.ndarray]:
    """Yield the columns of each turn, with at least LEAST_SHARE of them; the fullest if none has so many."""
    rows: list[np.ndarray] = []
    fullest, complete = np.empty(0, sensor.block), False
    last, turn_columns = -1, sensor.optics.columns
    for payload in payloads:
        block = sensor.columns_of(payload)
        columns = block["column"].astype(int)
        wraps = np.flatnonzero(np.diff(columns, prepend=last) < -turn_columns // 2)
        if len(wraps):
            rows.append(block[: wraps[0]])
            turn = np.concatenate(rows)
            fullest = max(fullest, turn, key=len)
            if len(turn) >= LEAST_SHARE * turn_columns:
                complete = True
                yield turn
            rows, block = [], block[wraps[0] :]
        rows.append(block)
        last = int(columns[-1]) if len(columns) else last
    turn = np.concatenate([*rows, np.empty(0, sensor.block)])
    if len(turn) < LEAST_SHARE * turn_columns:
        turn = turn[:0] if complete else max(turn, fullest, key=len)
    if len(turn):
        yield turn


def ouster_turns(path: Path, frames: Iterator[bytes], topic: str) -> tuple[Sensor, Iterator[np.ndarray]]:
    """Return the sensor of a capture, by the metadata .json beside it, and the columns of each of its turns.

    topic  ADDRESS:PORT of the sensor, if there are several.
    Raises InputError if the metadata are none, or the capture holds no packets of their length.
    """
    metadata = metadata_files(path)[0]
    sensor = read_sensor(metadata)

    def payloads() -> Iterator[bytes]:
        sources = dict[str, None]()
        for source, payload in datagrams(frames):
            if len(payload) == sensor.packet_bytes:
                sources[source] = None
                if len(sources) > 1 and not topic:
                    raise InputError(f"{path}: holds packets of {', '.join(sources)}; choose one with --topic")
                if source == (topic or source):
                    yield payload
        if topic and sources and topic not in sources:
            raise InputError(f"{path}: has no topic {topic!r}{closest(topic, sources)}")
        if not sources:
            raise InputError(
                f"{path}: holds no packets of {sensor.packet_bytes} bytes, which {metadata.name} tells of; put the"
                " sensor's own .json beside it"
            )

    return sensor, turns(sensor, payloads())


def metadata_files(path: Path) -> list[Path]:
    """Return the .json files beside a capture with the beginning of its name, that of the same name first."""
    stem = stem_of(path)
    files = sort_names(path.parent.glob(f"{glob.escape(stem)}*.json"))
    return sorted(files, key=lambda file: file.stem != stem)
