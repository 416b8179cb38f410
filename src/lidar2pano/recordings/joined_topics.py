"""Several LiDARs of one vehicle as one: clouds in the topmost one's frame, joined by tf_static."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.recordings.description import RawMessage, Recording, Topic, damage
from lidar2pano.recordings.point_messages import CLOUDS, JOINED, SENSORS
from lidar2pano.recordings.transforms import fixed_poses

ALL = "all"  # --topic
REACH_NS = 150_000_000  # clouds of other sensors are at most so much earlier or later: sensors turn ten times a second


def join_topics(recording: Recording, topic: str) -> Recording:
    """Return the recording, for --topic all with a topic of all its LiDARs; InputError if tf_static does not link them.

    The recording is closed where this fails.
    """
    topics = recording.description.topics
    clouds = [held for held in topics if held.type in CLOUDS and held.type not in SENSORS and held.count]
    if topic != ALL or not clouds or any(held.name.strip("/") == ALL for held in topics):
        return recording
    try:
        return JoinedRecording(recording, clouds)
    except BaseException:
        recording.close()
        raise


class JoinedRecording(Recording):
    """A recording with one more topic, of clouds joined at the times of the topmost LiDAR's."""

    def __init__(self, recording: Recording, clouds: list[Topic]) -> None:
        """Find out how the sensors are mounted; InputError if tf_static does not tell."""
        super().__init__(recording.path)
        self.files, self.indexed, self._recording, self._clouds = recording.files, recording.indexed, recording, clouds
        with damage(self.path, "choose one LiDAR with --topic"):  # a topic may lack its messages
            frame_by_name = {topic.name: self._cloud(next(recording.messages((topic,)))).frame for topic in clouds}
        poses = fixed_poses(recording, set(frame_by_name.values()))
        if poses is None:
            frames = ", ".join(sorted(set(frame_by_name.values())))
            raise InputError(f"{self.path}: its tf_static does not link {frames}; choose one LiDAR with --topic")
        self._reference = max(clouds, key=lambda topic: (round(poses[frame_by_name[topic.name]][2, 3], 2), topic.count))
        T_reference_root = np.linalg.inv(poses[frame_by_name[self._reference.name]])
        self._mounts = {name: T_reference_root @ poses[frame] for name, frame in frame_by_name.items()}
        self._topic = Topic(name=ALL, type=JOINED, count=self._reference.count)
        self.description = replace(recording.description, topics=(*recording.description.topics, self._topic))

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Return messages as of Recording; a joined one has those of each sensor as its content."""
        if self._topic not in topics:
            yield from self._recording.messages(topics, start_ns, end_ns)
            return
        start = None if start_ns is None else start_ns - REACH_NS
        end = None if end_ns is None else end_ns + REACH_NS
        waiting, near = deque[RawMessage](), deque[RawMessage]()
        for message in self._recording.messages(tuple(self._clouds), start, end):
            while waiting and message.stamp_ns > waiting[0].stamp_ns + REACH_NS:
                yield self._joined(waiting.popleft(), near)
            oldest_ns = (waiting[0] if waiting else message).stamp_ns - REACH_NS
            while near and near[0].stamp_ns < oldest_ns:
                near.popleft()
            near.append(message)
            late = start_ns is None or message.stamp_ns >= start_ns
            if message.topic == self._reference and late and (end_ns is None or message.stamp_ns < end_ns):
                waiting.append(message)
        for message in waiting:
            yield self._joined(message, near)

    def stamps_ns(self, topic: Topic) -> np.ndarray:
        """Return the times of a topic's messages, as of Recording."""
        return self._recording.stamps_ns(self._reference if topic == self._topic else topic)

    def decode(self, message: RawMessage) -> Any:  # noqa: ANN401
        """Return a message's object, of a joined one its PointCloud."""
        if message.topic != self._topic:
            return self._recording.decode(message)
        return _merged([self._moved(part) for part in message.content])

    def _joined(self, reference: RawMessage, near: deque[RawMessage]) -> RawMessage:
        """Return a message with the nearest in time of each other topic."""
        parts = [reference]
        for topic in self._clouds:
            others = [message for message in near if message.topic == topic != self._reference]
            reached = [message for message in others if abs(message.stamp_ns - reference.stamp_ns) <= REACH_NS]
            if reached:
                parts.append(min(reached, key=lambda message: abs(message.stamp_ns - reference.stamp_ns)))
        data = b"".join(bytes(part.data) for part in parts)
        return RawMessage(self._topic, reference.stamp_ns, data, tuple(parts))

    def _cloud(self, message: RawMessage) -> PointCloud:
        title = f"{self.path}, {message.topic.name}"
        cloud = self._recording.cloud(message, title)
        return replace(cloud, stamp_s=cloud.stamp_s or message.stamp_ns * 1e-9)

    def _moved(self, message: RawMessage) -> PointCloud:
        """Return the points of a sensor in the frame of the topmost."""
        cloud, T = self._cloud(message), self._mounts[message.topic.name]
        returns = np.isfinite(cloud.xyz).all(1) & (cloud.xyz != 0).any(1)  # no return stays at the origin
        xyz = np.where(returns[:, None], cloud.xyz @ T[:3, :3].T + T[:3, 3], np.nan)
        return replace(cloud, xyz=xyz.astype(cloud.xyz.dtype))


def _merged(clouds: list[PointCloud]) -> PointCloud:
    """Return one cloud of several; times count from the stamp of the first, rings go on from sensor to sensor."""
    stamp_s, first, further = clouds[0].stamp_s or 0.0, 0, list[PointCloud]()
    for cloud in clouds:
        time_s = (0.0 if cloud.time_s is None else cloud.time_s) + ((cloud.stamp_s or 0.0) - stamp_s)
        ring = None if cloud.ring is None else cloud.ring + first
        further.append(replace(cloud, time_s=np.broadcast_to(time_s, len(cloud)), ring=ring))
        first += 0 if cloud.ring is None else int(cloud.ring.max(initial=0)) + 1
    fields = {}
    for name in ("xyz", "intensity", "ring", "time_s", "near_infrared"):
        values = [getattr(cloud, name) for cloud in further]
        fields[name] = None if any(part is None for part in values) else np.concatenate(values)
    return replace(clouds[0], **fields, format=f"{clouds[0].format}, {len(clouds)} sensors")
