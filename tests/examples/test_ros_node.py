"""The ROS package, with messages of ROS's definitions and stand-ins for rclpy, tf2_ros and launch."""

from __future__ import annotations

import importlib
import io
import json
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ET
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from house_rules import ROOT
from lidar2pano import __version__
from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import cloud_of_message
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import Memory
from lidar2pano.pipeline import load
from lidar2pano.views import VIEWS
from miniature import street
from poses import fields_of, somewhere
from slow_definitions import place_slowly

PACKAGE = ROOT / "examples" / "ros"
STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = SimpleNamespace(sec=12, nanosec=500)
HEADER = SimpleNamespace(stamp=STAMP, frame_id="velodyne")
K = np.array([[70.0, 0, 60], [0, 70, 18], [0, 0, 1]])
AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
EYE = (0.4, -0.2, 0.3)


@pytest.fixture(scope="module", autouse=True)
def package():
    """The package on the path; gone again afterwards."""
    sys.path.insert(0, str(PACKAGE))
    yield
    sys.path.remove(str(PACKAGE))
    for name in [name for name in sys.modules if name.startswith("lidar2pano_ros")]:
        del sys.modules[name]


def part(name: str) -> ModuleType:
    return importlib.import_module(f"lidar2pano_ros.{name}")


def message_type(name: str, package: str = "sensor_msgs") -> type:
    """A class like rclpy's: made empty, and filled by assignment of its own fields only."""
    fields = tuple(field for field, _ in STORE.fielddefs[f"{package}/msg/{name}"][1])
    return type(name, (), {"__slots__": fields})


NEW = {name: message_type(name) for name in ("Image", "CompressedImage", "CameraInfo", "PointCloud2", "PointField")}


def encoded(message) -> bytes:
    """The message in ROS's own encoding: refused unless every field is there with its type."""

    def typed(value, name: str):
        if isinstance(value, SimpleNamespace) and hasattr(value, "sec"):
            return STORE.types["builtin_interfaces/msg/Time"](sec=value.sec, nanosec=value.nanosec)
        if isinstance(value, SimpleNamespace):
            return STORE.types["std_msgs/msg/Header"](stamp=typed(value.stamp, ""), frame_id=value.frame_id)
        if type(value) in NEW.values():
            return whole(value)
        if isinstance(value, list) and value and type(value[0]) in NEW.values():
            return [whole(one) for one in value]
        if name in ("d", "k", "r", "p"):
            return np.array(value, dtype=np.float64)
        return np.frombuffer(value, np.uint8) if name == "data" else value

    def whole(value):
        name = f"sensor_msgs/msg/{type(value).__name__}"
        defaults = {
            "binning_x": 0,
            "binning_y": 0,
            "roi": STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        }
        names = [field for field, _ in STORE.fielddefs[name][1]]
        return STORE.types[name](**{one: typed(getattr(value, one, defaults.get(one)), one) for one in names})

    return bytes(STORE.serialize_cdr(whole(message), f"sensor_msgs/msg/{type(message).__name__}"))


def decoded(message):
    return STORE.deserialize_cdr(encoded(message), f"sensor_msgs/msg/{type(message).__name__}")


def cloud(scan, **changed) -> SimpleNamespace:
    """A PointCloud2 of a scan."""
    rows = np.c_[scan.xyz, scan.remission].astype("<f4")
    fields = [SimpleNamespace(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyzi")]
    content = {"height": 1, "width": len(rows), "fields": fields, "is_bigendian": False, "point_step": 16}
    content |= {"row_step": 16 * len(rows), "data": rows.tobytes(), "is_dense": True, "header": HEADER}
    return SimpleNamespace(**content | changed)


def translator(pipeline, calibration=None, **options):
    return part("translator").CloudTranslator(pipeline, NEW, calibration, **options)


def array_of(image, kind=np.uint8, channels: int = 1) -> np.ndarray:
    shape = (image.height, image.width, channels) if channels > 1 else (image.height, image.width)
    return np.frombuffer(bytes(image.data), kind).reshape(shape)


def test_a_cloud_becomes_every_message(random_weights):
    pipeline, scan = load(random_weights, "cpu"), street(0, 3000)
    messages, doubts = translator(pipeline)(cloud(scan))
    wanted, topics = pipeline(scan), part("interface").TOPICS
    assert list(messages) == list(topics) and all("height" in doubt for doubt in doubts)
    assert {name: type(message).__name__ for name, message in messages.items()} == topics
    read = {name: decoded(message) for name, message in messages.items()}
    stamps = {(one.header.stamp.sec, one.header.stamp.nanosec, one.header.frame_id) for one in read.values()}
    assert stamps == {(12, 500, "velodyne")}
    rows, columns = wanted.colour.shape[:2]
    images = {name: read[name] for name in ("image", "labels", "classes", "depth")}
    assert {(one.height, one.width) for one in images.values()} == {(rows, columns)}
    assert [one.encoding for one in images.values()] == ["rgb8", "8UC1", "rgb8", "32FC1"]
    assert [one.step for one in images.values()] == [3 * columns, columns, 3 * columns, 4 * columns]
    assert np.array_equal(array_of(read["image"], channels=3), wanted.colour)
    assert np.array_equal(array_of(read["labels"]), wanted.segments)
    assert np.array_equal(array_of(read["classes"], channels=3), COMMON15.paint(wanted.segments))
    depth = array_of(read["depth"], np.float32)
    assert np.array_equal(np.nan_to_num(depth), wanted.depth_m) and np.isnan(depth[wanted.depth_m == 0]).all()
    with Image.open(io.BytesIO(bytes(read["image/compressed"].data))) as jpeg:
        assert jpeg.format == "JPEG" and np.abs(np.array(jpeg).astype(int) - wanted.colour).mean() < 10


def test_points_have_colours_and_labels(random_weights):
    pipeline, scan = load(random_weights, "cpu"), street(0, 3000)
    messages, _ = translator(pipeline)(cloud(scan), ["points"])
    assert list(messages) == ["points"], "the others are not made"
    points = decoded(messages["points"])
    assert [(one.name, one.offset, one.datatype, one.count) for one in points.fields] == [
        *(("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)),
        *(("intensity", 12, 7, 1), ("rgb", 16, 7, 1), ("label", 20, 4, 1)),
    ]
    panorama = pipeline(scan)
    again = cloud_of_message(points, "points")
    assert np.array_equal(again.xyz, scan.xyz) and np.array_equal(again.intensity, scan.remission)
    words = np.frombuffer(bytes(points.data), np.uint8).reshape(len(scan), points.point_step)
    assert np.array_equal(words[:, 18:15:-1], panorama.colour_points(scan).colour), "blue, green, red, 0 in memory"
    assert np.array_equal(words[:, 20:22].copy().view("<u2")[:, 0], SEMANTIC_KITTI.to_raw(panorama.labels))


def test_points_stay_in_the_frame_of_their_cloud(random_weights):
    """A cloud with y forward: the panorama is turned, its points are not, and r of the CameraInfo says how."""
    scan = street(0, 3000)
    turned = np.c_[-scan.xyz[:, 1], scan.xyz[:, 0], scan.xyz[:, 2]].astype(np.float32)
    messages, _ = translator(load(random_weights, "cpu"))(cloud(SimpleNamespace(xyz=turned, remission=scan.remission)))
    points = cloud_of_message(decoded(messages["points"]), "points")
    np.testing.assert_allclose(points.xyz, turned, atol=1e-5)
    info = decoded(messages["camera_info"])
    R = info.r.reshape(3, 3)
    np.testing.assert_allclose(R, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize("view", [VIEWS["panorama"], VIEWS["panorama"].scaled(1 / 8)])
@pytest.mark.parametrize("degrees", [0, 90])
def test_camera_info_tells_where_pixels_look(view, degrees):
    """A point lands in the pixel that d and r give for it: the definition of the projection is the judge."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T_scan_cloud = np.array([[cos, -sin, 0, 0.1 * sin], [sin, cos, 0, 0], [0, 0, 1, -0.2 * sin], [0, 0, 0, 1]])
    info = part("messages").fill_camera_info(NEW["CameraInfo"](), HEADER, view, T_scan_cloud)
    assert info.distortion_model == "cylindrical" and not any(info.k) and not any(info.p)
    fu, cu, fv, cv, *origin = info.d
    generator = np.random.default_rng(0)
    for _ in range(200):
        row, column = int(generator.integers(view.rows)), int(generator.integers(view.columns))
        azimuth, slope, flat = (cu - column) / fu, (cv - row) / fv, generator.uniform(3, 40)
        ray = np.array(info.r).reshape(3, 3).T @ [np.cos(azimuth), np.sin(azimuth), slope]
        point = T_scan_cloud @ [*(np.array(origin) + flat * ray), 1]
        assert place_slowly(point[:3], view) == (row, column)


def test_a_camera_of_its_own_is_a_pinhole(random_weights):
    calibration = Calibration(K=K, T_camera_lidar=AXES, size=(120, 36))
    pipeline = load(random_weights, "cpu")
    messages, _ = translator(pipeline, calibration)(cloud(street(0, 3000)))
    image, info = messages["image"], messages["camera_info"]
    assert (image.width, image.height) == (info.width, info.height) == (120, 36)
    assert info.distortion_model == "plumb_bob" and info.k == K.ravel().tolist() and info.p[:4] == [70, 0, 60, 0]
    view = pipeline.at(calibration)(street(0, 3000)).to_camera(calibration)
    assert np.array_equal(array_of(image, channels=3), view.colour)
    assert np.array_equal(array_of(messages["labels"]), view.segments) and "depth" not in messages


def test_a_cloud_without_points_is_an_error(random_weights):
    with pytest.raises(InputError, match="holds no points"):
        translator(load(random_weights, "cpu"))(cloud(street(0, 3000), width=0, data=b""))


def camera_messages(seconds: float = 0.0) -> tuple[SimpleNamespace, SimpleNamespace]:
    """A green image after the cloud, and its CameraInfo."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=500 + round(seconds * 1e9)), frame_id="eye")
    data = np.full((36, 120, 3), (10, 200, 30), np.uint8)
    image = SimpleNamespace(header=header, encoding="rgb8", height=36, width=120, step=360, data=data.ravel())
    info = SimpleNamespace(header=header, height=36, width=120, distortion_model="plumb_bob", d=np.zeros(5))
    return image, SimpleNamespace(**vars(info), k=K.ravel(), r=np.eye(3).ravel(), p=np.c_[K, np.zeros(3)].ravel())


def test_images_of_cameras_are_kept(random_weights):
    feed = part("translator").ImageFeed("/front/image_raw")
    asked = []

    def transform(target, target_stamp, source, source_stamp):
        asked.append((target, target_stamp.nanosec, source, source_stamp.nanosec))
        return AXES

    image, info = camera_messages(0.02)
    feed.describe(info)
    for late in (0.4, 0.02, 0.3):
        feed.add(camera_messages(late)[0])
    messages, doubts = translator(load(random_weights, "cpu"), feeds=[feed], transform=transform)(
        cloud(street(0, 3000)), ["image"]
    )
    assert asked == [("eye", 20000500, "velodyne", 500)], "the nearest image, by both times"
    assert (array_of(messages["image"], channels=3) == (10, 200, 30)).all(axis=2).any(), doubts


@pytest.mark.parametrize("fault", ["no CameraInfo has come on /front/camera_info", "it has no image near", "no link"])
def test_missing_cameras_are_left_out_with_a_word(random_weights, fault):
    feed = part("translator").ImageFeed("/front/image_raw")
    image, info = camera_messages(2.0 if "near" in fault else 0.0)
    feed.add(image)
    if "CameraInfo" not in fault:
        feed.describe(info)

    def transform(*_):
        raise InputError("no link")

    messages, doubts = translator(load(random_weights, "cpu"), feeds=[feed], transform=transform)(
        cloud(street(0, 3000)), ["image"]
    )
    assert messages and any(re.search(f"camera /front/image_raw is left out: {fault}", doubt) for doubt in doubts)


def test_poses_of_tf_smooth_over_time(random_weights):
    pipeline, scan = load(random_weights, "cpu"), street(0, 3000)
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 0.5
    following = iter(poses)
    smooth = translator(pipeline, transform=lambda *_: next(following), fixed_frame="odom")
    images = [array_of(smooth(cloud(scan), ["image"])[0]["image"], channels=3) for _ in poses]
    memory = Memory()
    for image, pose in zip(images, poses, strict=True):
        memory, panorama = pipeline.step(memory, scan, pose)
        assert np.array_equal(image, panorama.colour)


def module(name: str, **content) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(content)
    return made


def stand_in_tf() -> ModuleType:
    """tf2_ros, that knows the frame of one camera: of axes AXES, at EYE in the cloud's frame."""

    class Buffer:
        def lookup_transform(self, target, source, time, timeout):
            assert (source, time.sec, timeout.seconds) == ("velodyne", 12, 0.2)
            if target != "eye":
                raise tf2.TransformException(f"no frame {target}")
            rotation = SimpleNamespace(x=0.5, y=-0.5, z=0.5, w=0.5)  # AXES
            x, y, z = -AXES[:3, :3] @ EYE
            translation = SimpleNamespace(x=x, y=y, z=z)
            return SimpleNamespace(transform=SimpleNamespace(translation=translation, rotation=rotation))

    tf2 = module(
        "tf2_ros",
        Buffer=Buffer,
        TransformListener=lambda *_: object(),
        TransformException=type("TransformException", (Exception,), {}),
    )
    return tf2


class Ros:
    """Stand-ins for rclpy and tf2_ros: a node whose subscriptions are called by `spin`."""

    def __init__(self, monkeypatch, parameters: dict[str, str], sent: list, listened: set[str]) -> None:
        self.published, self.warnings, self.stopped, self.callbacks = [], [], [], {}
        self.types: dict[str, str] = {}
        outer = self

        class Node:
            def __init__(self, name: str) -> None:
                assert name == "lidar2pano"

            def declare_parameter(self, name: str, value: str) -> SimpleNamespace:
                return SimpleNamespace(value=parameters.get(name, value))

            def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
                outer.types[topic] = kind.__name__
                return SimpleNamespace(
                    publish=lambda message: outer.published.append((topic, message, depth)),
                    get_subscription_count=lambda: int(topic in listened),
                )

            def create_subscription(self, kind: type, topic: str, callback, quality, *, callback_group) -> None:
                assert callback_group is not None and quality.depth >= 1
                outer.callbacks[topic] = callback
                outer.types[topic] = kind.__name__

            def get_logger(self) -> SimpleNamespace:
                return SimpleNamespace(warning=lambda text, **_: outer.warnings.append(text))

        def spin(node: Node, executor) -> None:
            for topic, message in sent:
                self.callbacks[topic](message)
            raise KeyboardInterrupt

        group = SimpleNamespace
        for one in (
            module("rclpy", init=lambda args: None, spin=spin, try_shutdown=lambda: self.stopped.append(1)),
            module("rclpy.callback_groups", MutuallyExclusiveCallbackGroup=group, ReentrantCallbackGroup=group),
            module("rclpy.duration", Duration=SimpleNamespace),
            module(
                "rclpy.executors",
                ExternalShutdownException=type("ExternalShutdownException", (Exception,), {}),
                MultiThreadedExecutor=lambda num_threads: object(),
            ),
            module("rclpy.node", Node=Node),
            module(
                "rclpy.qos",
                qos_profile_sensor_data=SimpleNamespace(depth=5),
                QoSProfile=SimpleNamespace,
                ReliabilityPolicy=SimpleNamespace(BEST_EFFORT=2),
            ),
            module("rclpy.time", Time=SimpleNamespace(from_msg=lambda stamp: stamp)),
            module("sensor_msgs", msg=module("sensor_msgs.msg", **NEW)),
            stand_in_tf(),
        ):
            monkeypatch.setitem(sys.modules, one.__name__, one)


def test_the_node_publishes_what_is_listened_to(random_weights, monkeypatch):
    good, bad = cloud(street(0, 3000)), cloud(street(0, 3000), width=0, data=b"")
    listened = {"panorama/image", "panorama/camera_info", "panorama/points"}
    ros = Ros(
        monkeypatch, {"weights": str(random_weights), "device": "cpu"}, [("points", bad), ("points", good)], listened
    )
    assert part("node").main() == 0
    assert [topic for topic, *_ in ros.published] == ["panorama/image", "panorama/camera_info", "panorama/points"]
    assert ros.stopped and ros.warnings[0] == "points: holds no points; name a scan that has some"
    topics = {f"panorama/{name}": kind for name, kind in part("interface").TOPICS.items()}
    assert ros.types == topics | {"points": "PointCloud2"}


def test_nothing_is_painted_while_nobody_listens(random_weights, monkeypatch):
    bad = cloud(street(0, 3000), width=0, data=b"")
    ros = Ros(monkeypatch, {"weights": str(random_weights), "device": "cpu"}, [("points", bad)], set())
    assert part("node").main() == 0 and (ros.published, ros.warnings) == ([], [])


def test_the_node_takes_its_parameters(random_weights, monkeypatch):
    """The camera of a topic, at its place by tf; engine and look as they are called on the command line."""
    image, info = camera_messages()
    parameters = {"weights": str(random_weights), "device": "cpu", "engine": "torch", "look": "", "cameras": "/a/raw"}
    sent = [("/a/camera_info", info), ("/a/raw", image), ("points", cloud(street(0, 3000)))]
    ros = Ros(monkeypatch, parameters, sent, {"panorama/image", "panorama/camera_info"})
    assert part("node").main() == 0
    assert ros.types["/a/raw"] == "Image" and ros.types["/a/camera_info"] == "CameraInfo"
    (_, message, _), (_, info, _) = ros.published
    assert (array_of(message, channels=3) == (10, 200, 30)).all(axis=2).any(), ros.warnings
    assert info.d[4:] == pytest.approx(EYE), "the panorama's origin is the camera's place"


def test_the_node_publishes_taller_panoramas(random_weights, monkeypatch):
    parameters = {"weights": str(random_weights), "device": "cpu", "engine": "torch"}
    heights = []
    for elevation in ({}, {"elevation": "-16,24"}):
        ros = Ros(monkeypatch, parameters | elevation, [("points", cloud(street(0, 3000)))], {"panorama/image"})
        assert part("node").main() == 0
        heights.append(ros.published[0][1].height)
    assert heights[1] > heights[0]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("engine", "x", "no engine 'x'"),
        ("look", "x", "look"),
        ("weights", "x", "x"),
        ("calib", "x.txt", "x.txt"),
        ("elevation", "high", "elevation"),
        ("forward", "up", "axis"),
        ("sensor_height", "tall", "height"),
    ],
)
def test_a_parameter_of_no_use_is_one_line(random_weights, monkeypatch, capsys, name, value, said):
    Ros(monkeypatch, {"weights": str(random_weights), "device": "cpu"} | {name: value}, [], set())
    assert part("node").main() == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and err.startswith("lidar2pano_ros: ")


def test_a_quaternion_is_a_rotation():
    """Not of unit length."""
    x, y, z, *turn = fields_of(somewhere())
    place = SimpleNamespace(x=x, y=y, z=z)
    rotation = SimpleNamespace(**dict(zip("xyzw", np.multiply(turn, 1.5), strict=True)))
    T = part("node").matrix(SimpleNamespace(translation=place, rotation=rotation))
    np.testing.assert_allclose(T, somewhere(), atol=1e-9)


def test_without_ros_it_is_one_line():
    done = subprocess.run(
        [sys.executable, "-m", "lidar2pano_ros.node"], cwd=PACKAGE, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "source /opt/ros/DISTRO/setup.bash" in done.stderr


def test_the_package_installs_what_it_names(monkeypatch):
    """setup.py, setup.cfg and package.xml say the same, and every file that they name is there."""
    stated = {}
    monkeypatch.setitem(sys.modules, "setuptools", module("setuptools", setup=lambda **options: stated.update(options)))
    runpy.run_path(str(PACKAGE / "setup.py"))
    about = ET.parse(PACKAGE / "package.xml").getroot()
    assert about.get("format") == "3" and about.findtext("export/build_type") == "ament_python"
    assert (about.findtext("name"), about.findtext("version")) == (stated["name"], stated["version"])
    assert (stated["version"], about.findtext("license")) == (__version__, stated["license"])
    files = {name: folder for folder, names in stated["data_files"] for name in names}
    assert files[f"resource/{stated['name']}"] == "share/ament_index/resource_index/packages"
    assert files["package.xml"] == f"share/{stated['name']}" and all((PACKAGE / name).is_file() for name in files)
    program, _, place = stated["entry_points"]["console_scripts"][0].partition(" = ")
    name, _, function = place.partition(":")
    assert program == "panorama" and callable(getattr(importlib.import_module(name), function))
    assert (PACKAGE / "setup.cfg").read_text().count(f"$base/lib/{stated['name']}") == 2
    needed = {one.text for one in about.iter("exec_depend")}
    source = "".join(path.read_text() for path in [*PACKAGE.rglob("*.py")])
    imported = set(
        re.findall(r"^\s*(?:import|from) (rclpy|sensor_msgs|tf2_ros|launch_ros|launch)\b", source, re.MULTILINE)
    )
    assert imported == needed - {"python3-numpy", "python3-pil"}


def test_the_launch_file_starts_the_node(monkeypatch):
    def maker(kind: str):
        return lambda *values, **options: SimpleNamespace(kind=kind, values=values, **options)

    for name, kind in (
        ("launch", "LaunchDescription"),
        ("launch.actions", "DeclareLaunchArgument"),
        ("launch.substitutions", "LaunchConfiguration"),
        ("launch_ros", ""),
        ("launch_ros.actions", "Node"),
        ("launch_ros.parameter_descriptions", "ParameterValue"),
    ):
        monkeypatch.setitem(sys.modules, name, module(name, **{kind: maker(kind)} if kind else {}))
    made = runpy.run_path(str(PACKAGE / "launch" / "panorama.launch.py"))["generate_launch_description"]()
    *arguments, node = made.values[0]
    parameters = part("interface").PARAMETERS
    assert [one.values[0] for one in arguments] == ["points", *parameters]
    assert all(isinstance(one.default_value, str) and one.description for one in arguments)
    assert (node.package, node.executable) == ("lidar2pano_ros", "panorama")
    assert [(one, other.values[0]) for one, other in node.remappings] == [("points", "points")]
    (values,) = node.parameters
    assert {name: (value.values[0].values[0], value.value_type) for name, value in values.items()} == {
        name: (name, str) for name in parameters
    }


def test_the_layout_shows_topics_that_exist():
    layout = json.loads((PACKAGE / "foxglove" / "panorama.json").read_text())
    panels, topics = layout["configById"], part("interface").TOPICS
    images = {config["imageMode"]["imageTopic"] for name, config in panels.items() if name.startswith("Image!")}
    kinds = {topics[topic.removeprefix("/panorama/")] for topic in images}
    assert kinds <= {"Image", "CompressedImage"}
    for name, config in panels.items():
        for topic, settings in config.get("topics", {}).items():
            assert topics[topic.removeprefix("/panorama/")] == "PointCloud2" and settings["visible"], name
            assert settings["colorField"] in dict(part("messages").POINT)

    def leaves(place) -> list[str]:
        return [place] if isinstance(place, str) else leaves(place["first"]) + leaves(place["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def test_the_guide_lists_topics_and_parameters():
    text = (ROOT / "docs" / "guides" / "recordings.md").read_text(encoding="utf-8")
    assert [name for name in part("interface").TOPICS if f"| `panorama/{name}` |" not in text] == []
    assert [name for name in part("interface").PARAMETERS if f"| `{name}` |" not in text] == []
