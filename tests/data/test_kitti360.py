"""KITTI-360 as it is downloaded: where its points, camera and poses are, its labels, its splits, and what is damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data.frames import IGNORE, Frame, SampleIndex, frames
from lidar2pano.data.kitti360 import LABELS
from lidar2pano.data.panorama_crops import PanoramaDataset
from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS
from lidar2pano.views import VIEWS
from miniature_layouts import LABELLED, SEQUENCE, kitti360_camera, kitti360_labels, kitti360_pose, write_kitti360_layout
from miniature_surround import painting, sweep

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


def test_what_a_frame_has(root):
    found = frames(root, "all")
    assert found.layout == "kitti-360" and frames(root, SEQUENCE).names == found.names
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
        (0, "panorama", "this data set has no panorama"),
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
    "no mount": (lambda r: (r / "calibration/calib_cam_to_velo.txt").unlink(), r"calib_cam_to_velo.txt: cannot be read"),
    "binary": (lambda r: (r / "calibration/perspective.txt").write_bytes(b"\xff\xfe"), r"cannot be read \(not text\)"),
    "half a row": (lambda r: rewritten(r, "perspective.txt", "P_rect_00: ", "P_rect_00: 1 "), "P_rect_00 must hold 12"),
    "no row": (lambda r: rewritten(r, "perspective.txt", "R_rect_00", "R_rect_01"), "R_rect_00 must hold 9 finite"),
    "words": (lambda r: rewritten(r, "perspective.txt", "480 300", "480 px"), "S_rect_00 must hold 2 finite numbers"),
    "no size": (lambda r: rewritten(r, "perspective.txt", "480 300", "480 0"), "S_rect_00: is no size of an image"),
    "no camera matrix": (
        lambda r: rewritten(r, "perspective.txt", "P_rect_00: 300.", "P_rect_00: -300."),
        "'P_rect_00' is no camera matrix",
    ),
    "no rotation": (
        lambda r: (r / "calibration/calib_cam_to_velo.txt").write_text("2 0 0 0 0 1 0 0 0 0 1 0"),
        r"calib_cam_to_velo.txt: 'the file' holds no rotation",
    ),
    "no mount of the camera": (
        lambda r: rewritten(r, "calib_cam_to_pose.txt", "image_00:", "image_09:"),
        "calib_cam_to_pose.txt: image_00 must hold 12 finite numbers",
    ),
    "poses without numbers": (
        lambda r: (r / POSES).write_text("1 0 0 0 0 1 0 0 0 0 1 0\n"),
        r"poses.txt: its lines must hold 13 finite numbers each; write a frame's number",
    ),
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


@pytest.mark.filterwarnings("ignore:loadtxt")
@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_said_in_one_line(copied, damage):
    harm, message = DAMAGES[damage]
    harm(copied)
    with pytest.raises(InputError, match=message) as caught:
        known(frames(copied, "all")[0])
    assert str(copied) in str(caught.value) and "\n" not in str(caught.value)


def test_a_list_of_something_else_is_refused(copied):
    path = copied / "data_2d_semantics" / "train" / "2013_05_28_drive_val_frames.txt"
    path.write_text("a.png b.png\n")
    with pytest.raises(InputError, match=r"val_frames.txt: must have lines .../SEQUENCE/image_00/data_rect/N.png"):
        frames(copied, "val")
