"""A ROS 2 node: PointCloud2 in; panorama, classes, depth and coloured points out.

    ros2 launch lidar2pano_ros panorama.launch.py points:=/velodyne_points weights:=world
    python -m lidar2pano_ros.node --ros-args -r points:=/velodyne_points -p weights:=world

It subscribes to `points` (sensor_msgs/PointCloud2) and publishes the topics of `interface.TOPICS` below `panorama/`
with the stamp and frame of the cloud, each only while somebody listens. Clouds that come while one is at work are left
out, but for the latest. Parameters: `interface.PARAMETERS`.

rclpy comes with ROS 2 and not from PyPI; it is imported when the node starts.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano import InputError, load, read_calib
from lidar2pano.drives.reading import Overrides
from lidar2pano.geometry.motion import rotation_matrices
from lidar2pano_ros.interface import PARAMETERS, TOPICS
from lidar2pano_ros.translator import CloudTranslator, ImageFeed, Transform

WAIT_S = 0.2  # for transforms that come after their cloud
SAY_S = 5.0  # between warnings


def run(arguments: Sequence[str] | None = None) -> None:
    """Run the node until ROS shuts down. Raises InputError where rclpy or a parameter cannot be had."""
    try:
        import rclpy  # pyright: ignore[reportMissingImports]
        from rclpy.executors import (  # pyright: ignore[reportMissingImports]
            ExternalShutdownException,
            MultiThreadedExecutor,
        )
        from rclpy.node import Node  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "lidar2pano_ros needs rclpy, which comes with ROS 2 and not from PyPI: source /opt/ros/DISTRO/setup.bash"
        ) from error
    rclpy.init(args=arguments)
    try:
        node = Node("lidar2pano")
        add_work(node)
        rclpy.spin(node, MultiThreadedExecutor(num_threads=2))  # images and tf come in while a cloud is at work
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


def add_work(node: Any) -> None:
    """Declare a node's parameters, subscribe and publish. Raises InputError for a parameter of no use."""
    from rclpy.callback_groups import (  # pyright: ignore[reportMissingImports]
        MutuallyExclusiveCallbackGroup,
        ReentrantCallbackGroup,
    )
    from rclpy.qos import qos_profile_sensor_data  # pyright: ignore[reportMissingImports]
    from sensor_msgs import msg  # pyright: ignore[reportMissingImports]

    chosen = {name: str(node.declare_parameter(name, default).value) for name, (default, _) in PARAMETERS.items()}
    overrides = overrides_of(chosen)
    pipeline = load(chosen["weights"], chosen["device"], chosen["engine"])
    pipeline = pipeline.in_look(chosen["look"]) if chosen["look"] else pipeline
    pipeline = pipeline.reaching(chosen["elevation"]) if chosen["elevation"] else pipeline
    calibration = read_calib(Path(chosen["calib"])) if chosen["calib"] else None
    feeds = [ImageFeed(topic.strip()) for topic in chosen["cameras"].split(",") if topic.strip()]
    group = ReentrantCallbackGroup()
    for feed in feeds:
        kind = msg.CompressedImage if feed.topic.endswith("/compressed") else msg.Image
        node.create_subscription(kind, feed.topic, feed.add, qos_profile_sensor_data, callback_group=group)
        node.create_subscription(
            msg.CameraInfo, feed.info_topic, feed.describe, qos_profile_sensor_data, callback_group=group
        )
    transform = transforms(node, chosen["fixed_frame"]) if feeds or chosen["fixed_frame"] else None
    new = {name: getattr(msg, name) for name in {*TOPICS.values(), "PointField"}}
    translate = CloudTranslator(
        pipeline,
        new,
        calibration,
        feeds=feeds,
        transform=transform,
        fixed_frame=chosen["fixed_frame"],
        overrides=overrides,
    )
    publishers = {
        name: node.create_publisher(getattr(msg, kind), f"panorama/{name}", 1) for name, kind in TOPICS.items()
    }

    def on_points(message: Any) -> None:
        wanted = [name for name, publisher in publishers.items() if publisher.get_subscription_count()]
        if not wanted:
            return
        try:
            translated = translate(message, wanted)
        except InputError as error:
            node.get_logger().warning(str(error), throttle_duration_sec=SAY_S)
            return
        if translated.doubts:
            node.get_logger().warning("; ".join(translated.doubts), throttle_duration_sec=SAY_S)
        for name, filled in translated.messages.items():
            publishers[name].publish(filled)

    node.create_subscription(
        msg.PointCloud2, "points", on_points, latest_of_sensors(), callback_group=MutuallyExclusiveCallbackGroup()
    )


def overrides_of(chosen: Mapping[str, str]) -> Overrides:
    """Return the facts about clouds that parameters state; InputError for a value of no use."""
    text = chosen["sensor_height"]
    try:
        height_m = float(text) if text else None
    except ValueError as error:
        raise InputError(f"sensor_height: {text!r} is no height above the ground in metres") from error
    return Overrides(sensor_height_m=height_m, forward=chosen["forward"], remission=chosen["remission"])


def latest_of_sensors() -> Any:
    """Return the quality of service of sensor data, of which only the latest one waits."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # pyright: ignore[reportMissingImports]

    return QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def transforms(node: Any, fixed_frame: str) -> Transform:
    """Return a function that asks tf for transforms between two frames at two times."""
    import tf2_ros  # pyright: ignore[reportMissingImports]
    from rclpy.duration import Duration  # pyright: ignore[reportMissingImports]
    from rclpy.time import Time  # pyright: ignore[reportMissingImports]

    buffer = tf2_ros.Buffer()
    buffer.listener = tf2_ros.TransformListener(buffer, node)  # which would stop when nothing held it

    def transform(target: str, target_stamp: Any, source: str, source_stamp: Any) -> np.ndarray:
        wait = Duration(seconds=WAIT_S)
        try:
            if fixed_frame:
                times = Time.from_msg(target_stamp), Time.from_msg(source_stamp)
                found = buffer.lookup_transform_full(target, times[0], source, times[1], fixed_frame, wait)
            else:
                found = buffer.lookup_transform(target, source, Time.from_msg(source_stamp), wait)
        except tf2_ros.TransformException as error:
            raise InputError(f"tf does not link {source!r} to {target!r} ({error})") from error
        return matrix(found.transform)

    return transform


def matrix(transform: Any) -> np.ndarray:
    """Return the (4, 4) float64 matrix of a geometry_msgs/Transform."""
    place, turn = transform.translation, transform.rotation
    rotation = np.array([[turn.x, turn.y, turn.z, turn.w]])
    T = np.eye(4)
    T[:3, :3] = rotation_matrices(rotation / np.linalg.norm(rotation))[0]
    T[:3, 3] = place.x, place.y, place.z
    return T


def main() -> int:
    """Run the node; its exit code."""
    try:
        run()
    except InputError as error:
        print(f"lidar2pano_ros: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
