"""Messages of a recording: the interface of every storage, and the decoding of the standard types."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from lidar2pano.recordings.description import Description, Topic

MOST_CHUNK_BYTES = 1 << 28  # unpacked; recorders write chunks of about a megabyte, or of one message
TF = "tf2_msgs/msg/TFMessage"
ROS1, CDR = "ros1", "cdr"  # encodings of messages, by MCAP's names


class RawMessage(NamedTuple):
    """A message as it is recorded: its topic, the time of recording (nanoseconds since the epoch), and its bytes."""

    topic: Topic
    stamp_ns: int
    data: bytes


class Recording(Protocol):
    """An open recording of ROS messages.

    indexed  whether messages before a time are skipped without being read.
    """

    path: Path
    description: Description
    indexed: bool

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Return messages recorded from `start_ns` on and before `end_ns`, in order of time; InputError at damage."""
        ...

    def stamps_ns(self, topic: Topic) -> np.ndarray:
        """Return the times of recording of a topic's messages, int64 in order; by an index alone if there is one."""
        ...

    def decode(self, message: RawMessage) -> Any:  # noqa: ANN401
        """Return the message as an object with ROS's attributes; raises the library's errors."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


@cache
def deserializer(encoding: str) -> Callable[[bytes, str], Any]:
    """Return (bytes, type) -> message, for the standard types: neither ROS 1 nor ROS 2 changed them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding == ROS1:
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))  # missing there
        return store.deserialize_ros1
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
