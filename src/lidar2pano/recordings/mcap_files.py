"""MCAP files of both ROS profiles, with or without an index: read with mcap (extra `recordings`)."""

from __future__ import annotations

import io
import os
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError, require_extra
from lidar2pano.recordings.description import (
    CDR,
    MOST_CHUNK_BYTES,
    ROS1,
    Description,
    RawMessage,
    Recording,
    Topic,
    damage,
    deserializer,
)
from lidar2pano.recordings.point_messages import decode_json, decode_protobuf

MAGIC = b"\x89MCAP0\r\n"
REPAIR = "try `mcap recover`, or record it again"
ENCODINGS = (ROS1, CDR)


class McapFile(Recording):
    """An MCAP file. One without an index is read from beginning to end, once more to count its messages."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises InputError if it is damaged or cut short, or the extra is missing."""
        super().__init__(path)
        with require_extra("recordings", f"{path}:"):
            import mcap  # noqa: F401

            deserializer(CDR)
        with ExitStack() as stack:
            try:
                self._file = stack.enter_context(io.BufferedReader(open_regular(path)))
            except OSError as error:
                raise InputError(f"{path}: cannot be read ({error.strerror}); name a file that exists") from error
            self._size = os.fstat(self._file.fileno()).st_size
            self._channels, self._schemas = dict[int, Any](), dict[int, Any]()
            with damage(path, REPAIR):
                self._chunks = self._index()
                counts, first_ns, last_ns = self._counted()
                self._names = {number: self._name(channel) for number, channel in self._channels.items()}
            self.files = stack.pop_all()
        self.indexed = bool(self._chunks)
        totals = Counter[tuple[str, str]]()
        for number, name in self._names.items():
            totals[name] += counts.get(number, 0)
        span_ns = (first_ns, last_ns) if totals.total() else (0, 0)
        name = "MCAP" if self._chunks else "MCAP without an index"
        self.description = Description.of_counts(path, name, totals, *span_ns)

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield messages recorded from `start_ns` on and before `end_ns`, in order of time; InputError at damage.

        Without an index they come in the order of the file.
        """
        topic_of = {
            number: topic
            for number, name in self._names.items()
            for topic in topics
            if name == (topic.name, topic.type)
        }
        with damage(self.path, REPAIR):
            for message in self._stored(topic_of.keys(), start_ns, end_ns):
                early = start_ns is not None and message.log_time < start_ns
                if message.channel_id in topic_of and not early and (end_ns is None or message.log_time < end_ns):
                    yield RawMessage(topic_of[message.channel_id], message.log_time, message.data)

    def stamps_ns(self, topic: Topic) -> np.ndarray:
        """Return the times of recording of a topic's messages, int64 in order; by an index alone if there is one."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import MessageIndex

        stamps_ns: list[int] = []
        with damage(self.path, REPAIR):
            if not all(chunk.message_index_offsets for chunk in self._chunks) or not self._chunks:
                return super().stamps_ns(topic)
            for chunk in self._chunks:
                for number, offset in chunk.message_index_offsets.items():
                    if self._names[number] == (topic.name, topic.type):
                        self._file.seek(offset + 9)  # opcode and length come before
                        index = MessageIndex.read(ReadDataStream(self._file))
                        stamps_ns += [stamp_ns for stamp_ns, _ in index.records]
            return np.array(sorted(stamps_ns), dtype=np.int64)

    def decode(self, message: RawMessage) -> Any:  # noqa: ANN401
        """Return the message as an object with ROS's attributes; raises rosbags' errors."""
        name = message.topic.name, message.topic.type
        channel = next(self._channels[number] for number in self._names if self._names[number] == name)
        if channel.message_encoding == "json":
            return decode_json(message.data)
        if channel.message_encoding == "protobuf":
            schema = self._schemas[channel.schema_id]
            return decode_protobuf(message.data, schema.name, schema.data)
        return deserializer(channel.message_encoding)(message.data, message.topic.type)

    def _index(self) -> list[Any]:
        """Return the chunks by the file's own index, in order of time; [] if it has none."""
        from mcap.reader import SeekingReader

        summary = SeekingReader(self._file, record_size_limit=self._size).get_summary()
        if summary is None or not (summary.chunk_indexes and summary.channels and summary.statistics):
            return []
        for chunk in summary.chunk_indexes:
            if chunk.chunk_start_offset + chunk.chunk_length > self._size or chunk.compressed_size > chunk.chunk_length:
                raise InputError(f"{self.path}: its index points beyond its end; {REPAIR}")
        self._channels, self._schemas, self._statistics = summary.channels, summary.schemas, summary.statistics
        return sorted(summary.chunk_indexes, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))

    def _counted(self) -> tuple[dict[int, int], int, int]:
        """Return messages by channel, and the first and last time."""
        if self._chunks:
            statistics = self._statistics
            return statistics.channel_message_counts, statistics.message_start_time, statistics.message_end_time
        counts, first, last = Counter[int](), 1 << 64, 0
        for message in self._linear():
            counts[message.channel_id] += 1
            first, last = min(first, message.log_time), max(last, message.log_time)
        return counts, first, last

    def _name(self, channel: Any) -> tuple[str, str]:  # noqa: ANN401
        """Return (topic, type): a type of ROS in ROS 2's form, another with its encoding."""
        name = self._schemas[channel.schema_id].name if channel.schema_id else "no schema"
        if channel.message_encoding not in ENCODINGS:
            return channel.topic, f"{name} ({channel.message_encoding})"
        package, _, rest = name.rpartition("/")
        return channel.topic, f"{package.removesuffix('/msg')}/msg/{rest}"

    def _stored(self, channels: Any, start_ns: int | None, end_ns: int | None) -> Iterator[Any]:  # noqa: ANN401
        """Message records; by the index, chunks without these channels or times are not read.

        The messages of chunks overlapping in time are merged.
        """
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk, Message

        if not self._chunks:
            yield from self._linear()
        waiting: list[Any] = []
        for index in self._chunks:
            late = start_ns is not None and index.message_end_time < start_ns
            early = end_ns is not None and index.message_start_time >= end_ns
            foreign = bool(index.message_index_offsets) and not channels & index.message_index_offsets.keys()
            if not (late or early or foreign):
                ready = bisect_left(waiting, index.message_start_time, key=_stamp_ns)
                yield from waiting[:ready]
                del waiting[:ready]
                self._file.seek(index.chunk_start_offset + 9)
                parts = unpacked(Chunk.read(ReadDataStream(self._file)))
                waiting += [part for part in parts if isinstance(part, Message) and part.channel_id in channels]
                waiting.sort(key=_stamp_ns)
        yield from waiting

    def _linear(self) -> Iterator[Any]:
        """Yield all message records in the order of the file; its channels and schemas are noted on the way."""
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader

        self._file.seek(0)
        stored = StreamReader(self._file, emit_chunks=True, record_size_limit=self._size).records
        for record in chain.from_iterable(unpacked(part) if isinstance(part, Chunk) else (part,) for part in stored):
            if isinstance(record, Message):
                yield record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Schema):
                self._schemas[record.id] = record


def _stamp_ns(message: Any) -> int:  # noqa: ANN401
    return message.log_time


def unpacked(chunk: Any) -> list[Any]:  # noqa: ANN401
    """Return the records of a chunk; ValueError if it unpacks to another size than it says, or a damaged one."""
    from lz4.frame import LZ4FrameDecompressor
    from mcap.stream_reader import breakup_chunk
    from zstandard import ZstdDecompressor

    size, data = chunk.uncompressed_size, chunk.data
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, unpacked")
    if chunk.compression == "zstd":
        with ZstdDecompressor().stream_reader(data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(data, size + 1)
    elif chunk.compression:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(data) != size:
        raise ValueError(f"a chunk unpacks to {len(data)} bytes instead of {size}")
    return breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)
