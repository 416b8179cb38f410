"""The cameras of a scan: named, or found beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.drives.camera_choice import CameraOptions, NamedCamera, parse_camera
from lidar2pano.drives.cameras import cameras_of, seconds_after
from lidar2pano.drives.reading import ReadingOptions, StreamReader, scan_sources
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.stitching import look, points_in
from miniature_layouts import write_nuscenes_layout
from miniature_surround import SIZE, camera_view, painting, six, sweep, write_nuscenes, write_pandaset
from poses import pose_of

pytestmark = pytest.mark.usefixtures("in_this_process")
AHEAD = next(iter(six().values()))
NAMES = list(six())


def row(name: str, values) -> str:
    return f"{name}: {' '.join(f'{value:.12e}' for value in np.ravel(values))}\n"


def write_scan(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    points, _ = sweep()
    np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4").tofile(path)
    return path


def write_photo(path: Path, calibration=AHEAD) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(camera_view(calibration)).save(path)
    return path


def calib_text(calibration=AHEAD) -> str:
    return row("P2", calibration.K @ np.eye(3, 4)) + row("Tr", calibration.T_camera_lidar[:3])


def odometry(root: Path, sequence: str = "00") -> Path:
    folder = root / "sequences" / sequence
    write_photo(folder / "image_2" / "000003.png")
    (folder / "calib.txt").write_text(calib_text())
    return write_scan(folder / "velodyne" / "000003.bin")


def raw_drive(root: Path) -> Path:
    drive = root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    write_photo(drive / "image_02" / "data" / "0000000003.png")
    identity = row("R_rect_00", np.eye(3))
    (drive.parent / "calib_cam_to_cam.txt").write_text(identity + row("P_rect_02", AHEAD.K @ np.eye(3, 4)))
    T = AHEAD.T_camera_lidar
    (drive.parent / "calib_velo_to_cam.txt").write_text(row("R", T[:3, :3]) + row("T", T[:3, 3]))
    for folder, second in (("image_02", "25.9"), ("velodyne_points", "25.951")):
        (drive / folder).mkdir(exist_ok=True)
        (drive / folder / "timestamps.txt").write_text(f"2011-09-26 13:02:{second}\n" * 4)
    return write_scan(drive / "velodyne_points" / "data" / "0000000003.bin")


def object_benchmark(root: Path) -> Path:
    write_photo(root / "training" / "image_2" / "000003.png")
    return write_benchmark(root, "000003") and write_scan(root / "training" / "velodyne" / "000003.bin")


def tracking_benchmark(root: Path) -> Path:
    write_photo(root / "training" / "image_02" / "0007" / "000003.png")
    return write_benchmark(root, "0007") and write_scan(root / "training" / "velodyne" / "0007" / "000003.bin")


def write_benchmark(root: Path, name: str) -> Path:
    path = root / "training" / "calib" / f"{name}.txt"
    path.parent.mkdir(parents=True)
    text = calib_text().replace("Tr:", "Tr_velo_to_cam:") + row("R0_rect", np.eye(3))
    path.write_text(text)
    return path


def pandaset(root: Path) -> Path:
    return write_pandaset(root) / "sequences/002/velodyne/000000.bin"


def nuscenes_info(root: Path) -> Path:
    return write_nuscenes(root) / "LIDAR_TOP.pcd.bin"


def read(scan_file: Path, **options):
    """The reading of a scan with its cameras."""
    reader = StreamReader(ReadingOptions(cameras=CameraOptions(**options)))
    (reading,) = reader(scan_sources([scan_file], ReadOptions()))
    assert reading.error is None
    return reading


@pytest.mark.parametrize(
    ("layout", "names"),
    [
        (odometry, ["image_2"]),
        (raw_drive, ["image_02"]),
        (object_benchmark, ["image_2"]),
        (tracking_benchmark, ["image_02"]),
        (pandaset, NAMES),
        (nuscenes_info, None),
    ],
)
def test_cameras_are_found_beside_a_scan_in_its_frame(tmp_path, layout, names):
    reading = read(layout(tmp_path))
    assert not reading.camera_doubts
    if names:
        assert [one.name for one in reading.cameras] == names
    painted, _ = sweep(*((32, 1000) if layout is nuscenes_info else ()))
    points = torch.from_numpy(reading.scan.xyz.T)
    for found, calibration in zip(reading.cameras, six().values(), strict=False):
        np.testing.assert_allclose(found.calibration.K, calibration.K)
        sight = look(found, points_in(found, points), 700.0)
        assert len(sight.surface) > 1000
        off = np.abs(found.colours(sight).T.numpy() - painting(painted[sight.surface.numpy()]))
        assert np.median(off) < 2, "points have the colours of their places, whatever axes their file has"
    if layout is raw_drive:
        assert reading.cameras[0].time_s == pytest.approx(-0.051, abs=1e-4)
    assert (reading.calibration is not None) == (len(reading.cameras) == 1), "an only camera is the viewpoint"


def test_nuscenes_own_layout_has_six_cameras(tmp_path):
    root = write_nuscenes_layout(tmp_path)
    scan_file = sorted((root / "samples/LIDAR_TOP").iterdir())[0]
    found = cameras_of(scan_file, "", CameraOptions(), np.eye(4))
    assert len(found.cameras) + len(found.doubts) == 6
    assert {one.name for one in found.cameras} <= {
        "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT"
    }  # fmt: skip


def test_sequences_that_share_a_scan_share_their_cameras(tmp_path):
    first = odometry(tmp_path, "town-01")
    second = odometry(tmp_path, "town-02")
    assert [one.name for one in read(first).cameras] == ["image_2"], "equal scans may be of different moments"
    second.unlink()
    second.hardlink_to(first)
    assert [one.name for one in read(first).cameras] == ["image_2", "town-02/image_2"]


def test_a_camera_that_fails_leaves_the_others(tmp_path):
    scan_file = pandaset(tmp_path)
    sequence = scan_file.parents[1]
    (sequence / "left_camera/000000.jpg").write_bytes(b"no image")
    (sequence / "back_camera/000000.jpg").unlink()
    Image.new("RGB", (99, 55)).save(sequence / "right_camera/000000.jpg")
    reading = read(scan_file)
    assert [one.name for one in reading.cameras] == ["front_camera", "front_left_camera", "front_right_camera"]
    assert len(reading.camera_doubts) == 3
    for name, says in (("left", "no readable image"), ("back", "is missing"), ("right", "is not of the size")):
        (line,) = (doubt for doubt in reading.camera_doubts if doubt.startswith(f"camera {name}_camera is left out: "))
        assert says in line and "\n" not in line


def test_a_broken_list_of_cameras_is_a_doubt_too(tmp_path):
    scan_file = nuscenes_info(tmp_path)
    content = json.loads((tmp_path / "info.json").read_text())
    content["data_list"][0]["images"] = "lost"
    (tmp_path / "info.json").write_text(json.dumps(content))
    reading = read(scan_file)
    assert not reading.cameras
    (line,) = reading.camera_doubts
    assert "has no 'images'" in line and line.startswith("cameras are left out: ")


def test_named_cameras_take_the_place_of_found_ones(tmp_path):
    scan_file = odometry(tmp_path)
    image = write_photo(tmp_path / "other" / "photo.png")
    calib = tmp_path / "other" / "calib.txt"
    calib.write_text(calib_text())
    named = parse_camera(f"{image}:{calib}")
    assert named == NamedCamera(image, calib)
    assert [one.name for one in read(scan_file, named=(named,)).cameras] == ["other/photo.png"]
    assert read(scan_file, named=(named,), viewpoint=False).calibration is None
    assert not read(scan_file, auto=False).cameras


def test_a_folder_of_images_has_one_for_each_scan(tmp_path):
    scan_file = odometry(tmp_path)
    folder = scan_file.parents[1]
    named = parse_camera(f"{folder / 'image_2'}:{folder / 'calib.txt'}")
    reading = read(scan_file, named=(named,))
    assert [one.name for one in reading.cameras] == ["image_2"]
    other = write_scan(scan_file.with_name("000004.bin"))
    (line,) = read(other, named=(named,)).camera_doubts
    assert "000004.png: is missing" in line


def test_masks_are_one_for_all_or_one_each(tmp_path):
    scan_file = pandaset(tmp_path)
    mask = np.zeros((*SIZE[::-1],), dtype=np.uint8)
    mask[250:] = 255
    path = tmp_path / "mask.png"
    Image.fromarray(mask).save(path)
    reading = read(scan_file, masks=(path,))
    assert all((one.ego_mask[250:]).all() for one in reading.cameras)
    assert not reading.cameras[0].ego_mask[:250].any()
    with pytest.raises(InputError, match="2 masks for 6 cameras"):
        cameras_of(scan_file, "000000", CameraOptions(masks=(path, path)), np.eye(4))
    Image.new("L", (9, 9)).save(path)
    reading = read(scan_file, masks=(path,))
    assert not reading.cameras and "is 9x9, the image 480x300" in reading.camera_doubts[0]


def test_paths_with_colons_are_named(tmp_path):
    (tmp_path / "12:30").mkdir()
    image, calib = tmp_path / "12:30" / "a:b.png", tmp_path / "12:30" / "c.txt"
    for path in (image, calib):
        path.write_text("")
    assert parse_camera(f"{image}:{calib}") == NamedCamera(image, calib)
    assert parse_camera(f"{image}:{calib}:{calib}") == NamedCamera(image, calib, calib)


@pytest.mark.parametrize("text", ["", "a.png", "a.png:b.txt", ":", "::::::"])
def test_other_texts_are_refused_in_one_line(text):
    with pytest.raises(InputError, match=r"^--camera .*IMAGE:CALIB") as error:
        parse_camera(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("scan", "image", "seconds"),
    [
        ("a__LIDAR__1532402927647951.pcd.bin", "a__CAM__1532402927612460.jpg", -0.035491),
        ("315969904359876000.feather", "315969904449927217.jpg", 0.090051217),
        ("000001.bin", "000001.png", None),
        ("000001.bin", "1532402927612460.jpg", None),
    ],
)
def test_names_tell_times(tmp_path, scan, image, seconds):
    expected = None if seconds is None else pytest.approx(seconds, abs=1e-6)
    assert seconds_after(tmp_path / scan, tmp_path / image) == expected


def test_calibrations_move_with_the_frame(tmp_path):
    scan_file = odometry(tmp_path)
    T_scan_file = np.eye(4)
    T_scan_file[:3, 3] = 1, 2, 3
    moved = cameras_of(scan_file, "000003", CameraOptions(), T_scan_file).cameras[0].calibration
    assert moved.centre == pytest.approx(np.add(AHEAD.centre, (1, 2, 3)))
    assert replace(moved, T_camera_lidar=AHEAD.T_camera_lidar).centre == pytest.approx(AHEAD.centre)


def write_oxts(drive: Path, pose_at: Callable[[float], Sequence[float]], T_velo_imu: np.ndarray) -> None:
    """Poses of a drive by their time: metres to the east, north and up; roll, pitch and yaw in radians."""
    (drive / "oxts" / "data").mkdir(parents=True)
    stamps = [25.8, 25.85, 25.9, 25.951]
    for number, stamp in enumerate(stamps):
        east, north, up, *angles = pose_at(stamp)
        latitude = 49 + np.degrees(north / 6378137.0)  # by the earth's radius
        longitude = 8 + np.degrees(east / 6378137.0 / np.cos(np.radians(49)))
        numbers = [latitude, longitude, up, *angles, *[0] * 24]
        (drive / "oxts" / "data" / f"{number:010d}.txt").write_text(" ".join(map(repr, map(float, numbers))) + "\n")
    (drive / "oxts" / "timestamps.txt").write_text("".join(f"2011-09-26 13:02:{stamp}\n" for stamp in stamps))
    mount = row("R", T_velo_imu[:3, :3]) + row("T", T_velo_imu[:3, 3])
    (drive.parent / "calib_imu_to_velo.txt").write_text(mount)


def straight_on(stamp: float) -> tuple[float, ...]:
    """10 m/s in a direction 0.3 rad left of the east."""
    along = 10 * (stamp - 25.951)
    return along * np.cos(0.3), along * np.sin(0.3), 110, 0, 0, 0.3


def test_motion_between_an_image_and_its_scan_is_taken_out(tmp_path):
    scan = raw_drive(tmp_path)
    still = cameras_of(scan, "", CameraOptions(), np.eye(4)).cameras[0].calibration
    write_oxts(scan.parents[2], straight_on, pose_of(0, 0, 0, (0.5, 0, 1)))
    moved = cameras_of(scan, "", CameraOptions(), np.eye(4)).cameras[0].calibration
    assert moved.centre == pytest.approx(np.subtract(still.centre, (0.51, 0, 0)), abs=1e-3)  # 0.051 s before the scan
    np.testing.assert_allclose(moved.T_camera_lidar[:3, :3], still.T_camera_lidar[:3, :3], atol=1e-9)


def test_motion_of_an_imu_that_turns_and_leans_is_taken_out(tmp_path):
    """The image is of 25.9 s, the scan of 25.951 s; roll, pitch and yaw are those of the data set's devkit."""
    scan, T_velo_imu = raw_drive(tmp_path), pose_of(2, -1, 0.5, (0.8, -0.3, 1))

    def numbers(stamp: float) -> tuple[float, ...]:
        roll_deg, pitch_deg, yaw_deg = 3 + 8 * (stamp - 25.9), 5 - 10 * (stamp - 25.9), 70 + 40 * (stamp - 25.9)
        return 9 * (stamp - 25.9), 12 * (stamp - 25.9), 110, *np.radians((roll_deg, pitch_deg, yaw_deg))

    write_oxts(scan.parents[2], numbers, T_velo_imu)
    found = cameras_of(scan, "", CameraOptions(), np.eye(4)).cameras[0].calibration
    T_velo_camera = np.linalg.inv(AHEAD.T_camera_lidar)
    world = []
    for stamp in (25.9, 25.951):
        *place, roll, pitch, yaw = numbers(stamp)
        T_world_imu = pose_of(*np.degrees((yaw, pitch, roll)), place)
        world.append(T_world_imu @ np.linalg.inv(T_velo_imu))
    expected = np.linalg.inv(world[1]) @ world[0] @ T_velo_camera
    np.testing.assert_allclose(np.linalg.inv(found.T_camera_lidar), expected, atol=1e-5)


def test_damaged_poses_leave_the_cameras(tmp_path):
    scan = raw_drive(tmp_path)
    write_oxts(scan.parents[2], straight_on, np.eye(4))
    (scan.parents[2] / "oxts" / "data" / "0000000002.txt").write_text("49 8 110\n")
    found = cameras_of(scan, "", CameraOptions(), np.eye(4))
    assert len(found.cameras) == 1
    assert "motion between images and scan stays in: " in found.doubts[0] and "must hold 30 numbers" in found.doubts[0]
