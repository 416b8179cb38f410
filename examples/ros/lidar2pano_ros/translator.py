"""What the node does with each cloud, without ROS: messages in, messages out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar2pano import COMMON15, SEMANTIC_KITTI, Calibration, InputError, Panorama, Pipeline
from lidar2pano.data.camera_files import calibration_of
from lidar2pano.drives.camera_choice import CameraOptions
from lidar2pano.drives.cameras import CameraSource, read_sources
from lidar2pano.drives.drive_motion import T_scan_cloud
from lidar2pano.drives.reading import Overrides, Reading, ReadingOptions, ScanSource, StreamReader
from lidar2pano.formats.arrays import cloud_of_message
from lidar2pano.geometry.stitching import Camera
from lidar2pano.recordings.recorded_images import REACH_S, intrinsics, pixels
from lidar2pano.recordings.transforms import stamp_seconds
from lidar2pano.translation import Translator
from lidar2pano_ros.interface import TOPICS
from lidar2pano_ros.messages import (
    fill_camera_info,
    fill_compressed,
    fill_image,
    fill_pinhole_info,
    fill_points,
    in_cloud,
    points_of,
)

KEPT = 16  # images of a camera that wait for their cloud

# (target frame, its stamp, source frame, its stamp) -> (4, 4) T_target_source; raises InputError if tf does not know
Transform = Callable[[str, Any, str, Any], np.ndarray]


class ImageFeed:
    """The latest images of a topic, and its CameraInfo."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.info_topic = f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
        self._images: deque[Any] = deque(maxlen=KEPT)
        self._info: Any = None

    def add(self, image: Any) -> None:
        """Keep an image."""
        self._images.append(image)

    def describe(self, info: Any) -> None:
        """Keep the CameraInfo."""
        self._info = info

    def read(self, header: Any, transform: Transform) -> Camera:
        """Return the camera with its image nearest to a cloud of this header; InputError where one is missing."""
        images, info = tuple(self._images), self._info
        if info is None:
            raise InputError(f"no CameraInfo has come on {self.info_topic}")
        image = min(images, key=lambda one: abs(stamp_seconds(one.header) - stamp_seconds(header)), default=None)
        time_s = stamp_seconds(image.header) - stamp_seconds(header) if image else np.inf
        if image is None or abs(time_s) > REACH_S:
            raise InputError("it has no image near the cloud")
        T = transform(info.header.frame_id, image.header.stamp, header.frame_id, header.stamp)
        shown = pixels(image, self.topic)
        size, topic = (shown.shape[1], shown.shape[0]), Path(self.topic)
        calibration = calibration_of(Path(self.info_topic), intrinsics(info, self.topic), topic, size, T)
        return Camera(shown, calibration, time_s=time_s)


class Translated(NamedTuple):
    """Messages by topic, and sentences about cameras that are left out, or implausible properties of the cloud."""

    messages: dict[str, Any]
    doubts: list[str]


class CloudTranslator:
    """Makes the messages of TOPICS from clouds, one after the other as a stream.

    new          makes empty messages, by the names of their types; PointField among them.
    calibration  of the camera whose view is published, None for the panorama.
    transform    of tf, None without cameras and poses;  fixed_frame: that does not move, "" for no poses.
    overrides    facts about the clouds.
    """

    def __init__(  # noqa: PLR0913 parameters of the node
        self,
        pipeline: Pipeline,
        new: Mapping[str, Callable[[], Any]],
        calibration: Calibration | None = None,
        *,
        feeds: Sequence[ImageFeed] = (),
        transform: Transform | None = None,
        fixed_frame: str = "",
        overrides: Overrides | None = None,
    ) -> None:
        pipeline = pipeline.at(calibration) if calibration else pipeline
        self._reader = StreamReader(ReadingOptions(overrides=overrides or Overrides()))
        self._translator = Translator(lambda: pipeline)
        self._new, self._calibration, self._feeds = new, calibration, feeds
        self._transform, self._fixed_frame = transform, fixed_frame

    def __call__(self, message: Any, wanted: Collection[str] = tuple(TOPICS)) -> Translated:
        """Return the wanted messages of a PointCloud2; InputError where it holds no scan."""
        source = ScanSource(
            path=Path(),
            title="points",
            stem="points",
            cloud=lambda: cloud_of_message(message, "points"),
            stream="points",
        )
        reading = self._reader.read(source)
        doubts: list[str] = []
        if reading.interpretation is not None and self._transform is not None:
            reading = self._with_pose(reading, message.header, doubts)
            reading = self._with_cameras(reading, message.header)
        translation = self._translator(reading)
        panorama = translation.panorama
        if panorama is None:
            raise translation.error or InputError("points: hold no scan")
        doubts += translation.doubts
        return Translated(self._messages(message.header, reading, panorama, wanted), doubts)

    def _with_pose(self, reading: Reading, header: Any, doubts: list[str]) -> Reading:
        """Return the reading with the sensor's pose in the fixed frame; without one where tf does not know it."""
        assert reading.interpretation is not None and self._transform is not None
        if not self._fixed_frame:
            return reading
        try:
            pose = self._transform(self._fixed_frame, header.stamp, header.frame_id, header.stamp)
        except InputError as error:
            doubts.append(f"no pose: {error}")
            return reading
        return replace(reading, pose=pose @ np.linalg.inv(T_scan_cloud(reading.interpretation)))

    def _with_cameras(self, reading: Reading, header: Any) -> Reading:
        """Return the reading with the images nearest in time."""
        assert reading.interpretation is not None and self._transform is not None
        sources = [CameraSource(feed.topic, partial(feed.read, header, self._transform)) for feed in self._feeds]
        cameras = read_sources(sources, CameraOptions(), T_scan_cloud(reading.interpretation))
        viewpoint = None if self._calibration else cameras.viewpoint
        return replace(reading, cameras=cameras.cameras, camera_doubts=cameras.doubts, calibration=viewpoint)

    def _messages(self, header: Any, reading: Reading, panorama: Panorama, wanted: Collection[str]) -> dict[str, Any]:
        """Return the wanted messages; of a camera's view there is no depth."""
        shown = panorama.to_camera(self._calibration) if self._calibration else panorama
        makers: dict[str, Callable[[Any], Any]] = {
            "image": lambda message: fill_image(message, header, shown.colour),
            "image/compressed": lambda message: fill_compressed(message, header, shown.colour),
            "camera_info": lambda message: self._info(message, header, reading, panorama),
            "labels": lambda message: fill_image(message, header, shown.segments),
            "classes": lambda message: fill_image(message, header, COMMON15.paint(shown.segments)),
            "points": lambda message: self._points(message, header, reading, panorama),
        }
        if not self._calibration:
            metres = np.where(panorama.depth_m > 0, panorama.depth_m, np.float32(np.nan))
            makers["depth"] = lambda message: fill_image(message, header, metres)
        return {name: makers[name](self._new[TOPICS[name]]()) for name in TOPICS if name in makers and name in wanted}

    def _info(self, message: Any, header: Any, reading: Reading, panorama: Panorama) -> Any:
        if self._calibration:
            return fill_pinhole_info(message, header, self._calibration)
        assert reading.interpretation is not None
        return fill_camera_info(message, header, panorama.view, T_scan_cloud(reading.interpretation))

    def _points(self, message: Any, header: Any, reading: Reading, panorama: Panorama) -> Any:
        scan, interpretation = reading.scan, reading.interpretation
        assert scan is not None and interpretation is not None
        xyz = in_cloud(scan.xyz, T_scan_cloud(interpretation))
        colour, label = panorama.colour_points(scan).colour, SEMANTIC_KITTI.to_raw(panorama.labels)
        return fill_points(message, self._new["PointField"], header, points_of(xyz, scan.remission, colour, label))
