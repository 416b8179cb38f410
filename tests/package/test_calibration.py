"""Every form of KITTI's calibrations gives the same camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidar2pano.calibration import has_camera, read_calib, read_camera0
from lidar2pano.errors import InputError

P2 = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])


def rotation(*radians: float) -> np.ndarray:
    """A rotation about x, y, z in turn."""
    x, y, z = ((np.cos(angle), np.sin(angle)) for angle in radians)
    about_x = np.array([[1, 0, 0], [0, x[0], -x[1]], [0, x[1], x[0]]])
    about_y = np.array([[y[0], 0, y[1]], [0, 1, 0], [-y[1], 0, y[0]]])
    about_z = np.array([[z[0], -z[1], 0], [z[1], z[0], 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


R0 = rotation(0.01, -0.008, 0.005)
VELO = np.eye(4)
VELO[:3, :3] = rotation(0.01, 0.02, 0.015) @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
VELO[:3, 3] = 0.003, -0.07, -0.27
TR = np.block([[R0, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]]) @ VELO


def row(name: str, values: np.ndarray, colon: str = ":") -> str:
    return f"{name}{colon} {' '.join(f'{value:.12e}' for value in np.ravel(values))}\n".lstrip()


FORMS = {
    "odometry": {"calib.txt": row("P0", P2) + row("P2", P2) + row("Tr", TR[:3])},
    "object": {
        "000008.txt": row("P0", P2 * 2) + row("P2", P2) + row("R0_rect", R0) + row("Tr_velo_to_cam", VELO[:3])
        + row("Tr_imu_to_velo", VELO[:3]) + "\n"
    },
    "tracking": {
        "0001.txt": row("P2", P2) + row("R_rect", R0, "") + row("Tr_velo_cam", VELO[:3], "")
        + row("Tr_imu_velo", VELO[:3], "")
    },
    "raw": {
        "calib_cam_to_cam.txt": "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
        + row("S_02", np.array([1392, 512])) + row("K_02", P2[:, :3]) + row("R_rect_00", R0) + row("P_rect_02", P2),
        "calib_velo_to_cam.txt": "calib_time: 15-Mar-2012 11:37:16\n" + row("R", VELO[:3, :3]) + row("T", VELO[:3, 3])
        + row("delta_f", np.zeros(2)),
    },
    "KITTI-360": {
        "perspective.txt": row("R_rect_00", R0) + row("P_rect_00", P2),
        "calib_cam_to_velo.txt": row("", np.linalg.inv(VELO)[:3], ""),
    },
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_each_form_gives_the_same_camera(tmp_path: Path, form):
    for name, text in FORMS[form].items():
        (tmp_path / name).write_text(text)
    places = [tmp_path / name for name in FORMS[form]]
    places += [] if len(places) == 1 and form != "odometry" else [tmp_path]
    for place in places:
        calibration = read_calib(place)
        T = TR.copy()
        T[:3, 3] += np.linalg.solve(P2[:, :3], P2[:, 3])
        np.testing.assert_allclose(calibration.T_camera_lidar, T, atol=1e-9)
        np.testing.assert_allclose(calibration.K, P2[:, :3])
        np.testing.assert_allclose(read_camera0(place), TR, atol=1e-9)
        assert has_camera(place)


def test_a_raw_drives_calibration_is_that_of_its_day(tmp_path: Path):
    for name, text in FORMS["raw"].items():
        (tmp_path / name).write_text(text)
    drive = tmp_path / "2011_09_26_drive_0001_sync"
    drive.mkdir()
    np.testing.assert_allclose(read_camera0(drive), TR, atol=1e-9)


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({}, "holds no calib.txt or calib_cam_to_cam.txt"),
        ({"calib_velo_to_cam.txt": row("R", R0)}, "calib_cam_to_cam.txt: cannot be read as calib.txt"),
        ({"calib.txt": row("P2", P2) + row("R0_rect", R0)}, "has no row Tr_velo_to_cam:"),
        (
            {"calib.txt": row("P2", P2) + row("R0_rect", R0 * 2) + row("Tr_velo_to_cam", VELO[:3])},
            "row R0_rect: holds no",
        ),
        ({"calib.txt": row("P2", P2) + row("R0_rect", P2) + row("Tr_velo_to_cam", VELO[:3])}, "9 finite numbers"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, files, says):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        read_calib(tmp_path / next(iter(files)) if "calib.txt" not in files and files else tmp_path)
