"""ROS 1 bags, and ROS 2 bags in SQLite (.db3) or as a folder with metadata.yaml: by rosbags (extra `recordings`)."""

from __future__ import annotations

import bz2
import contextlib
import io
import os
import struct
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np

from lidar2pano.bounded_files import open_regular, read_text
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
from lidar2pano.recordings.mcap_files import McapFile

METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20  # 2,000 topics or files
STEPS, STEPS_AT_ONCE = 10_000_000, 100_000  # of SQLite's virtual machine: of a statement, and between two looks at them
ROSBAG, SQLITE = b"#ROSBAG V2.0", b"SQLite format 3\0"
_sqlite = threading.Lock()  # rosbags and apsw keep settings of the next opening for the whole process


class RegularPath:
    """A path of rosbags' protocol RPath: it opens regular files alone, so that nothing in their place can block it."""

    def __init__(self, path: Path) -> None:
        self.path, self.stem, self.suffix = path, path.stem, path.suffix
        self.exists, self.is_dir, self.stat = path.exists, path.is_dir, path.stat

    def open(self, _mode: str = "rb") -> BinaryIO:
        """Open it to read bytes; OSError for a folder, device, FIFO or socket."""
        return io.BufferedReader(open_regular(self.path))

    def read_text(self, encoding: str | None = None) -> str:  # noqa: ARG002  it is UTF-8
        """Read the text of metadata; OSError as `open`, and for more than MOST_METADATA_BYTES."""
        return read_text(self.path, MOST_METADATA_BYTES)

    def __truediv__(self, key: str | os.PathLike[str]) -> RegularPath:
        """Return the path of a file in it."""
        return RegularPath(self.path / key)

    def __fspath__(self) -> str:
        """Return the path itself."""
        return str(self.path)

    def __str__(self) -> str:
        """Return the path as SQLite's addresses need it: without links, at which its opening by a gate ends."""
        return quote(os.fsencode(self.path.resolve()))


class RosBag(Recording):
    """A recording read by rosbags.

    open    gives rosbags' open reader;  encoding: of its messages.
    repair  advice for a damaged file.
    """

    indexed = True

    def __init__(self, path: Path, format: str, open: Callable[[Path], Any], encoding: str, repair: str) -> None:
        super().__init__(path)
        self._repair = repair
        with require_extra("recordings", f"{path}:"):
            self._decode = deserializer(encoding)
        with damage(path, repair):
            self._reader = open(path)
            self.files.callback(self._reader.close)
            self._connections = list(self._reader.connections)
            counts = Counter[tuple[str, str]]()
            for connection in self._connections:
                counts[connection.topic, connection.msgtype] += connection.msgcount
            span = getattr(self._reader, "metadata", self._reader)
            span_ns = (span.start_time, span.end_time - 1) if counts.total() else (0, 0)
            self.description = Description.of_counts(path, format, counts, *span_ns)

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield messages recorded from `start_ns` on and before `end_ns`, in order of time; InputError at damage."""
        topic_of = {connection.id: topic for topic in topics for connection in self._connections_of(topic)}
        connections = [connection for connection in self._connections if connection.id in topic_of]
        if not connections:  # rosbags takes none for all
            return
        with damage(self.path, self._repair):
            for connection, stamp_ns, data in self._reader.messages(connections, start_ns, end_ns):
                yield RawMessage(topic_of[connection.id], stamp_ns, data)

    def stamps_ns(self, topic: Topic) -> np.ndarray:
        """Return the times of recording of a topic's messages, int64 in order; InputError at damage."""
        indexes = getattr(self._reader, "indexes", None)
        with damage(self.path, self._repair):
            if indexes is None:
                storage = getattr(self._reader, "storage", self._reader)
                parts = [_stored_ns(file, topic) for file in getattr(storage, "storages", [storage])]
                return np.array([stamp_ns for part in parts for stamp_ns in part], dtype=np.int64)
            entries = (entry for connection in self._connections_of(topic) for entry in indexes[connection.id])
            return np.array(sorted(entry.time for entry in entries), dtype=np.int64)

    def _connections_of(self, topic: Topic) -> list[Any]:
        name = topic.name, topic.type
        return [connection for connection in self._connections if (connection.topic, connection.msgtype) == name]

    def decode(self, message: RawMessage) -> Any:  # noqa: ANN401
        """Return the message as an object with ROS's attributes; raises rosbags' errors."""
        return self._decode(message.data, message.topic.type)


def _stored_ns(storage: Any, topic: Topic) -> Iterable[int]:  # noqa: ANN401
    """Return the times of one file of a ROS 2 bag, without its messages."""
    if hasattr(storage, "dbconn"):
        query = "SELECT timestamp FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ? AND type = ?)"
        return (row[0] for row in storage.dbconn.execute(f"{query} ORDER BY timestamp", (topic.name, topic.type)))
    with closing(McapFile(Path(storage.path))) as file:
        return file.stamps_ns(topic).tolist()


def open_ros1(path: Path) -> RosBag:
    """Return a ROS 1 bag; InputError if it is damaged, not indexed or not decodable, or the extra is missing."""
    return RosBag(path, "ROS 1 bag", _open_ros1, ROS1, "try `rosbag reindex`, or record it again")


def open_sqlite(path: Path) -> RosBag:
    """Return a ROS 2 bag's .db3 file, without metadata.yaml; InputError as `open_ros1`."""
    repair = "try `sqlite3 FILE .recover`, or record it again"
    with damage(path, repair):  # somebody may remove it
        _check_sqlite(path)
    return RosBag(path, "ROS 2 bag, SQLite", _open_sqlite, CDR, repair)


def open_folder(path: Path) -> RosBag:
    """Return the folder of a ROS 2 bag with its metadata.yaml; InputError as `open_ros1`."""
    return RosBag(path, "ROS 2 bag, folder", _open_folder, CDR, "try `ros2 bag reindex`, or record it again")


def _open_ros1(path: Path) -> Any:  # noqa: ANN401
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import decompressors

    bounded = {decompressors["bz2"]: _unpack_bz2, decompressors["lz4"]: _unpack_lz4}
    reader = Reader(RegularPath(path))
    reader.open()
    for position, chunk in reader.chunks.items():
        if chunk.datasize > MOST_CHUNK_BYTES:
            reader.close()
            raise InputError(f"{path}: has a chunk of {chunk.datasize} bytes (at most {MOST_CHUNK_BYTES}); split it")
        reader.chunks[position] = chunk._replace(decompressor=bounded.get(chunk.decompressor, chunk.decompressor))
    return reader


def _unpack_bz2(data: bytes) -> bytes:
    return _whole(bz2.BZ2Decompressor(), data)


def _unpack_lz4(data: bytes) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return _whole(LZ4FrameDecompressor(), data)


def _whole(decompressor: Any, data: bytes) -> bytes:  # noqa: ANN401
    unpacked = decompressor.decompress(data, MOST_CHUNK_BYTES)
    if not decompressor.eof:
        raise ValueError(f"a chunk of {len(data)} bytes is cut short or unpacks to more than {MOST_CHUNK_BYTES}")
    return unpacked


def _open_sqlite(path: Path) -> Any:  # noqa: ANN401
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    reader = Sqlite3Reader(RegularPath(path))
    with _bounded_sqlite(path.stat().st_size):
        reader.open()
    return reader


@contextlib.contextmanager
def _bounded_sqlite(size: int) -> Iterator[None]:
    """Inside, databases that are opened have tables but no views, and statements end after steps in proportion to them.

    size  bytes of the database. A statement takes some 10 steps for a row, and a row some 30 bytes.
    """
    import apsw

    most = (STEPS + 8 * size) // STEPS_AT_ONCE  # a folder's databases may be packed
    actions = {apsw.SQLITE_SELECT, apsw.SQLITE_READ, apsw.SQLITE_FUNCTION, apsw.SQLITE_PRAGMA}

    def bound(connection: Any) -> None:  # noqa: ANN401
        steps = Counter[str]()

        def begin(*_: object) -> bool:
            steps.clear()
            return True

        def stop() -> bool:
            steps["all"] += 1
            return steps["all"] > most

        for option in (apsw.SQLITE_DBCONFIG_ENABLE_VIEW, apsw.SQLITE_DBCONFIG_ENABLE_TRIGGER):
            connection.config(option, 0)
        connection.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MOST_CHUNK_BYTES)
        connection.exec_trace = begin
        connection.set_progress_handler(stop, STEPS_AT_ONCE)
        connection.set_authorizer(lambda action, *_: apsw.SQLITE_OK if action in actions else apsw.SQLITE_DENY)

    with _sqlite:
        apsw.connection_hooks.append(bound)
        try:
            yield
        finally:
            apsw.connection_hooks.remove(bound)


def _check_sqlite(path: Path) -> None:
    """Raise InputError if the file is shorter than its header says, or is still being written."""
    if any(path.with_name(path.name + ending).exists() for ending in ("-wal", "-journal")):
        raise InputError(f"{path}: is still being written (its -wal or -journal exists); stop the recorder first")
    with open_regular(path) as file:
        head = file.read(100)
    if len(head) < 100:
        raise InputError(f"{path}: is damaged or cut short ({len(head)} bytes); record it again")
    (page_bytes,) = struct.unpack(">H", head[16:18])
    changed, pages, valid_for = struct.unpack(">I", head[24:28]) + struct.unpack(">I60xI", head[28:96])
    size = path.stat().st_size
    if changed == valid_for and pages * (65536 if page_bytes == 1 else page_bytes) > size:  # SQLite's file format 1.3
        raise InputError(f"{path}: is cut short ({size} bytes of {pages} pages); record it again")


def _open_folder(path: Path) -> Any:  # noqa: ANN401
    from rosbags.rosbag2 import Reader

    if (path / METADATA).stat().st_size > MOST_METADATA_BYTES:
        raise InputError(f"{path / METADATA}: has more than {MOST_METADATA_BYTES} bytes; try `ros2 bag reindex`")
    reader = Reader(RegularPath(path))
    size = sum(file.stat().st_size for file in path.iterdir())
    with _bounded_sqlite(size), contextlib.ExitStack() as stack:
        stack.enter_context(reader)
        stack.pop_all()
    return reader
