"""Poses of a recording: the path of a sensor's frame through the world, from tf or nav_msgs/Odometry."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.geometry.motion import SensorMotion, Trajectory
from lidar2pano.recordings.description import TF, RawMessage, Recording, Topic, damage

TF_TYPES = (TF, "tf/msg/tfMessage")  # with the same fields
ODOMETRY = "nav_msgs/msg/Odometry"
STATIC = "tf_static"
FIXED = "odom"  # the frame of motion without jumps (REP 105); `map` above it may jump
STEP_S = 0.004  # sooner poses of a frame are left out
MARGIN_NS = 1_000_000_000  # poses are read for so much longer than scans
Row = tuple[float, ...]  # stamp_s, x, y, z, qx, qy, qz, qw


class Link(NamedTuple):
    """The pose of a frame in its parent."""

    parent: str
    pose: Trajectory | np.ndarray


def recorded_motion(
    recording: Recording, frame: str, start_ns: int | None = None, end_ns: int | None = None
) -> tuple[SensorMotion, str] | None:
    """Return the motion of a frame by a recording's tf, else by its odometry, and the name of the source.

    start_ns, end_ns  span of the scans, in nanoseconds since the epoch; poses are read a little further.
    None if nothing in the recording tells how the frame moves. Raises InputError at damage.
    """
    topics = recording.description.topics
    moving = tuple(topic for topic in topics if topic.type in (*TF_TYPES, ODOMETRY) and not _is_static(topic))
    if not any(topic.count for topic in moving):
        return None
    links, odometry = _Rows(), defaultdict[str, _Rows](_Rows)
    start_ns = None if start_ns is None else start_ns - MARGIN_NS
    for message in recording.messages(moving, start_ns, None if end_ns is None else end_ns + MARGIN_NS):
        content = _decoded(recording, message)
        if message.topic.type == ODOMETRY:
            odometry[message.topic.name].add(content, content.child_frame_id, content.pose.pose)
        else:
            links.add_all(content)
    tree = links.links() | _static_links(recording)
    return _by_tf(tree, frame.strip("/")) or _by_odometry(tree, frame.strip("/"), odometry)


def fixed_poses(recording: Recording, frames: Iterable[str]) -> dict[str, np.ndarray] | None:
    """Return T_root_frame (4, 4) float64 of each frame by the recording's tf_static; None if it does not link them."""
    tree, poses, roots = _static_links(recording), dict[str, np.ndarray](), set[str]()
    for frame in frames:
        chain = _chain(tree, frame.strip("/"), "")
        poses[frame] = reduce(lambda T, link: np.asarray(link[1].pose) @ T, chain, np.eye(4))
        roots.add(chain[-1][1].parent if chain else frame.strip("/"))
    return poses if len(roots) == 1 else None


def _is_static(topic: Topic) -> bool:
    return topic.type in TF_TYPES and STATIC in topic.name


def _static_links(recording: Recording) -> dict[str, Link]:
    """Return the links of a recording's tf_static by frame."""
    static = _Rows()
    for message in recording.messages(tuple(filter(_is_static, recording.description.topics))):
        static.add_all(_decoded(recording, message))
    return static.fixed_links()


def stamp_seconds(header: Any) -> float:  # noqa: ANN401
    """Return the seconds of the stamp of a ROS header."""
    return header.stamp.sec + header.stamp.nanosec * 1e-9


class _Rows:
    """Poses of frames in their parents, as they are read."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._rows: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))

    def add(self, stamped: Any, child: str, pose: Any) -> None:  # noqa: ANN401
        """Add a stamped transform or odometry, unless it is no pose (NaN, quaternion 0) or follows too soon."""
        stamp_s = stamp_seconds(stamped.header)
        moved = hasattr(pose, "translation")  # a Transform; an odometry has a Pose
        place, turn = (pose.translation, pose.rotation) if moved else (pose.position, pose.orientation)
        row = (stamp_s, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        rows = self._rows[child.strip("/")]
        if np.isfinite(row).all() and abs(np.linalg.norm(row[4:]) - 1) < 0.01:
            if not rows or not 0 <= stamp_s - rows[-8] < STEP_S:
                rows.extend(row)
            self._parents[child.strip("/")] = stamped.header.frame_id.strip("/")

    def add_all(self, message: Any) -> None:  # noqa: ANN401
        """Add the transforms of a TFMessage."""
        for transform in message.transforms:
            self.add(transform, transform.child_frame_id, transform.transform)

    def links(self) -> dict[str, Link]:
        """Return the links by frame; those recorded once only are fixed."""
        fixed = self.fixed_links()
        return {
            child: Link(parent, Trajectory.of(self._table(child))) if len(self._rows[child]) > 8 else fixed[child]
            for child, parent in self._parents.items()
        }

    def fixed_links(self) -> dict[str, Link]:
        """Return the latest poses by frame."""
        return {
            child: Link(parent, Trajectory.of(self._table(child)[-1:]).at(np.zeros(1))[0])
            for child, parent in self._parents.items()
        }

    def _table(self, child: str) -> np.ndarray:
        return np.frombuffer(self._rows[child]).reshape(-1, 8).copy()


def _decoded(recording: Recording, message: RawMessage) -> Any:  # noqa: ANN401
    topic = message.topic
    if topic.type in TF_TYPES:
        message = message._replace(topic=Topic(name=topic.name, type=TF, count=topic.count))
    with damage(recording.path, f"its topic {topic.name} must be recorded again, or left out"):
        return recording.decode(message)


def _chain(tree: Mapping[str, Link], frame: str, root: str) -> list[tuple[str, Link]]:
    """Return the links from a frame up to `root`, or to the top of the tree; each with its frame."""
    chain: list[tuple[str, Link]] = []
    while frame in tree and frame != root and all(frame != passed for passed, _ in chain):
        chain.append((frame, tree[frame]))
        frame = tree[frame].parent
    return chain


def _by_tf(tree: Mapping[str, Link], frame: str) -> tuple[SensorMotion, str] | None:
    chain = _chain(tree, frame, FIXED)
    if not any(isinstance(link.pose, Trajectory) for _, link in chain):
        return None
    return _motion([link.pose for _, link in chain]), f"tf from {chain[-1][1].parent} to {frame}"


def _by_odometry(
    tree: Mapping[str, Link], frame: str, odometry: Mapping[str, _Rows]
) -> tuple[SensorMotion, str] | None:
    """Return the topic whose moving frame is the sensor's, or carries it rigidly."""
    for name, rows in sorted(odometry.items()):
        for child, link in rows.links().items():
            chain = _chain(tree, frame, child)
            reaches = child in {"", frame} or (chain and chain[-1][1].parent == child)
            rigid = not any(isinstance(mount.pose, Trajectory) for _, mount in chain)
            if reaches and rigid and isinstance(link.pose, Trajectory):
                mounts = [] if child in {"", frame} else [mount.pose for _, mount in chain]
                return _motion([*mounts, link.pose]), name
    return None


def _motion(upwards: Sequence[Trajectory | np.ndarray]) -> SensorMotion:
    return SensorMotion(tuple(reversed(upwards)))
