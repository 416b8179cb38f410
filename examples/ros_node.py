"""A ROS 2 node: PointCloud2 in, the panorama as Image and CameraInfo out.

    python ros_node.py --ros-args -r points:=/velodyne_points -p weights:=world

It subscribes to `points` (sensor_msgs/PointCloud2), and publishes `panorama/image` (sensor_msgs/Image, rgb8) and
`panorama/camera_info` (sensor_msgs/CameraInfo) with the stamp and frame of the cloud. Clouds that come while one is at
work are left out, but for the latest. Parameters: `weights` and `device`, as of `lidar2pano translate`; `calib`, a
KITTI calib.txt, publishes that camera's view instead of the panorama.

No model of CameraInfo describes a panorama, and none is pretended: see `fill_camera_info`. rclpy comes with ROS 2 and
not from PyPI; it is imported when the node starts.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano import Calibration, InputError, View, load, read_calib
from lidar2pano.drives.reading import ScanSource, StreamReader
from lidar2pano.formats.arrays import cloud_of_message
from lidar2pano.translation import Translator

CYLINDRICAL = "cylindrical"


def fill_image(image: Any, header: Any, colour: np.ndarray) -> Any:  # noqa: ANN401
    """Fill a sensor_msgs/Image with RGB (h, w, 3) uint8; returns it."""
    image.header = header
    image.height, image.width = colour.shape[:2]
    image.encoding, image.is_bigendian, image.step = "rgb8", 0, 3 * colour.shape[1]
    image.data = array("B", colour.tobytes())  # which rclpy takes without a look at each byte
    return image


def fill_camera_info(info: Any, header: Any, view: View) -> Any:  # noqa: ANN401
    """Fill a sensor_msgs/CameraInfo for a panorama on a cylinder; returns it.

    ROS has no such projection. Therefore distortion_model is "cylindrical", which no program of ROS knows, and K, R
    and P stay zero, which ROS defines as not calibrated: whatever assumes a pinhole camera refuses it. d holds
    (fu, cu, fv, cv, x, y, z). Pixel (u, v), whose middle has whole numbers, looks from the point (x, y, z) of the
    cloud's frame in metres (x forward, y left, z up; the frame is not an optical one) along

        azimuth = (cu - u) / fu   in radians, counter-clockwise from x;      tan(elevation) = (cv - v) / fv.
    """
    fu, fv = view.focal_px, view.rows / (view.up - view.down)
    info.header = header
    info.height, info.width = view.rows, view.columns
    info.distortion_model = CYLINDRICAL
    cu, cv = fu * np.radians(view.left) - 0.5, fv * view.up - 0.5
    info.d = [float(value) for value in (fu, cu, fv, cv, *view.origin)]
    info.k, info.r, info.p = [0.0] * 9, [0.0] * 9, [0.0] * 12
    return info


def fill_pinhole_info(info: Any, header: Any, calibration: Calibration) -> Any:  # noqa: ANN401
    """Fill a sensor_msgs/CameraInfo for a perspective camera without distortion; returns it."""
    info.header = header
    info.width, info.height = calibration.size
    info.distortion_model, info.d = "plumb_bob", [0.0] * 5
    K = calibration.K
    info.k, info.r = [float(value) for value in K.ravel()], [float(value) for value in np.eye(3).ravel()]
    info.p = [float(value) for value in np.c_[K, np.zeros(3)].ravel()]
    return info


class CloudTranslator:
    """What the node does with each cloud, without ROS.

    pipeline     lidar2pano.Pipeline;  new_image, new_info: make empty messages.
    calibration  of the camera whose view is published, None for the panorama.
    """

    def __init__(self, pipeline: Any, new_image: Any, new_info: Any, calibration: Calibration | None = None) -> None:  # noqa: ANN401
        pipeline = pipeline.at(calibration) if calibration else pipeline
        self._reader, self._translator = StreamReader(), Translator(lambda: pipeline)
        self._new_image, self._new_info, self._calibration = new_image, new_info, calibration

    def __call__(self, message: Any) -> tuple[Any, Any]:  # noqa: ANN401
        """(Image, CameraInfo) of a PointCloud2; InputError where it holds no scan."""
        source = ScanSource(
            path=Path(),
            title="points",
            stem="points",
            cloud=lambda: cloud_of_message(message, "points"),
            stream="points",
        )
        translation = self._translator(self._reader.read(source))
        panorama = translation.panorama
        if panorama is None:
            raise translation.error or InputError("points: hold no scan")
        image, info = self._new_image(), self._new_info()
        if self._calibration is None:
            fill_camera_info(info, message.header, panorama.view)
            return fill_image(image, message.header, panorama.colour), info
        fill_pinhole_info(info, message.header, self._calibration)
        return fill_image(image, message.header, panorama.to_camera(self._calibration).colour), info


def run(arguments: Sequence[str] | None = None) -> None:
    """Run the node until ROS shuts down. Raises InputError where rclpy or a parameter cannot be had."""
    try:
        import rclpy  # pyright: ignore[reportMissingImports]
        from rclpy.executors import ExternalShutdownException  # pyright: ignore[reportMissingImports]
        from rclpy.node import Node  # pyright: ignore[reportMissingImports]
        from rclpy.qos import qos_profile_sensor_data  # pyright: ignore[reportMissingImports]
        from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "ros_node.py needs rclpy, which comes with ROS 2 and not from PyPI: source /opt/ros/DISTRO/setup.bash"
        ) from error
    rclpy.init(args=arguments)
    try:
        node = Node("lidar2pano")
        weights, device, calib = (
            node.declare_parameter(name, value).value
            for name, value in (("weights", "kitti-mini"), ("device", "auto"), ("calib", ""))
        )
        calibration = read_calib(Path(calib)) if calib else None
        translate = CloudTranslator(load(weights, device), Image, CameraInfo, calibration)
        images = node.create_publisher(Image, "panorama/image", 1)
        infos = node.create_publisher(CameraInfo, "panorama/camera_info", 1)

        def on_points(message: Any) -> None:  # noqa: ANN401
            try:
                image, info = translate(message)
            except InputError as error:
                node.get_logger().warning(str(error), throttle_duration_sec=5.0)
                return
            images.publish(image)
            infos.publish(info)

        latest = qos_profile_sensor_data
        latest.depth = 1
        node.create_subscription(PointCloud2, "points", on_points, latest)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


def main() -> int:
    """Run the node; its exit code."""
    try:
        run()
    except InputError as error:
        print(f"ros_node.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
