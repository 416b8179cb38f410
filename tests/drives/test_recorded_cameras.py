"""Cameras of recordings: topics of images, CameraInfo, tf_static, times and the motion between them."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

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
from random_weights import street

pytest.importorskip("rosbags")
K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
SIZE = 64, 48
# Camera axes in the LiDAR's: x right is -y, y down is -z, z ahead is x
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MOUNT = (0.3, 0.1, -0.2, *Rotation.from_matrix(AHEAD).as_quat())
LATE_NS = 30_000_000  # images after scans


def picture(number: int) -> np.ndarray:
    """Return an image whose red says which it is."""
    pixels = np.random.default_rng(number).integers(30, 200, (*SIZE[::-1], 3), dtype=np.uint8)
    pixels[..., 0] = 20 * number
    return pixels


def drive(scans: int = 3, **info: object) -> list[Sent]:
    """Return scans 100 ms apart, images 30 ms after each, a camera and its mount."""
    sent = [
        transform(START_NS, "base", "velodyne", (0, 0, 0, 0, 0, 0, 1), "/tf_static"),
        transform(START_NS, "velodyne", "camera", MOUNT, "/tf_static"),
        camera_info(START_NS, K, SIZE, "/front/camera_info", **info),
    ]
    for number in range(scans):
        stamp_ns = START_NS + (number + 1) * STEP_NS
        sent.append(points(street(2000, seed=number), stamp_ns))
        sent.append(image(stamp_ns + LATE_NS, picture(number + 1), "/front/image_raw"))
    return sent


def read(path, options: CameraOptions | None = None) -> list[Reading]:
    reader = StreamReader(ReadingOptions(cameras=options or CameraOptions()))
    return list(reader(scan_sources([path], ReadOptions())))


@pytest.mark.parametrize("format", ["bag", "folder", "mcap", "mcap-plain"])
def test_each_scan_has_the_image_nearest_in_time(tmp_path, format):
    readings = read(write(tmp_path, format, drive()))
    assert len(readings) == 3
    for number, reading in enumerate(readings, 1):
        (camera,) = reading.cameras
        assert np.array_equal(camera.image, picture(number)) and camera.name == "/front/image_raw"
        assert camera.time_s == pytest.approx(0.03, abs=1e-6)
        T = camera.calibration.T_camera_lidar @ np.linalg.inv(np.eye(4))
        assert camera.calibration.centre == pytest.approx(_moved(reading, MOUNT[:3]), abs=1e-6)
        assert T[:3, :3] == pytest.approx(AHEAD.T @ _rotation(reading).T, abs=1e-6)
        assert isinstance(camera.calibration, Calibration) and pytest.approx(K) == camera.calibration.K
        (doubt,) = reading.camera_doubts
        assert "the motion between its images and the scans is not known" in doubt and "velodyne" in doubt


def _rotation(reading: Reading) -> np.ndarray:
    assert reading.interpretation is not None
    return np.asarray(reading.interpretation.rotation)


def _moved(reading: Reading, place) -> np.ndarray:
    """Return a place in the cloud's frame as a place in the scan's."""
    assert reading.interpretation is not None
    return _rotation(reading) @ (np.asarray(place) - reading.interpretation.viewpoint_m)


def test_motion_between_image_and_scan_is_taken_out(tmp_path):
    speed = 10.0  # m/s ahead
    poses = [odometry(START_NS + n * 10_000_000, (speed * n * 0.01, 0, 0, 0, 0, 0, 1)) for n in range(60)]
    readings = read(write(tmp_path, "mcap", sorted([*drive(), *poses], key=lambda sent: sent.stamp_ns)))
    for reading in readings:
        assert not reading.camera_doubts
        place = np.add(MOUNT[:3], (speed * 0.03, 0, 0))  # so far on when the image was taken
        assert reading.cameras[0].calibration.centre == pytest.approx(_moved(reading, place), abs=1e-3)


def test_images_are_decoded_whatever_their_encoding():
    colours = picture(3)

    class Message:
        data, encoding, height, width, step = colours.ravel(), "rgb8", SIZE[1], SIZE[0], 3 * SIZE[0]

    message = Message()
    assert np.array_equal(pixels(message, "/a"), colours)
    message.data, message.encoding = colours[..., ::-1].ravel(), "bgr8"
    assert np.array_equal(pixels(message, "/a"), colours)
    message.data, message.encoding, message.step = colours[..., 1].ravel(), "mono8", SIZE[0]
    assert np.array_equal(pixels(message, "/a"), np.repeat(colours[..., 1:2], 3, 2))
    flat = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    for pattern, encoding in (("RGGB", "bayer_rggb8"), ("GRBG", "bayer_grbg8")):
        for place, colour in enumerate(pattern):
            flat[place // 2 :: 2, place % 2 :: 2] = {"R": 200, "G": 100, "B": 50}[colour]
        message.data, message.encoding = flat.ravel(), encoding
        assert (pixels(message, "/a") == (200, 100, 50)).all()
    message.encoding = "16UC1"
    with pytest.raises(InputError, match="the encoding '16UC1', which is not read"):
        pixels(message, "/a")


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
