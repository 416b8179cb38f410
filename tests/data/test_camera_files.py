"""Calibrations of cameras in the forms of other programs: each gives the same camera, and a bad one is one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.data.camera_files import read_camera_calibration
from lidar2pano.errors import InputError

SIZE = (640, 480)
K = np.array([[500.0, 0, 321.5], [0, 510, 239], [0, 0, 1]])
T = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
INVERSE = np.linalg.inv(T)
BROWN, FISHEYE = (-0.3, 0.1, 0.001, -0.002, 0.02), (0.05, -0.01, 0.004, -0.001)
RATIONAL = (0.31, -0.12, 0.001, -0.002, 0.02, 0.45, -0.08, 0.01)


def flow(values) -> str:
    return "[" + ", ".join(f"{value:.12g}" for value in np.ravel(values)) + "]"


def ros(model: str, coefficients, pose: str = f"T_camera_lidar: {flow(T)}\n") -> str:
    """As camera_calibration writes it."""
    return (
        "image_width: 640\nimage_height: 480\ncamera_name: narrow_stereo\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {flow(K)}\ndistortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {flow(coefficients)}\n"
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: {flow(np.eye(3))}\n"
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: {flow(K @ np.eye(3, 4))}\n" + pose
    )


def matrix(name: str, values) -> str:
    rows, columns = np.atleast_2d(values).shape
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {flow(values)}\n"


def kalibr(model: str, intrinsics, coefficients, camera: str = "pinhole") -> str:
    return (
        f"cam0:\n  camera_model: {camera}\n  intrinsics: {flow(intrinsics)}\n  distortion_model: {model}\n"
        f"  distortion_coeffs: {flow(coefficients)}\n  resolution: [640, 480]\n  rostopic: /cam0/image_raw\n"
        f"  T_cam_lidar:\n" + "".join(f"  - {flow(row)}\n" for row in T)
    )


PINHOLE = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
FORMS = {
    "ros plumb_bob": (ros("plumb_bob", BROWN), "brown", BROWN),
    "ros without distortion": (ros("plumb_bob", (0.0,) * 5), None, ()),
    "ros rational_polynomial": (ros("rational_polynomial", RATIONAL), "brown", RATIONAL),
    "ros equidistant": (ros("equidistant", FISHEYE), "fisheye", FISHEYE),
    "opencv": (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        + matrix("camera_matrix", K) + matrix("distortion_coefficients", BROWN) + matrix("T_lidar_camera", INVERSE),
        "brown",
        BROWN,
    ),
    "opencv fisheye": (
        "%YAML:1.0\n---\nfisheye_model: 1\n" + matrix("camera_matrix", K)
        + matrix("distortion_coefficients", FISHEYE) + matrix("T_camera_lidar", T),
        "fisheye",
        FISHEYE,
    ),
    "autoware": (
        "%YAML:1.0\n---\n" + matrix("CameraExtrinsicMat", INVERSE) + matrix("CameraMat", K) + matrix("DistCoeff", BROWN)
        + "ImageSize: [ 640, 480 ]\nReprojectionError: 0.\nDistModel: plumb_bob\n",
        "brown",
        BROWN,
    ),
    "kalibr radtan": (kalibr("radtan", PINHOLE, BROWN[:4]), "brown", BROWN[:4]),
    "kalibr equidistant": (kalibr("equidistant", PINHOLE, FISHEYE), "fisheye", FISHEYE),
    "kalibr omni": (kalibr("radtan", [0.9, *PINHOLE], BROWN[:4], "omni"), "mei", (0.9, *BROWN[:4])),
}  # fmt: skip


def write(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_each_form_gives_the_same_camera(tmp_path, form):
    text, model, distortion = FORMS[form]
    calibration = read_camera_calibration(write(tmp_path, text), Path("a.png"), SIZE)
    np.testing.assert_allclose(calibration.K, K)
    np.testing.assert_allclose(calibration.T_camera_lidar, T, atol=1e-9)
    assert calibration.size == SIZE
    if model is None:
        assert isinstance(calibration, Calibration)
    else:
        assert isinstance(calibration, LensCalibration)
        assert calibration.model == model
        np.testing.assert_allclose(calibration.distortion, distortion)


REGION = "roi: {x_offset: 40, y_offset: 20, height: 400, width: 480, do_rectify: false}\n"


@pytest.mark.parametrize(
    ("part", "size", "bins", "corner"),
    [
        ("binning_x: 2\nbinning_y: 4\n", (320, 120), (2, 4), (0, 0)),
        (REGION, (480, 400), (1, 1), (40, 20)),
        (REGION + "binning_x: 2\nbinning_y: 2\n", (240, 200), (2, 2), (40, 20)),
        ("binning_x: 0\nbinning_y: 0\nroi: {x_offset: 0, y_offset: 0, height: 0, width: 0}\n", SIZE, (1, 1), (0, 0)),
    ],
)
def test_images_of_a_part_of_the_camera(tmp_path, part, size, bins, corner):
    path = write(tmp_path, ros("plumb_bob", BROWN) + part)
    calibration = read_camera_calibration(path, Path("a.png"), size)
    assert calibration.size == size
    first = np.array([3, 5])  # the centre of a pixel of the part is that of the pixels it joins
    joined = [np.arange(count) + corner[axis] + count * first[axis] for axis, count in enumerate(bins)]
    ray = np.linalg.inv(K) @ [joined[0].mean(), joined[1].mean(), 1]
    np.testing.assert_allclose((calibration.K @ ray)[:2], first)
    np.testing.assert_allclose(read_camera_calibration(path, Path("a.png"), SIZE).K, K)  # the whole image
    with pytest.raises(InputError, match=f"is 100x100, but .* is for {size[0]}x{size[1]}; name its own image"):
        read_camera_calibration(path, Path("a.png"), (100, 100))


def test_json_of_data_sets_names_its_camera(tmp_path):
    pandaset = {"fx": 500, "fy": 510, "cx": 321.5, "cy": 239}
    other = {"K": {"fx": 1, "fy": 1, "cx": 1, "cy": 1}, "size": [2, 2], "cam_from_lidar": np.eye(4).tolist()}
    cameras = {"back_camera": other, "front_camera": {"K": pandaset, "size": list(SIZE), "cam_from_lidar": T.tolist()}}
    path = write(tmp_path, json.dumps({"cameras": cameras}), "000000.json")
    calibrations = [read_camera_calibration(path, Path("front_camera/000000.jpg"), SIZE)]
    image = {"img_path": "x.jpg", "cam2img": K.tolist(), "lidar2cam": T.tolist()}
    path = write(tmp_path, json.dumps({"data_list": [{"images": {"CAM_FRONT": image}}]}), "info.json")
    calibrations.append(read_camera_calibration(path, Path("samples/x.jpg"), SIZE))
    for calibration in calibrations:
        np.testing.assert_allclose(calibration.K, K)
        np.testing.assert_allclose(calibration.T_camera_lidar, T)
    with pytest.raises(InputError, match=r"info.json: names no image 'y.jpg'"):
        read_camera_calibration(path, Path("y.jpg"), SIZE)


def test_a_pose_may_be_in_a_second_file(tmp_path):
    camera = write(tmp_path, ros("plumb_bob", BROWN, pose=""))
    pose = write(tmp_path, f"T_lidar_camera: {flow(INVERSE)}\n", "pose.yaml")
    calibration = read_camera_calibration(camera, Path("a.png"), SIZE, pose)
    np.testing.assert_allclose(calibration.T_camera_lidar, T, atol=1e-9)


def test_kittis_camera_is_that_of_the_images_folder(tmp_path):
    P = {number: K @ np.array([[1, 0, 0, -0.1 * number], [0, 1, 0, 0], [0, 0, 1, 0]]) for number in (2, 3)}
    rows = [f"P{number}: {' '.join(map(str, P[number].ravel()))}\n" for number in P]
    path = write(tmp_path, "".join(rows) + f"Tr: {' '.join(map(str, T[:3].ravel()))}\n", "calib.txt")
    for folder, offset in (("image_2", -0.2), ("image_3", -0.3), ("pictures", -0.2)):
        calibration = read_camera_calibration(path, Path(folder, "000000.png"), SIZE)
        assert calibration.T_camera_lidar[0, 3] == pytest.approx(T[0, 3] + offset)
    with pytest.raises(InputError, match="is 300x480, but .* has its principal point outside"):
        read_camera_calibration(path, Path("image_2/a.png"), (300, 480))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ros("plumb_bob", BROWN, pose=""), r"has no pose .*add T_camera_lidar: \[16 numbers\]"),
        (ros("plumb_bob", BROWN).replace("640", "1280"), "a.png: is 640x480, but .* is for 1280x480"),
        (ros("plumb_bob", BROWN).replace("image_width: 640\n", "").replace("321.5", "900"), "principal point outside"),
        (ros("scaramuzza", BROWN), "distortion model 'scaramuzza' with 5 coefficients is not known"),
        (ros("plumb_bob", RATIONAL), "'plumb_bob' with 8 coefficients"),
        (ros("plumb_bob", BROWN).replace("510", "-510"), "no camera matrix"),
        (ros("plumb_bob", BROWN).replace("510", ".nan"), "no finite numbers"),
        (ros("plumb_bob", BROWN, f"T_camera_lidar: {flow(2 * T)}\n"), "holds no rotation"),
        (ros("plumb_bob", BROWN, "T_camera_lidar: [1, 2]\n"), "must hold 16 numbers"),
        ("just: words\n", "has no camera"),
        ("- a\n- b\n", "holds no calibration"),
        ("", "holds no calibration"),
        ("a: [1, 2\n", "is no YAML"),
        ("a: &x [1]\nb: [*x, *x]\n", "is no YAML .*aliases"),
        ("a: !!python/object/apply:os.system [ls]\n", "is no YAML"),
        (
            kalibr("radtan", PINHOLE, BROWN[:4]) + kalibr("radtan", PINHOLE, BROWN[:4]).replace("cam0", "cam1"),
            "cam0, cam1",
        ),
    ],
)
def test_a_bad_calibration_is_one_line(tmp_path, text, says):
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=says) as error:
        read_camera_calibration(path, tmp_path / "a.png", SIZE)
    assert "\n" not in str(error.value)


def test_a_calibration_that_is_missing_is_one_line(tmp_path):
    with pytest.raises(InputError, match="cannot be read .* name another calibration of a camera"):
        read_camera_calibration(tmp_path / "x.yaml", Path("a.png"), SIZE)
