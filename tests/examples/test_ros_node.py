"""The ROS node, with message objects and without ROS."""

from __future__ import annotations

import runpy
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from house_rules import ROOT
from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.pipeline import load
from lidar2pano.views import VIEWS
from miniature import street
from slow_definitions import place_slowly

NODE = ROOT / "examples" / "ros_node.py"
ros = SimpleNamespace(**runpy.run_path(str(NODE)))

HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=500), frame_id="velodyne")


class Message:
    """Like a message of rclpy: made empty, filled by assignment."""


def cloud(scan, **changed) -> SimpleNamespace:
    """A PointCloud2 of a scan."""
    rows = np.c_[scan.xyz, scan.remission].astype("<f4")
    fields = [SimpleNamespace(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyzi")]
    content = {"height": 1, "width": len(rows), "fields": fields, "is_bigendian": False, "point_step": 16}
    content |= {"row_step": 16 * len(rows), "data": rows.tobytes(), "is_dense": True, "header": HEADER}
    return SimpleNamespace(**content | changed)


def test_a_cloud_becomes_image_and_camera_info(random_weights):
    pipeline = load(random_weights, "cpu")
    scan = street(0, 3000)
    image, info = ros.CloudTranslator(pipeline, Message, Message)(cloud(scan))
    wanted = pipeline(scan)
    rows, columns = wanted.colour.shape[:2]
    assert (image.height, image.width, image.encoding, image.step) == (rows, columns, "rgb8", 3 * columns)
    assert np.array_equal(np.frombuffer(image.data, np.uint8).reshape(rows, columns, 3), wanted.colour)
    assert image.header is HEADER and info.header is HEADER
    assert (info.height, info.width) == (rows, columns)


@pytest.mark.parametrize("view", [VIEWS["panorama"], VIEWS["panorama"].scaled(1 / 8)])
def test_camera_info_tells_where_pixels_look(view):
    """A point lands in the pixel that d gives for it: the definition of the projection is the judge."""
    info = ros.fill_camera_info(Message(), HEADER, view)
    assert info.distortion_model == "cylindrical" and not any(info.k) and not any(info.p) and not any(info.r)
    fu, cu, fv, cv, x, y, z = info.d
    generator = np.random.default_rng(0)
    for _ in range(200):
        row, column = int(generator.integers(view.rows)), int(generator.integers(view.columns))
        azimuth, slope, flat = (cu - column) / fu, (cv - row) / fv, generator.uniform(3, 40)
        point = np.array([x + flat * np.cos(azimuth), y + flat * np.sin(azimuth), z + flat * slope])
        assert place_slowly(point, view) == (row, column)


def test_a_camera_of_its_own_is_a_pinhole(random_weights):
    K = np.array([[70.0, 0, 60], [0, 70, 18], [0, 0, 1]])
    axes = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    calibration = Calibration(K=K, T_camera_lidar=axes, size=(120, 36))
    pipeline = load(random_weights, "cpu")
    image, info = ros.CloudTranslator(pipeline, Message, Message, calibration)(cloud(street(0, 3000)))
    assert (image.width, image.height) == (info.width, info.height) == (120, 36)
    assert info.distortion_model == "plumb_bob" and info.k == K.ravel().tolist() and info.p[:4] == [70, 0, 60, 0]
    assert np.array_equal(
        np.frombuffer(image.data, np.uint8).reshape(36, 120, 3),
        pipeline.at(calibration)(street(0, 3000)).to_camera(calibration).colour,
    )


def test_a_cloud_without_points_is_an_error(random_weights):
    with pytest.raises(InputError, match="holds no points"):
        ros.CloudTranslator(load(random_weights, "cpu"), Message, Message)(cloud(street(0, 3000), width=0, data=b""))


def module(name: str, **content) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(content)
    return made


def test_the_node_publishes_what_it_is_sent(random_weights, monkeypatch):
    published, warnings = [], []
    good, bad = cloud(street(0, 3000)), cloud(street(0, 3000), width=0, data=b"")

    class Node:
        def __init__(self, name: str) -> None:
            self.name = name

        def declare_parameter(self, name: str, value: str) -> SimpleNamespace:
            return SimpleNamespace(value={"weights": str(random_weights), "device": "cpu"}.get(name, value))

        def create_publisher(self, _: type, topic: str, depth: int) -> SimpleNamespace:
            return SimpleNamespace(publish=lambda message: published.append((topic, message, depth)))

        def create_subscription(self, _: type, topic: str, callback, quality: SimpleNamespace) -> None:
            assert topic == "points" and quality.depth == 1
            self.callback = callback

        def get_logger(self) -> SimpleNamespace:
            return SimpleNamespace(warning=lambda text, **_: warnings.append(text))

    def spin(node: Node) -> None:
        for message in (bad, good):
            node.callback(message)
        raise KeyboardInterrupt

    stopped = []
    rclpy = module("rclpy", init=lambda args: None, spin=spin, try_shutdown=lambda: stopped.append(1))
    for one in (
        rclpy,
        module("rclpy.executors", ExternalShutdownException=type("ExternalShutdownException", (Exception,), {})),
        module("rclpy.node", Node=Node),
        module("rclpy.qos", qos_profile_sensor_data=SimpleNamespace(depth=5)),
        module("sensor_msgs"),
        module("sensor_msgs.msg", Image=Message, CameraInfo=Message, PointCloud2=Message),
    ):
        monkeypatch.setitem(sys.modules, one.__name__, one)
    assert ros.main() == 0
    assert [topic for topic, *_ in published] == ["panorama/image", "panorama/camera_info"] and stopped
    assert warnings == ["points: holds no points; name a scan that has some"]


def test_without_ros_it_is_one_line():
    done = subprocess.run([sys.executable, str(NODE)], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "source /opt/ros/DISTRO/setup.bash" in done.stderr
