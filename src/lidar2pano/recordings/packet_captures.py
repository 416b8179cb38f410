"""Packet captures (.pcap, .pcapng): of Velodyne sensors by velodyne-decoder (extra `recordings`), and of Ousters."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.point_cloud import PointCloud, cloud_of_columns, sweep_error
from lidar2pano.recordings.description import MOST_NAMED, Description, SensorRecording, Topic, damage
from lidar2pano.recordings.ouster_packets import metadata_files, ouster_turns
from lidar2pano.recordings.point_messages import OUSTER, VELODYNE

PCAP = {b"\xa1\xb2\xc3\xd4": (">", 1e-6), b"\xd4\xc3\xb2\xa1": ("<", 1e-6)}  # magic -> byte order, unit of fractions
PCAP |= {b"\xa1\xb2\x3c\x4d": (">", 1e-9), b"\x4d\x3c\xb2\xa1": ("<", 1e-9)}
PCAPNG = b"\x0a\x0d\x0d\x0a"
PAYLOAD = 1206  # bytes of a Velodyne data packet, of every model
MOST_CAPTURED = 1 << 18  # bytes of a packet, libpcap's own limit
REPAIR = "try `editcap` on it, or record it again"
OTHER = "other packets"


class Packet(NamedTuple):
    """A captured packet: when (seconds since the epoch), and its bytes with all headers."""

    stamp_s: float
    frame: bytes

    @property
    def stream(self) -> str:
        """ADDRESS:PORT of the source of a Velodyne data packet; "" for any other packet."""
        if len(self.frame) < PAYLOAD + 28:  # headers of IPv4 and UDP come before, whatever the link
            return ""
        source, _, port, length = struct.unpack_from(">4s6sHH", self.frame, len(self.frame) - PAYLOAD - 16)
        return f"{'.'.join(map(str, source))}:{port}" if length == PAYLOAD + 8 else ""


class PacketCapture(SensorRecording):
    """A capture of the packets of one or several sensors: each Velodyne is a topic ADDRESS:PORT."""

    def __init__(self, path: Path) -> None:
        """Look through the whole capture. Raises InputError if it is damaged, cut short or holds no packet."""
        super().__init__(path)
        counts, first_s, last_s = Counter[tuple[str, str]](), 0.0, 0.0
        for packet in self._packets():
            first_s, last_s = packet.stamp_s if not counts else first_s, packet.stamp_s
            stream = packet.stream
            counts[(stream, VELODYNE) if stream else (f"{len(packet.frame)} bytes", OTHER)] += 1
        if not counts:
            raise InputError(f"{path}: holds no packet; record it again")
        span_ns = (round(first_s * 1e9), round(last_s * 1e9))
        self.description = Description.of_counts(path, "packet capture", counts, *span_ns)

    def choose(self, topic: str) -> Topic:
        """Return the topic of a Velodyne, or of an Ouster, whose .json is beside the capture; InputError without."""
        topics = self.description.topics
        if VELODYNE in {stream.type for stream in topics}:
            return super().choose(topic)
        if metadata_files(self.path):
            return Topic(name=topic, type=OUSTER, count=0)
        sizes = ", ".join(f"{stream.count} of {stream.name}" for stream in topics[:MOST_NAMED])
        raise InputError(
            f"{self.path}: holds packets of another sensor ({sizes}); Velodyne's are decoded, and Ouster's with their"
            " .json beside them; record points instead (a bag, PCD)"
        )

    def scans(self, topic: Topic) -> Iterator[tuple[int, bytes, Callable[[str], PointCloud]]]:
        """See SensorRecording: turn after turn of a Velodyne, at the host's times, or of an Ouster at its own."""
        if topic.type == OUSTER:
            sensor, turns = ouster_turns(self.path, (packet.frame for packet in self._packets()), topic.name)
            for rows in turns:
                content = rows["pixels"]["range"].tobytes()
                yield int(rows["stamp_ns"].min()), content, partial(sensor.cloud, rows)
            return
        for stamp_s, points in self._turns(topic):
            content = b"".join(points[name].tobytes() for name in points.dtype.names or ())  # without padding
            yield round(stamp_s * 1e9), content, partial(_cloud_of_turn, stamp_s, points)

    def _packets(self) -> Iterator[Packet]:
        """Yield the packets in their order; InputError if the capture is damaged or cut short."""
        with damage(self.path, REPAIR):
            yield from _newer(self.file) if _magic(self.file) == PCAPNG else _classic(self.file)

    def _turns(self, topic: Topic) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the stamp (seconds since the epoch) and structured points (N,) of each turn; `time` counts from it."""
        with require_extra("recordings", f"{self.path}:"):
            import velodyne_decoder
        with damage(self.path, "its model may be unknown to velodyne-decoder"):
            decoder = velodyne_decoder.StreamDecoder(self._configuration(velodyne_decoder))
            for packet in self._packets():
                if packet.stream == topic.name:
                    turn = decoder.decode(packet.stamp_s, packet.frame[-PAYLOAD:], True)
                    if turn is not None:
                        yield turn[0].host, turn[1]
            turn = decoder.finish(True)
            if turn is not None:
                yield turn[0].host, turn[1]

    def _configuration(self, velodyne_decoder: Any) -> Any:  # noqa: ANN401
        """Return the configuration, with the model and calibration if an HDL-64E sends them."""
        configuration = velodyne_decoder.Config()
        if _magic(self.file) != PCAPNG:
            with io.BufferedReader(open_regular(self.file)) as file:
                model, calibration = velodyne_decoder.hdl64e.detect_hdl64e(file)
            if model is not None:
                configuration.model, configuration.calibration = model, calibration
        return configuration


def _cloud_of_turn(stamp_s: float, points: np.ndarray, name: str) -> PointCloud:
    """Return the points of a turn (N,) with fields x y z intensity time ring."""
    if not len(points):
        raise sweep_error(name, 0)
    columns = {field: points[field] for field in points.dtype.names or ()}
    return cloud_of_columns(columns, format=VELODYNE, name=name, frame="velodyne", stamp_s=stamp_s)


def _magic(path: Path) -> bytes:
    with open_regular(path) as file:
        return file.read(4)


def _classic(path: Path) -> Iterator[Packet]:
    with io.BufferedReader(open_regular(path)) as file:
        head = file.read(24)
        order, unit_s = PCAP[head[:4]]
        if len(head) < 24:
            raise ValueError(f"{len(head)} bytes")
        record = struct.Struct(order + "IIII")
        while head := file.read(record.size):
            whole, fraction, captured, _ = record.unpack(head)
            if captured > MOST_CAPTURED:
                raise ValueError(f"a packet of {captured} bytes")
            frame = file.read(captured)
            if len(frame) < captured:
                raise ValueError(f"the last packet has {len(frame)} of {captured} bytes")
            yield Packet(whole + fraction * unit_s, frame)


def _newer(path: Path) -> Iterator[Packet]:
    """Packets of a pcapng; dpkt comes with velodyne-decoder."""
    with require_extra("recordings", f"{path}:"):
        import dpkt.pcapng
    with io.BufferedReader(open_regular(path)) as file:
        for stamp_s, frame in dpkt.pcapng.Reader(file):
            yield Packet(stamp_s, bytes(frame))
