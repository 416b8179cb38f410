"""Cameras of recordings: topics of images, CameraInfo, tf_static, times and the motion between them."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.drives.camera_choice import CameraOptions
from lidar2pano.drives.reading import Reading, ReadingOptions, StreamReader, scan_sources
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.description import Topic
from lidar2pano.recordings.recorded_images import COMPRESSED_IMAGE, IMAGE, camera_topics, pixels
from miniature_recordings import (
    CAMERA_INFO,
    START_NS,
    STEP_NS,
    Sent,
    camera_info,
    compressed_image,
    image,
    odometry,
    points,
    transform,
    write,
)
from poses import fields_of, pose_of, somewhere
from random_weights import street

pytest.importorskip("rosbags")
pytestmark = pytest.mark.usefixtures("in_this_process")
K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
SIZE = 64, 48
# Camera axes in the LiDAR's: x right is -y, y down is -z, z ahead is x
T_VELODYNE_CAMERA = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, -0.2], [0, 0, 0, 1]])
T_BASE_VELODYNE = pose_of(35, 4, -3, (1.2, 0.3, 1.8))
LATE_NS, RECEIVED_NS = 30_000_000, 15_000_000  # images after scans; recorded after their stamps


def picture(number: int) -> np.ndarray:
    """Return an image whose red says which it is."""
    pixels = np.random.default_rng(number).integers(30, 200, (*SIZE[::-1], 3), dtype=np.uint8)
    pixels[..., 0] = 20 * number
    return pixels


def drive(scans: int = 3, **info: object) -> list[Sent]:
    """Return scans 100 ms apart, images 30 ms after each, a camera and its mount."""
    sent = [
        transform(START_NS, "base", "velodyne", fields_of(T_BASE_VELODYNE), "/tf_static"),
        transform(START_NS, "base", "camera", fields_of(T_BASE_VELODYNE @ T_VELODYNE_CAMERA), "/tf_static"),
        camera_info(START_NS, K, SIZE, "/front/camera_info", **info),
    ]
    for number in range(scans):
        stamp_ns = START_NS + (number + 1) * STEP_NS
        sent.append(points(street(2000, seed=number), stamp_ns))
        picked = image(stamp_ns + LATE_NS, picture(number + 1), "/front/image_raw")
        sent.append(picked._replace(stamp_ns=picked.stamp_ns + RECEIVED_NS))
    return sent


def read(path, options: CameraOptions | None = None) -> list[Reading]:
    reader = StreamReader(ReadingOptions(cameras=options or CameraOptions()))
    return list(reader(scan_sources([path], ReadOptions())))


@pytest.mark.parametrize("format", ["bag", pytest.param("mcap-plain", marks=pytest.mark.child)])
def test_each_scan_has_the_image_nearest_in_time(tmp_path, format):
    readings = read(write(tmp_path, format, drive()))
    assert len(readings) == 3
    for number, reading in enumerate(readings, 1):
        (camera,) = reading.cameras
        assert np.array_equal(camera.image, picture(number)) and camera.name == "/front/image_raw"
        assert camera.time_s == pytest.approx(0.03, abs=1e-6)
        assert T_cloud_camera(reading) == pytest.approx(T_VELODYNE_CAMERA, abs=1e-6)
        assert isinstance(camera.calibration, Calibration) and pytest.approx(K) == camera.calibration.K
        (doubt,) = reading.camera_doubts
        assert "the motion between its images and the scans is not known" in doubt and "velodyne" in doubt


def T_cloud_camera(reading: Reading) -> np.ndarray:
    """Return the pose (4, 4) of a scan's camera in the frame of its cloud."""
    assert reading.interpretation is not None
    T_camera_scan = reading.cameras[0].calibration.T_camera_lidar
    T_scan_cloud = np.eye(4)
    T_scan_cloud[:3, :3] = reading.interpretation.rotation
    T_scan_cloud[:3, 3] = -T_scan_cloud[:3, :3] @ reading.interpretation.viewpoint_m
    return np.linalg.inv(T_camera_scan @ T_scan_cloud)


def test_motion_between_image_and_scan_is_taken_out(tmp_path):
    """Of a sensor on a bend: the image is taken three steps of 10 ms after the scan."""
    step = pose_of(0.5, 0.1, 0, (0.1, 0, 0))
    T = [somewhere() @ np.linalg.matrix_power(step, number) for number in range(60)]
    poses = [odometry(START_NS + number * 10_000_000, fields_of(pose)) for number, pose in enumerate(T)]
    readings = read(write(tmp_path, "mcap", sorted([*drive(), *poses], key=lambda sent: sent.stamp_ns)))
    for reading in readings:
        assert not reading.camera_doubts
        three_steps_on = step @ step @ step @ T_VELODYNE_CAMERA
        assert T_cloud_camera(reading) == pytest.approx(three_steps_on, abs=1e-4)
        assert T_cloud_camera(reading)[0, 3] == pytest.approx(0.6, abs=0.02), "ahead"


def message(encoding: str, values: np.ndarray) -> SimpleNamespace:
    """Return an Image of values (h, w, ...), each of whose rows ends with three bytes more."""
    rows = np.pad(values.reshape(len(values), -1), ((0, 0), (0, 3)), constant_values=99)
    size = {"height": len(values), "width": values.shape[1], "step": rows.shape[1]}
    return SimpleNamespace(encoding=encoding, data=rows.ravel(), **size)


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [("rgb8", "RGB"), ("bgr8", "BGR"), ("rgba8", "RGBA"), ("bgra8", "BGRA"), ("8UC3", "BGR")],
)
def test_colours_are_read_in_the_order_of_their_encoding(encoding, channels):
    colours = picture(3)
    planes = dict(zip("RGB", np.moveaxis(colours, 2, 0), strict=True)) | {"A": np.full(SIZE[::-1], 255, np.uint8)}
    values = np.stack([planes[channel] for channel in channels], axis=2)
    assert np.array_equal(pixels(message(encoding, values), "/a"), colours)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_images_are_grey_in_colours(encoding):
    grey = picture(3)[..., 1]
    assert np.array_equal(pixels(message(encoding, grey), "/a"), np.stack([grey] * 3, axis=2))


@pytest.mark.parametrize(
    ("encoding", "pattern"),
    [("bayer_rggb8", "RGGB"), ("bayer_bggr8", "BGGR"), ("bayer_gbrg8", "GBRG"), ("bayer_grbg8", "GRBG")],
)
def test_bayer_patterns_are_read_by_their_names(encoding, pattern):
    values = np.zeros(SIZE[::-1], np.uint8)
    for place, colour in enumerate(pattern):
        values[place // 2 :: 2, place % 2 :: 2] = {"R": 200, "G": 100, "B": 50}[colour]
    assert (pixels(message(encoding, values), "/a") == (200, 100, 50)).all()


def test_other_encodings_are_refused():
    with pytest.raises(InputError, match="the encoding '16UC1', which is not read"):
        pixels(message("16UC1", picture(3)), "/a")


def test_compressed_images_rectified_ones_and_lenses(tmp_path):
    stream = io.BytesIO()
    Image.fromarray(picture(5)).save(stream, "PNG")
    stamp_ns = START_NS + STEP_NS
    base = [one for one in drive(1, d=np.array([0.1, 0.01, 0, 0, 0])) if one.type not in (IMAGE,)]
    raw = compressed_image(stamp_ns, stream.getvalue(), "/front/image_raw/compressed")
    (reading,) = read(write(tmp_path, "folder", [*base, raw]))
    assert np.array_equal(reading.cameras[0].image, picture(5)) and not reading.camera_doubts
    lens = reading.cameras[0].calibration
    assert isinstance(lens, LensCalibration) and lens.model == "brown" and lens.distortion[:2] == (0.1, 0.01)
    rectified = compressed_image(stamp_ns, stream.getvalue(), "/front/image_rect/compressed")
    (reading,) = read(write(tmp_path, "folder", [*base, rectified], stem="rectified"))
    assert isinstance(reading.cameras[0].calibration, Calibration)
    fisheye = [one for one in drive(1, d=np.full(4, 0.01), distortion_model="equidistant") if one.type != IMAGE]
    (reading,) = read(write(tmp_path, "folder", [*fisheye, raw], stem="fisheye"))
    assert isinstance(lens := reading.cameras[0].calibration, LensCalibration) and lens.model == "fisheye"


def topic(name: str, type: str = IMAGE, count: int = 5) -> Topic:
    return Topic(name=name, type=type, count=count)


def test_a_camera_is_the_best_topic_beside_its_info():
    topics = [
        topic("/front/camera_info", CAMERA_INFO),
        topic("/front/image_mono"),
        topic("/front/image_color"),
        topic("/front/image_color/compressed", COMPRESSED_IMAGE),
        topic("/front/depth/image"),
        topic("/back/camera_info", CAMERA_INFO),
        topic("/back/image/compressed", COMPRESSED_IMAGE),
        topic("/lonely/image"),
        topic("/empty/camera_info", CAMERA_INFO),
        topic("/empty/image", count=0),
    ]
    found = camera_topics("a.bag", topics, ())
    assert [(each.name, info.name) for each, info in found] == [
        ("/back/image/compressed", "/back/camera_info"),
        ("/front/image_color", "/front/camera_info"),
    ]
    named = camera_topics("a.bag", topics, ("front/image_mono", "/lonely/image"))
    assert [(each.name, info and info.name) for each, info in named] == [
        ("/front/image_mono", "/front/camera_info"),
        ("/lonely/image", None),
    ]
    with pytest.raises(InputError, match=r"a.bag: --cameras: has no images on topic '/front/imag'; did you mean"):
        camera_topics("a.bag", topics, ("/front/imag",))


@pytest.mark.parametrize(
    ("leave_out", "options", "doubt"),
    [
        (lambda one: one.topic == "/tf_static", CameraOptions(), "tf_static does not link its frame 'camera'"),
        (lambda one: one.type == CAMERA_INFO, CameraOptions(topics=("/front/image_raw",)), "no sensor_msgs/CameraInfo"),
        (lambda one: one.type == IMAGE and one.stamp_ns > START_NS + 1.5 * STEP_NS, CameraOptions(), None),
    ],
)
def test_a_camera_that_lacks_something_is_said_and_the_scans_go_on(tmp_path, leave_out, options, doubt):
    sent = [one for one in drive() if not leave_out(one)]
    readings = read(write(tmp_path, "mcap", sent), options)
    assert len(readings) == 3 and not any(reading.error for reading in readings)
    if doubt:
        assert all(doubt in reading.camera_doubts[0] and not reading.cameras for reading in readings)
    else:
        assert [round(reading.cameras[0].time_s, 3) for reading in readings] == [0.03, -0.07, -0.17]


def test_a_recording_without_cameras_and_unknown_topics(tmp_path):
    sent = [one for one in drive() if one.type not in (IMAGE, CAMERA_INFO)]
    path = write(tmp_path, "mcap", sent)
    assert all(not reading.cameras and not reading.camera_doubts for reading in read(path))
    with pytest.raises(InputError, match=r"--cameras: has no images on topic '/front'; it has none"):
        read(path, CameraOptions(topics=("/front",)))
    scan = tmp_path / "a.bin"
    np.random.default_rng(0).uniform(2, 9, (2000, 4)).astype("<f4").tofile(scan)
    with pytest.raises(InputError, match=r"--cameras /front: .*a.bin is no recording; leave it out"):
        read(scan, CameraOptions(topics=("/front",)))


@pytest.mark.parametrize("format", ["bag", "mcap"])
def test_the_matrix_of_a_part_of_the_camera(tmp_path, format):
    to_full = np.array([[2, 0, 6.5], [0, 2, 4.5], [0, 0, 1]])  # cut at (6, 4), 2 x 2 pixels joined
    part = {"x_offset": 6, "y_offset": 4, "width": 2 * SIZE[0], "height": 2 * SIZE[1]}
    info = {"width": 2 * SIZE[0] + 20, "height": 2 * SIZE[1] + 9, "binning_x": 2, "binning_y": 2, "roi": part}
    readings = read(write(tmp_path, format, drive(1, k=(to_full @ K).ravel(), **info)))
    assert pytest.approx(K) == readings[0].cameras[0].calibration.K
