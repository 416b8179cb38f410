"""KITTI-360 as it is downloaded: its points, cameras, poses, labels, splits and panoramas, and what is damaged."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data.clips import camera_image, distances_m
from lidar2pano.data.frames import IGNORE, Frame, SampleIndex
from lidar2pano.data.kitti360 import LABELS, Kitti360Frame, fisheye_calibrations
from lidar2pano.data.layouts import frames
from lidar2pano.data.panorama_crops import PanoramaDataset
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.projection import directions, project
from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS
from lidar2pano.views import VIEWS
from miniature_layouts import (
    LABELLED,
    SEQUENCE,
    kitti360_camera,
    kitti360_fisheyes,
    kitti360_labels,
    kitti360_pose,
    write_kitti360_layout,
)
from miniature_surround import distances, painting, sweep
from slow_definitions import camera_pixel_slowly

QUARTER = VIEWS["panorama"].scaled(0.25)
PARTS = {"scan", "point_labels", "calibration", "image", "camera_labels", "pose", "panorama"}


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_kitti360_layout(tmp_path_factory.mktemp("layout") / "kitti-360")


@pytest.fixture
def copied(root, tmp_path) -> Path:
    copytree(root, tmp_path / "set")
    return tmp_path / "set"


def known(frame: Frame) -> set[str]:
    return {name for name in PARTS if getattr(frame, name) is not None}


def test_a_frame_names_every_file_of_its_parts(root):
    named = {path for frame in frames(root, "all") for path in frame.source_files}
    files = {path for path in root.rglob("*") if path.suffix in (".bin", ".png", ".txt", ".yaml")}
    assert files - named == set(root.rglob("*_frames.txt"))


def test_what_a_frame_has(root):
    found = frames(root, "all")
    assert frames(root, SEQUENCE).names == found.names
    assert found.names == tuple(f"{SEQUENCE}/{number:010d}" for number in (2, 3, 7, 11))
    everything = {"scan", "calibration", "image", "camera_labels", "pose"}
    assert [known(frame) for frame in found] == [everything, everything, everything - {"pose"}, {"scan", "pose"}]
    assert found[0].root == root and found[0].scan.name == found[0].name


def test_the_scan_and_its_pose(root):
    """poses.txt has poses of the vehicle; a frame's is the LiDAR's."""
    frame = frames(root, "all")[1]
    assert np.abs(frame.scan.xyz - sweep(64, 400)[0]).max() < 1e-5
    assert frame.scan.remission == pytest.approx(0.3)
    assert frame.pose == pytest.approx(kitti360_pose(3), abs=1e-6)


def test_a_pose_of_nan_is_not_known(copied):
    (copied / POSES).write_text(f"2 {' '.join(['nan'] * 12)}\n3 1 0 0 0 0 1 0 0 0 0 1 0\n")
    first, second = (frames(copied, "all")[index] for index in range(2))
    assert first.pose is None and second.pose is not None


def test_a_point_of_the_world_is_where_the_rectified_camera_has_it(root):
    frame, mount = frames(root, "all")[0], kitti360_camera()
    calibration, image = frame.calibration, frame.image
    assert calibration is not None and image is not None and frame.camera_labels is not None
    assert calibration.T_camera_lidar == pytest.approx(mount.T_camera_lidar, abs=1e-8)
    assert pytest.approx(mount.K) == calibration.K and calibration.size == mount.size
    points, ground = sweep(64, 400)
    x, y, z = calibration.T_camera_lidar[:3, :3] @ points.T + calibration.T_camera_lidar[:3, 3:]
    with np.errstate(all="ignore"):
        u, v = calibration.K[0, 0] * x / z + calibration.K[0, 2], calibration.K[1, 1] * y / z + calibration.K[1, 2]
    inside = (z > 0.5) & (u > 0) & (u < 479) & (v > 10) & (v < 299)
    assert inside.sum() > 1000
    at = v[inside].round().astype(int), u[inside].round().astype(int)
    assert np.abs(image[at] - painting(points[inside])).mean() < 2
    named = np.array(CITYSCAPES.classes)[frame.camera_labels[at]]
    assert (named == np.where(ground[inside], "road", "building")).mean() > 0.99


def test_labels_become_train_ids(root):
    """KITTI-360's label ids are Cityscapes', and eleven more."""
    labels = frames(root, "all")[0].camera_labels
    assert labels is not None
    ids = kitti360_labels(kitti360_camera())
    expected = {"road": "road", "building": "building", "garage": "building", "smallpole": "pole"}
    for number, name in LABELLED.items():
        found = np.unique(labels[ids == number])
        assert found.tolist() == [CITYSCAPES.id_of(expected[name]) if name in expected else IGNORE]
    for name in ("car", "sky", "traffic light", "bicycle"):
        assert LABELS[CITYSCAPES_IDS.id_of(name)] == CITYSCAPES.id_of(name)
    assert LABELS[35] == CITYSCAPES.id_of("fence") and LABELS[CITYSCAPES_IDS.id_of("parking")] == IGNORE


def test_train_and_val_are_the_lists_of_labelled_images(root, copied):
    names = frames(root, "all").names
    assert frames(root, "train").names == names[:2], "the list also has an image without a scan"
    assert frames(root, "val").names == names[2:3]
    for path in (copied / "data_2d_semantics" / "train").glob("*.txt"):
        path.unlink()
    with pytest.raises(InputError, match=r"_train_frames.txt: is missing, .* or write splits.json"):
        frames(copied, "train")
    (copied / "splits.json").write_text(json.dumps({"val": [names[3]], "more": [f"{SEQUENCE}/0000000099"]}))
    assert frames(copied, "val").names == names[3:] and frames(copied, "all").names == names
    with pytest.raises(InputError, match=r"scan 0000000099.bin of split 'more' is missing"):
        frames(copied, "more")
    with pytest.raises(InputError, match=f"no split 'holiday'; there is {SEQUENCE}, all, train, val"):
        frames(root, "holiday")


def test_windows_need_no_labels_of_points_but_samples_do(root):
    dataset = PanoramaDataset(root, ("val",), VIEWS["panorama"].scaled(1 / 8), 64)
    window = dataset.window(0)
    assert window.scan.label is None and (window.camera_labels != IGNORE).any()
    with pytest.raises(InputError, match=r"has no labels of single scans; name a segmenter"):
        dataset[0]


def test_scans_without_labels_always_have_a_segmenters(root, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "weights").write_bytes(b"1")
    dataset = PanoramaDataset(root, ("val",), VIEWS["panorama"].scaled(1 / 8), 64)
    dataset.predict(lambda scan: torch.full((len(scan),), 9), tmp_path / "weights")
    for at in (0, *(SampleIndex(0, seed) for seed in range(6))):
        segments = dataset[at].segments
        assert (segments == 9).any() and set(segments.unique().tolist()) <= {0, 9}


@pytest.mark.parametrize(
    ("number", "part", "message"),
    [
        (0, "point_labels", "KITTI-360 has no labels of single scans; name a segmenter"),
        (3, "image", r"data_rect/0000000011.png: is missing; download the perspective images"),
        (3, "calibration", r"data_rect/0000000011.png: is missing, and so are its labels"),
        (3, "camera_labels", r"semantic/0000000011.png: is missing; choose the split train or val"),
        (2, "pose", r"poses.txt: has no line for frame 7"),
        (0, "panorama", r"image_02/data_rgb/0000000002.png: is missing; download the perspective and the fisheye"),
        (3, "panorama", r"image_00/data_rect/0000000011.png: is missing; download the perspective and the fisheye"),
    ],
)
def test_what_is_required_and_missing_is_named(root, number, part, message):
    with pytest.raises(InputError, match=message):
        frames(root, "all")[number].require(part)


def rewritten(root: Path, name: str, old: str, new: str) -> None:
    path = root / "calibration" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def image(root: Path, pattern: str, picked: Image.Image) -> None:
    for path in root.glob(pattern):
        picked.save(path)


POSES = f"data_poses/{SEQUENCE}/poses.txt"
DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no calibration": (lambda r: (r / "calibration/perspective.txt").unlink(), r"perspective.txt: cannot be read"),
    "no mount": (
        lambda r: (r / "calibration/calib_cam_to_velo.txt").unlink(),
        r"calib_cam_to_velo.txt: cannot be read",
    ),
    "binary": (
        lambda r: (r / "calibration/perspective.txt").write_bytes(b"\xff\xfe"),
        r"cannot be read .*\(not text\)",
    ),
    "half a row": (
        lambda r: rewritten(r, "perspective.txt", "P_rect_00: ", "P_rect_00: 1 "),
        "P_rect_00: must hold",
    ),
    "no row": (lambda r: rewritten(r, "perspective.txt", "R_rect_00", "R_rect_01"), "has no row Tr:.* R_rect_00:"),
    "words": (lambda r: rewritten(r, "perspective.txt", "480 300", "480 px"), "S_rect_00: holds something that is no"),
    "no size": (lambda r: rewritten(r, "perspective.txt", "480 300", "480 0"), "S_rect_00: is no size of an image"),
    "no camera matrix": (
        lambda r: rewritten(r, "perspective.txt", "P_rect_00: 300.", "P_rect_00: -300."),
        "is no camera matrix",
    ),
    "no rotation": (
        lambda r: (r / "calibration/calib_cam_to_velo.txt").write_text("2 0 0 0 0 1 0 0 0 0 1 0"),
        r"calib_cam_to_velo.txt: row 1: holds no rotation",
    ),
    "no mount of the camera": (
        lambda r: rewritten(r, "calib_cam_to_pose.txt", "image_00:", "image_09:"),
        "calib_cam_to_pose.txt: has no row image_00:",
    ),
    "poses without numbers": (
        lambda r: (r / POSES).write_text("1 0 0 0 0 1 0 0 0 0 1 0\n"),
        r"poses.txt: its lines must hold 13 finite numbers each; write a frame's number",
    ),
    "no poses": (lambda r: (r / POSES).write_text(""), r"poses.txt: its lines must hold 13 finite numbers each"),
    "poses in words": (lambda r: (r / POSES).write_text("a b\n"), r"poses.txt: cannot be read as poses"),
    "poses that are none": (lambda r: (r / POSES).write_text("2" + " 0" * 12), r"poses.txt: line 1 holds no rotation"),
    "half a scan": (
        lambda r: [path.write_bytes(path.read_bytes()[:-3]) for path in r.glob("data_3d_raw/*/*/data/*.bin")],
        r"0000000002.bin: \d+ bytes are no whole number of points",
    ),
    "another size": (
        lambda r: image(r, "data_2d_raw/*/*/*/*.png", Image.new("RGB", (10, 9))),
        r"data_rect/0000000002.png: is 10x9, but perspective.txt says 480x300",
    ),
    "another size of labels": (
        lambda r: image(r, "data_2d_semantics/*/*/*/*/*.png", Image.new("L", (10, 9))),
        r"semantic/0000000002.png: is 10x9, but perspective.txt says 480x300",
    ),
    "ids of another data set": (
        lambda r: image(r, "data_2d_semantics/*/*/*/*/*.png", Image.new("L", (480, 300), 45)),
        r"semantic/0000000002.png: holds no label ids of KITTI-360 \(0 to 44\)",
    ),
    "labels in colours": (
        lambda r: image(r, "data_2d_semantics/*/*/*/*/*.png", Image.new("RGB", (480, 300))),
        r"semantic/0000000002.png: holds no label ids of KITTI-360",
    ),
    "a torn image": (
        lambda r: [path.write_bytes(path.read_bytes()[:900]) for path in r.glob("data_2d_raw/*/*/*/*.png")],
        r"data_rect/0000000002.png: is no readable image",
    ),
    "no scans": (
        lambda r: [path.unlink() for path in r.glob("data_3d_raw/*/*/data/*.bin")],
        r"split 'all' has no scan",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_said_in_one_line(copied, damage):
    harm, message = DAMAGES[damage]
    harm(copied)
    with pytest.raises(InputError, match=message) as caught:
        known(frames(copied, "all")[0])
    assert str(copied) in str(caught.value) and "\n" not in str(caught.value)


# --- the fisheye cameras --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def around_root(tmp_path_factory) -> Path:
    return write_kitti360_layout(tmp_path_factory.mktemp("layout") / "kitti-360", fisheyes=True)


@pytest.fixture
def around_copied(around_root, tmp_path) -> Path:
    copytree(around_root, tmp_path / "set")
    return tmp_path / "set"


def fisheye_file(root: Path, name: str, frame: int = 2) -> Path:
    return root / "data_2d_raw" / SEQUENCE / name / "data_rgb" / f"{frame:010d}.png"


def first_around(root: Path) -> Kitti360Frame:
    frame = frames(root, "all", QUARTER)[0]
    assert isinstance(frame, Kitti360Frame)
    return frame


def test_with_fisheye_cameras_frames_have_a_panorama_without_labels(root, around_root):
    found = list(frames(around_root, "all", QUARTER))
    assert ["panorama" in known(frame) for frame in found] == [True, True, True, False]
    frame = first_around(around_root)
    assert frame.panorama_labels is None and "cameras" not in vars(frame), "nothing is stitched to say so"
    panorama, calibration = frame.panorama, frame.calibration
    assert panorama is not None and calibration is not None and panorama is frame.panorama_for(QUARTER)
    assert panorama.view == at_camera(QUARTER, calibration) and panorama.image.shape == (96, 1152, 3)
    assert panorama.labels is None
    expected = project(frame.scan, panorama.view).channels[0].numpy()
    assert panorama.depth_m is not None and np.array_equal(panorama.depth_m, expected) and (expected > 0).any()
    without = frames(root, "all", QUARTER)[0]
    for part in ("scan", "image", "camera_labels"):
        one, other = getattr(frame, part), getattr(without, part)
        assert np.array_equal(one.xyz if part == "scan" else one, other.xyz if part == "scan" else other)


def test_points_on_the_vehicle_are_no_part_of_the_panorama(around_root, around_copied):
    for path in (around_copied / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data").iterdir():
        near = np.array([[0.6, 0.2, -0.1, 0.5], [-0.5, -0.3, 0.0, 0.5]], dtype="<f4")
        path.write_bytes(path.read_bytes() + near.tobytes())
    one, other = (first_around(root).panorama for root in (around_root, around_copied))
    assert one is not None and other is not None
    assert np.array_equal(one.image, other.image) and np.array_equal(one.depth_m, other.depth_m)


def test_the_lenses_are_as_the_files_have_them(around_root):
    for name, mount in kitti360_fisheyes().items():
        lens = fisheye_calibrations(around_root)[name]
        assert pytest.approx(mount.K) == lens.K and lens.distortion == pytest.approx(mount.distortion)
        assert lens.T_camera_lidar == pytest.approx(mount.T_camera_lidar, abs=1e-8)
        assert (lens.model, lens.size, lens.reach_deg) == ("mei", (350, 350), 92.5)


def test_the_painted_place_is_composed_again_from_the_three_cameras(around_root):
    panorama = first_around(around_root).panorama
    assert panorama is not None
    rays, origin = directions(panorama.view).double().numpy(), np.array(panorama.view.origin)
    places = origin + distances(origin, rays)[..., None] * rays
    off = np.abs(panorama.image - painting(places)).max(-1)
    assert panorama.valid.mean() > 0.97 and (panorama.image[~panorama.valid] == 0).all()
    assert off[panorama.valid].mean() < 2
    assert np.percentile(off[panorama.valid], 99) < 12, "what lies between the rings, and the rim of the image circles"


@pytest.mark.parametrize(
    ("azimuth_deg", "slope"), [(75, 0.1), (90, -0.15), (140, 0.0), (-60, 0.05), (-120, -0.1), (-168, 0.1)]
)
def test_a_spot_comes_back_in_its_direction(around_copied, azimuth_deg, slope):
    """White spots are put into the fisheye images by the slow definition of the lens, then looked for."""
    azimuth = np.radians(azimuth_deg)
    view = at_camera(QUARTER, kitti360_camera())
    ray, origin = np.array([np.cos(azimuth), np.sin(azimuth), slope]), np.array(view.origin)
    ray /= np.linalg.norm(ray)
    place = origin + distances(origin, ray) * ray
    for name, lens in kitti360_fisheyes().items():
        in_camera = lens.T_camera_lidar[:3] @ np.append(place, 1)
        image = np.zeros((350, 350, 3), np.uint8)
        if (azimuth_deg > 0) == (name == "image_02"):
            u, v = camera_pixel_slowly(in_camera, lens)
            rows, columns = np.mgrid[0:350, 0:350]
            image[:] = (255 * np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / 8))[..., None]
        Image.fromarray(image).save(fisheye_file(around_copied, name))
    Image.new("RGB", (480, 300)).save(around_copied / f"data_2d_raw/{SEQUENCE}/image_00/data_rect/0000000002.png")
    panorama = first_around(around_copied).panorama
    assert panorama is not None
    weight = panorama.image[..., 0].astype(float) * (panorama.image[..., 0] > 60)
    assert weight.max() > 200
    row, column = ((weight * at).sum() / weight.sum() + 0.5 for at in np.mgrid[0:96, 0:1152])
    assert column == pytest.approx((180 - azimuth_deg) / 360 * 1152, abs=1.2)
    assert row == pytest.approx((view.up - slope) / (view.up - view.down) * 96, abs=1.2)


def test_the_left_camera_is_left(around_copied):
    for name, colour in (("image_02", (200, 0, 0)), ("image_03", (0, 200, 0))):
        Image.new("RGB", (350, 350), colour).save(fisheye_file(around_copied, name))
    panorama = first_around(around_copied).panorama
    assert panorama is not None
    left, right = panorama.image[44, 288], panorama.image[44, 864]  # 90 degrees aside
    assert left.tolist() == [200, 0, 0] and right.tolist() == [0, 200, 0]
    assert panorama.image[44, 576].tolist() not in ([200, 0, 0], [0, 200, 0]), "image_00 looks ahead"


@pytest.mark.parametrize("absent", ["image_02.png", "image_03.png", "image_02.yaml", "image_03.yaml", "image_00.png"])
def test_without_one_of_the_files_there_is_no_panorama(around_copied, absent):
    name = absent[:8]
    path = around_copied / "calibration" / absent if absent.endswith(".yaml") else fisheye_file(around_copied, name)
    if name == "image_00":
        path = around_copied / f"data_2d_raw/{SEQUENCE}/image_00/data_rect/0000000002.png"
    path.unlink()
    frame = first_around(around_copied)
    assert frame.panorama is None and frame.panorama_for(QUARTER) is None and frame.camera_labels is not None
    with pytest.raises(InputError, match=f"{path}: is missing; download the perspective and the fisheye"):
        frame.require("panorama")


LENS_DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "another model": (
        lambda r: rewritten(r, "image_02.yaml", "MEI", "PINHOLE"),
        r"calibration/image_02.yaml: says no 'model_type: MEI'; take the file from the data set",
    ),
    "no text": (lambda r: (r / "calibration/image_02.yaml").write_bytes(b"\xff\xfe"), r"is no YAML \(not text\)"),
    "an empty file": (
        lambda r: (r / "calibration/image_03.yaml").write_text(""),
        r"image_03.yaml: says no 'model_type",
    ),
    "no key": (
        lambda r: rewritten(r, "image_03.yaml", "xi:", "zeta:"),
        r"03.yaml: xi, .* must be finite numbers",
    ),
    "words": (
        lambda r: rewritten(r, "image_02.yaml", "k1: ", "k1: some "),
        r"image_02.yaml: xi, k1, .* must be finite numbers",
    ),
    "nan": (
        lambda r: rewritten(r, "image_02.yaml", "v0: ", "v0: nan\n#"),
        r"image_02.yaml: .* v0, .* must be finite numbers",
    ),
    "no lens": (lambda r: rewritten(r, "image_02.yaml", "k2: ", "k2: 9e9\n#"), r"xi, k1, k2, p1 and p2 are no lens's"),
    "a mirror inside out": (
        lambda r: rewritten(r, "image_02.yaml", "xi: ", "xi: -"),
        r"xi, k1, k2, p1 and p2 are no lens's",
    ),
    "no camera": (
        lambda r: rewritten(r, "image_02.yaml", "gamma1: ", "gamma1: -"),
        r"image_02.yaml: K: is no camera matrix",
    ),
    "no size": (lambda r: rewritten(r, "image_02.yaml", "height: 350", "height: 0"), r"are no size of an image"),
    "half a pixel": (
        lambda r: rewritten(r, "image_02.yaml", "height: 350", "height: 350.5"),
        r"are no size of an image",
    ),
    "no mount": (
        lambda r: rewritten(r, "calib_cam_to_pose.txt", "image_03:", "image_09:"),
        r"calib_cam_to_pose.txt: has no row image_03:",
    ),
    "no rotation": (
        lambda r: rewritten(r, "calib_cam_to_pose.txt", "image_03:", "image_03: 1 0 0 0 1 0 0 0 1 1 0 0\n#"),
        r"calib_cam_to_pose.txt: row image_03: holds no rotation",
    ),
    "another size": (
        lambda r: Image.new("RGB", (10, 9)).save(fisheye_file(r, "image_03")),
        r"data_rgb/0000000002.png: is 10x9, but image_03.yaml says 350x350; take both from the data set",
    ),
    "a torn image": (
        lambda r: fisheye_file(r, "image_02").write_bytes(fisheye_file(r, "image_02").read_bytes()[:900]),
        r"data_rgb/0000000002.png: is no readable image",
    ),
}


@pytest.mark.parametrize("damage", LENS_DAMAGES)
def test_what_is_damaged_about_a_fisheye_is_said_in_one_line(around_copied, damage):
    harm, message = LENS_DAMAGES[damage]
    harm(around_copied)
    frame = first_around(around_copied)
    assert frame.scan is not None and frame.camera_labels is not None, "the rest is of use"
    with pytest.raises(InputError, match=message) as caught:
        frame.panorama  # noqa: B018
    assert str(around_copied) in str(caught.value) and "\n" not in str(caught.value)


def test_a_calibration_that_was_changed_is_read_again(around_copied):
    path = around_copied / "calibration" / "image_02.yaml"
    assert fisheye_calibrations(around_copied)["image_02"].distortion[0] == pytest.approx(2.2134)
    path.write_text(path.read_text().replace("xi: 2.21", "xi: 2.31"))
    os.utime(path, ns=(1, 1))
    assert fisheye_calibrations(around_copied)["image_02"].distortion[0] == pytest.approx(2.3134)


def test_labels_are_taken_from_the_camera_although_images_are_all_around(root, around_root):
    view = VIEWS["panorama"].scaled(1 / 8)
    kept = [PanoramaDataset(one, ("val",), view, 64).window(0) for one in (root, around_root)]
    assert kept[0].view == kept[1].view and kept[1].view.columns < view.columns
    for part in ("camera_labels", "depth_m"):
        assert torch.equal(getattr(kept[0], part), getattr(kept[1], part))


def test_flow_in_the_camera_takes_the_scans_completed_depths(root, around_root):
    """Those of the stitched panorama are sparse."""
    found = [frames(one, "val", QUARTER)[0] for one in (root, around_root)]
    distance = [distances_m(frame, camera_image(frame, 0.25)) for frame in found]
    assert torch.equal(*distance) and distance[0].isfinite().float().mean() > 0.5


def test_without_labels_anywhere_it_is_said_what_to_choose(around_copied):
    for path in (around_copied / "data_2d_semantics").rglob("*.png"):
        path.unlink()
    dataset = PanoramaDataset(around_copied, ("all",), VIEWS["panorama"].scaled(1 / 8), 64)
    with pytest.raises(InputError, match="KITTI-360 has no labels all around; choose the split train or val"):
        dataset.window(0)


def test_a_list_of_something_else_is_refused(copied):
    path = copied / "data_2d_semantics" / "train" / "2013_05_28_drive_val_frames.txt"
    path.write_text("a.png b.png\n")
    with pytest.raises(InputError, match=r"val_frames.txt: must have lines .../SEQUENCE/image_00/data_rect/N.png"):
        frames(copied, "val")
