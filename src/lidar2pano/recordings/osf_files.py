"""OSF, the recordings of Ouster's own tools, by their published format: FlatBuffers of PNG or ZPNG images.

Tables, their slots and the coding of fields are those of `ouster_osf/fb` and `ouster_osf/src` in Ouster's SDK.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.image_files import MOST_PIXELS, decode_image
from lidar2pano.formats.json_files import parse_json
from lidar2pano.formats.point_cloud import PointCloud, sweep_error
from lidar2pano.recordings.description import Description, SensorRecording, Topic, damage
from lidar2pano.recordings.ouster_packets import Optics, optics_of
from lidar2pano.recordings.point_messages import OUSTER

OSF = (b"OSF!", b"OSF$")  # at byte 4 of a FlatBuffers file, 8 if its size comes before; $: of its header
CLOSED = 2  # status of a header whose file was written to its end
MOST_CHUNK_BYTES = 1 << 28  # a chunk has two megabytes or one scan
REPAIR = "write it again with `ouster-cli source FILE save COPY.osf`"
SCANS, SENSORS = "ouster/v1/os_sensor/LidarScanStream", "ouster/v1/os_sensor/LidarSensor"
ZPNG = b"\xf8\xfb"
# Number of a field -> (return, name): LidarScan's CHAN_FIELD
FIELDS = {
    1: (0, "range"),
    2: (1, "range"),
    3: (0, "signal"),
    4: (1, "signal"),
    5: (0, "reflectivity"),
    6: (1, "reflectivity"),
    7: (0, "near_ir"),
}


class Table(NamedTuple):
    """A table of a FlatBuffer: its bytes, and where it begins. Slots are numbered in order of its schema."""

    data: bytes
    place: int

    @classmethod
    def root(cls, data: bytes) -> Table:
        """Return the first table of a buffer that begins with its size."""
        return cls(data, 4 + struct.unpack_from("<I", data, 4)[0])

    def _slot(self, slot: int) -> int:
        """Return the place of a field; 0 where it has none."""
        table = self.place - struct.unpack_from("<i", self.data, self.place)[0]
        if table < 0 or 4 + 2 * slot >= struct.unpack_from("<H", self.data, table)[0]:
            return 0
        offset = struct.unpack_from("<H", self.data, table + 4 + 2 * slot)[0]
        return self.place + offset if offset else 0

    def number(self, slot: int, form: str) -> int:
        """Return a number, 0 where it has none."""
        place = self._slot(slot)
        return struct.unpack_from(form, self.data, place)[0] if place else 0

    def items(self, slot: int, dtype: Any) -> np.ndarray:  # noqa: ANN401
        """Return a vector of numbers or structs, empty where it has none; ValueError beyond the buffer."""
        if not (place := self._slot(slot)):
            return np.empty(0, dtype)
        place += struct.unpack_from("<I", self.data, place)[0]
        return np.frombuffer(self.data, dtype, struct.unpack_from("<I", self.data, place)[0], place + 4)

    def bytes(self, slot: int) -> bytes:
        """Return a vector of bytes, or the text of a string."""
        return self.items(slot, np.uint8).tobytes()

    def tables(self, slot: int) -> Iterator[Table]:
        """Yield the tables of a vector."""
        offsets = self.items(slot, "<u4")
        if len(offsets):
            start = self._slot(slot)
            start += struct.unpack_from("<I", self.data, start)[0] + 4
            for number, offset in enumerate(offsets.tolist()):
                yield Table(self.data, start + 4 * number + offset)


class Stream(NamedTuple):
    """The scans of a sensor: its topic, optics and the shifts of its rows in a PNG, columns."""

    topic: Topic
    optics: Optics
    shifts: list[int]


class OsfFile(SensorRecording):
    """An OSF: each sensor is a topic, called by its serial number."""

    def __init__(self, path: Path) -> None:
        """Read what it says of sensors and times. Raises InputError if it is damaged or was never closed."""
        super().__init__(path)
        with damage(path, REPAIR), open_regular(path) as file:
            head = _sized(file, 0)
            header = Table.root(head)
            if header.number(1, "B") != CLOSED:
                raise InputError(f"{path}: was not closed by its recorder; {REPAIR}")
            metadata = Table.root(_sized(file, header.number(2, "<Q")))
            chunks = metadata.items(3, np.dtype("<u8, <u8, <u8"))  # first and last time, place
            self._places = np.unique(chunks["f2"]).astype(np.int64) + len(head) + 4  # a checksum follows the header
            entries = {entry.number(0, "<I"): (entry.bytes(1).decode(), entry.bytes(2)) for entry in metadata.tables(4)}
            span_ns = metadata.number(1, "<Q"), metadata.number(2, "<Q")
            ids = [key for key, (type, _) in entries.items() if type == SCANS]
            counts = dict.fromkeys(ids, 0)
            for message in self._messages(file):
                if message.number(1, "<I") in counts:
                    counts[message.number(1, "<I")] += 1
            self._streams = {key: _stream(path, entries, key, counts[key]) for key in ids}
        topics = tuple(stream.topic for stream in self._streams.values())
        self.description = Description(format="OSF", topics=topics, first_ns=span_ns[0], last_ns=span_ns[1])

    def _messages(self, file: io.FileIO) -> Iterator[Table]:
        for place in self._places.tolist():
            yield from Table.root(_sized(file, place)).tables(0)

    def scans(self, topic: Topic) -> Iterator[tuple[int, bytes, Callable[[str], PointCloud]]]:
        """See SensorRecording: a sensor's scans, in the file's order."""
        key, stream = next((key, stream) for key, stream in self._streams.items() if stream.topic is topic)
        with damage(self.path, REPAIR), open_regular(self.file) as file:
            for message in self._messages(file):
                if message.number(1, "<I") == key:
                    data = message.bytes(2)
                    yield message.number(0, "<Q"), data, partial(_cloud, stream, data)


def is_osf(head: bytes) -> bool:
    """Return whether a file is an OSF, by its first bytes."""
    return head[4:8] in OSF or head[8:12] in OSF


def _sized(file: io.FileIO, place: int) -> bytes:
    """Return a buffer that begins with its size."""
    file.seek(place)
    size = int.from_bytes(file.read(4), "little")
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a part of {size} bytes")
    data = file.read(size)
    if len(data) < size:
        raise ValueError(f"a part has {len(data)} of {size} bytes")
    return size.to_bytes(4, "little") + data


def _stream(path: Path, entries: dict[int, tuple[str, bytes]], key: int, count: int) -> Stream:
    """Return the stream of scans of an entry of the metadata."""
    type, content = entries.get(Table.root(entries[key][1]).number(0, "<I"), ("", b""))
    if type != SENSORS:
        raise ValueError("scans without a sensor")
    about = parse_json(Table.root(content).bytes(0), str(path), REPAIR)
    optics, settings = optics_of(about, str(path))
    name = str(settings.get("prod_sn") or settings.get("serial_no") or f"sensor{key}")
    layout = about.get("lidar_data_format") or about.get("data_format") or {}
    shifts = [int(shift) for shift in layout.get("pixel_shift_by_row") or [0] * len(optics.beams)]
    if len(shifts) != len(optics.beams) or optics.columns * len(shifts) > MOST_PIXELS:
        raise ValueError(f"a sensor of {len(shifts)} x {optics.columns} pixels")
    return Stream(Topic(name=name, type=OUSTER, count=count), optics, shifts)


def _cloud(stream: Stream, data: bytes, title: str) -> PointCloud:
    """Return the points of a LidarScanMsg."""
    with damage(Path(title), REPAIR):
        message, optics = Table.root(data), stream.optics
        returns: list[dict[str, np.ndarray]] = [{}, {}]
        numbers = message.items(1, np.dtype("u1, u1"))["f0"].tolist()
        for number, channel in zip(numbers, message.tables(0), strict=False):
            if number in FIELDS:
                layer, name = FIELDS[number]
                returns[layer][name] = _field(channel.bytes(0), stream, title)
        stamps_ns = message.items(2, "<u8").astype(np.int64)
        valid = (message.items(4, "<u4") & 1 == 1) & (stamps_ns > 0)
        if "range" not in returns[0] or len(stamps_ns) != optics.columns:
            raise ValueError("no ranges of its columns")
        if not valid.any():
            raise sweep_error(title, 0)
        columns = np.flatnonzero(valid)
        kept = [{name: values[:, columns] for name, values in layer.items()} for layer in returns if "range" in layer]
        for layer in kept:
            layer["range"] = layer["range"] * 1e-3
        return optics.cloud(columns, stamps_ns[columns], kept, title)


def _field(data: bytes, stream: Stream, title: str) -> np.ndarray:
    """Return the values (H, W) of a field, row after row as they were measured."""
    shape = len(stream.optics.beams), stream.optics.columns
    if data.startswith(ZPNG):
        return _unfiltered(data, shape, title)
    pixels = decode_image(io.BytesIO(data), title, None)
    if pixels.shape[:2] != shape:
        raise ValueError(f"a field of {pixels.shape[:2]} pixels for {shape}")
    if pixels.ndim == 3:  # bytes of a number, the lowest first
        pixels = sum(pixels[..., place].astype(np.uint32) << 8 * place for place in range(pixels.shape[2]))
    rows, columns = np.indices(shape, sparse=True)
    return np.asarray(pixels)[rows, (columns + np.array(stream.shifts)[:, None]) % shape[1]]


def _unfiltered(data: bytes, shape: tuple[int, int], title: str) -> np.ndarray:
    """Return the values of a ZPNG: differences along rows, byte by byte, packed by zstd."""
    with require_extra("formats", f"{title}:"):
        from zstandard import ZstdDecompressor
    width, height, channels, depth = struct.unpack_from("<HHBB", data, 2)
    size = channels * depth
    if (height, width) != shape or size not in (1, 2, 4, 8):
        raise ValueError(f"a field of {(height, width)} pixels of {size} bytes for {shape}")
    with ZstdDecompressor().stream_reader(data[8:]) as stream:
        plain = np.frombuffer(stream.read(height * width * size), np.uint8)
    if size == 4:  # planes of b, g - b, g - r and a
        b, u, v, a = plain.reshape(4, height, width)
        steps = np.stack([u + b - v, u + b, b, a], axis=-1)
    else:
        steps = plain.reshape(height, width, size)
    return np.cumsum(steps, axis=1, dtype=np.uint8).view(f"<u{size}")[..., 0]
