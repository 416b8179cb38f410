"""Images of a recording's cameras at the times of its scans: Image or CompressedImage, CameraInfo, tf_static."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import decode_image
from lidar2pano.geometry.motion import SensorMotion
from lidar2pano.recordings.description import Topic, damage
from lidar2pano.recordings.recorded_scans import open_recording
from lidar2pano.recordings.transforms import fixed_poses, recorded_motion, stamp_seconds

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
NO_COLOURS = ("depth", "disparity", "mask", "label", "segment")  # in names of topics of other images
GREY = ("mono", "grey", "gray")
RECTIFIED = "rect"  # in the last part of a name, by image_proc's convention: without the lens's distortion
REACH_S = 0.5  # images so much behind a scan are read: drivers send them after different times
STILL_S = 1e-3  # clocks agree no better
MEND = "record it again, or name other cameras"
# encoding -> channels, and the order of red, green and blue among them
PLAIN = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))}
PLAIN |= {"8UC3": (3, (2, 1, 0)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0))}
BAYER = {"bayer_rggb8": "RGGB", "bayer_bggr8": "BGGR", "bayer_gbrg8": "GBRG", "bayer_grbg8": "GRBG"}


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedImage:
    """The image of a camera nearest in time to a scan; an error in place of it.

    topic           of its images;  time_s: after the scan.
    T_camera_lidar  (4, 4) at these times: with the motion between them, if it is known;  moved: whether it is.
    intrinsics      by names of ROS's calibration files: camera_matrix, distortion_coefficients, ...
    """

    topic: str
    image: np.ndarray | None = None
    time_s: float = 0.0
    T_camera_lidar: np.ndarray | None = None
    moved: bool = True
    intrinsics: dict[str, Any] | None = None
    error: str = ""


class _Mount(NamedTuple):
    """Intrinsics of a camera and its pose (4, 4) beside the LiDAR."""

    intrinsics: dict[str, Any]
    T_camera_lidar: np.ndarray


def camera_topics(path: Path, topics: Sequence[Topic], names: Sequence[str]) -> list[tuple[Topic, Topic | None]]:
    """Return topics of images, each with the topic of its CameraInfo, in the folder of its name or one above it.

    names  of the topics; none: one topic of colours for each CameraInfo, of full images before compressed ones.
    Raises InputError for a name without images.
    """
    info_by_folder = {
        topic.name.rpartition("/")[0]: topic for topic in topics if topic.type == CAMERA_INFO and topic.count
    }
    images = [topic for topic in topics if topic.type in (IMAGE, COMPRESSED_IMAGE) and topic.count]
    pairs = [
        (image, next((info_by_folder[folder] for folder in _folders(image.name) if folder in info_by_folder), None))
        for image in images
    ]
    if names:
        by_name = {image.name.strip("/"): (image, info) for image, info in pairs}
        if missing := [name for name in names if name.strip("/") not in by_name]:
            hint = closest(missing[0].strip("/"), by_name) or "; it has none"
            raise InputError(f"{path}: --cameras: has no images on topic {missing[0]!r}{hint}")
        return [by_name[name.strip("/")] for name in names]
    best: dict[str, tuple[Topic, Topic | None]] = {}
    for image, info in sorted(pairs, key=lambda pair: _rank(pair[0])):
        if info is not None and not any(word in image.name.lower() for word in NO_COLOURS):
            best.setdefault(info.name, (image, info))
    return [best[name] for name in sorted(best)]


def _folders(name: str) -> Iterator[str]:
    """Yield the folders of a topic's name, the nearest first."""
    while "/" in name:
        name = name.rpartition("/")[0]
        yield name


def _rank(topic: Topic) -> tuple[bool, bool, str]:
    """Return the order of the topics of one camera, the best first."""
    return any(word in topic.name.lower() for word in GREY), topic.type != IMAGE, topic.name


class ImagePlayback:
    """The images of a recording's cameras at times in ascending order."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        """Open the recording; InputError for damage, and for names without images."""
        self.path, self._recording = path, open_recording(path)
        try:
            self._pairs = camera_topics(path, self._recording.description.topics, names)
        except BaseException:
            self.close()
            raise
        self._mounts: dict[str, _Mount | str] = {}
        self._motion: SensorMotion | None = None
        self._messages: Iterator[tuple[str, float, Any]] | None = None
        self._waiting: dict[str, list[tuple[float, Any]]] = {image.name: [] for image, _ in self._pairs}

    def topics(self) -> list[str]:
        """Return the names of the cameras' topics."""
        return [image.name for image, _ in self._pairs]

    def at(self, stamp_s: float, frame: str) -> list[RecordedImage]:
        """Return the image of each camera nearest to the time of a scan whose coordinates are in `frame`."""
        if self._messages is None:
            self._mounts = {image.name: self._mount(info, image.name, frame) for image, info in self._pairs}
            motion = recorded_motion(self._recording, frame)
            self._motion = motion[0] if motion else None
            self._messages = self._decoded(stamp_s)
        self._read_up_to(stamp_s)
        return [self._nearest(image.name, stamp_s) for image, _ in self._pairs]

    def _decoded(self, stamp_s: float) -> Iterator[tuple[str, float, Any]]:
        """Yield topic, time and content of images, from a little before a time on if the clocks allow it."""
        recording, start_ns = self._recording, round((stamp_s - 2 * REACH_S) * 1e9)
        about = recording.description
        is_within = about.first_ns <= start_ns <= about.last_ns
        for raw in recording.messages(tuple(image for image, _ in self._pairs), start_ns if is_within else None):
            with damage(self.path, MEND):
                content = recording.decode(raw)
            yield raw.topic.name, stamp_seconds(content.header) or raw.stamp_ns * 1e-9, content

    def _read_up_to(self, stamp_s: float) -> None:
        """Read until each camera has an image after a time, or one is far behind; of those before it one is kept."""
        assert self._messages is not None
        while not all(images and images[-1][0] >= stamp_s for images in self._waiting.values()):
            if any(images and images[-1][0] > stamp_s + REACH_S for images in self._waiting.values()):
                break
            if (following := next(self._messages, None)) is None:
                break
            topic, time_s, content = following
            images = self._waiting[topic]
            if images and images[-1][0] < stamp_s and time_s < stamp_s:
                images.clear()
            images.append((time_s, content))
        for images in self._waiting.values():
            passed = sum(time_s < stamp_s for time_s, _ in images)
            del images[: max(passed - 1, 0)]

    def _nearest(self, topic: str, stamp_s: float) -> RecordedImage:
        mount, images = self._mounts[topic], self._waiting[topic]
        if isinstance(mount, str):
            return RecordedImage(topic=topic, error=mount)
        if not images:
            return RecordedImage(topic=topic, error="it has no image near the scan")
        time_s, content = min(images, key=lambda timed: abs(timed[0] - stamp_s))
        try:
            with damage(self.path, MEND):
                image = pixels(content, topic)
        except InputError as error:
            return RecordedImage(topic=topic, error=str(error))
        T, moved = mount.T_camera_lidar, abs(time_s - stamp_s) < STILL_S
        poses = [self._motion.pose(moment_s) for moment_s in (time_s, stamp_s)] if self._motion else [None]
        if all(pose is not None for pose in poses):
            T, moved = T @ np.linalg.inv(poses[0]) @ poses[1], True  # pyright: ignore[reportArgumentType, reportCallIssue]
        return RecordedImage(
            topic=topic,
            image=image,
            time_s=time_s - stamp_s,
            T_camera_lidar=T,
            moved=moved,
            intrinsics=mount.intrinsics,
        )

    def _mount(self, info: Topic | None, topic: str, frame: str) -> _Mount | str:
        """Return a camera's intrinsics and pose, or a clause on the missing part."""
        if info is None:
            return "no sensor_msgs/CameraInfo is recorded beside its images; record camera_info, too"
        with damage(self.path, MEND):
            content = self._recording.decode(next(self._recording.messages((info,))))
        camera_frame = content.header.frame_id
        poses = fixed_poses(self._recording, (frame, camera_frame))
        if poses is None:
            return f"tf_static does not link its frame {camera_frame!r} to the scan's {frame!r}; record tf_static"
        return _Mount(intrinsics(content, topic), np.linalg.inv(poses[camera_frame]) @ poses[frame])

    def close(self) -> None:
        """Close the recording."""
        self._messages = None
        self._recording.close()


def intrinsics(info: Any, topic: str) -> dict[str, Any]:  # noqa: ANN401
    """Return a CameraInfo by the names of ROS's calibration files; of a rectified image without the distortion."""
    K, D, P = (np.asarray(getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper()))
               for name in "kdp")  # fmt: skip
    parts = topic.removesuffix("/compressed").rpartition("/")[2]
    sizes: dict[str, Any] = {name: int(getattr(info, name, 0)) for name in ("binning_x", "binning_y")}
    if (region := getattr(info, "roi", None)) is not None:
        sizes["roi"] = {name: int(getattr(region, name)) for name in ("x_offset", "y_offset", "width", "height")}
    if info.width and info.height:
        sizes |= {"image_width": int(info.width), "image_height": int(info.height)}
    if RECTIFIED in parts and P.any():
        return sizes | {"camera_matrix": P.reshape(3, 4)[:, :3].ravel().tolist()}
    distortion = {"distortion_coefficients": D.tolist(), "distortion_model": str(info.distortion_model) or "plumb_bob"}
    return sizes | {"camera_matrix": K.tolist()} | distortion


def pixels(content: Any, topic: str) -> np.ndarray:  # noqa: ANN401
    """Return the pixels (h, w, 3) uint8 RGB of an Image or a CompressedImage; InputError for an unknown encoding."""
    data = np.asarray(content.data, dtype=np.uint8)
    if not hasattr(content, "encoding"):
        return decode_image(io.BytesIO(data.tobytes()), f"an image of {topic}", "RGB")
    encoding, height, width = content.encoding, int(content.height), int(content.width)
    if encoding not in PLAIN and encoding not in BAYER:
        encodings = ", ".join((*PLAIN, *BAYER))
        raise InputError(f"its images have the encoding {encoding!r}, which is not read; record one of {encodings}")
    channels, order = PLAIN.get(encoding, (1, (0, 0, 0)))
    rows = data[: height * content.step].reshape(height, content.step)[:, : width * channels]
    image = rows.reshape(height, width, channels)
    if encoding in BAYER:
        return _demosaiced(image[..., 0], BAYER[encoding])
    return np.ascontiguousarray(image[..., list(order)])


def _demosaiced(raw: np.ndarray, pattern: str) -> np.ndarray:
    """Return colours (h, w, 3) uint8 of a Bayer pattern: means of the neighbours of each colour."""
    height, width = raw.shape
    sums = np.zeros((2, height + 2, width + 2, 3), dtype=np.float32)
    for place, colour in enumerate(pattern):
        cells = slice(place // 2, None, 2), slice(place % 2, None, 2)
        values = np.zeros((2, height, width), dtype=np.float32)
        values[0][cells], values[1][cells] = raw[cells], 1
        for down, right in np.ndindex(3, 3):
            weight = (2 - abs(down - 1)) * (2 - abs(right - 1))
            sums[:, down : down + height, right : right + width, "RGB".index(colour)] += weight * values
    inner = sums[:, 1:-1, 1:-1]
    return (inner[0] / inner[1].clip(min=1e-9)).round().clip(0, 255).astype(np.uint8)
