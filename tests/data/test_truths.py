"""What is known of a frame, whatever kind of data set it comes from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data import truths as module
from lidar2pano.data.sequences import UNSURE
from lidar2pano.data.truths import Truth, truths
from lidar2pano.errors import InputError
from lidar2pano.formats.output_files import write_depth, write_palette, write_png
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.views import VIEWS, View
from miniature import CALIB, SIZE, street, write_data_set
from miniature_surround import write_nuscenes, write_pandaset

EIGHTH, QUARTER = (VIEWS["panorama"].scaled(1 / part) for part in (8, 4))


@pytest.fixture(scope="module")
def layout(tmp_path_factory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("layout") / "set")


def write_world(root: Path) -> Path:
    """The miniature with what `lidar2pano world` writes besides: a card, poses, and panoramas of known contents."""
    write_data_set(root)
    (root / "world.json").write_text(json.dumps({"views": ["panorama/8", "panorama/4"]}))
    rows, columns = EIGHTH.rows, EIGHTH.columns
    for folder in (root / "sequences").iterdir():
        for part in ("pano", "pano_labels", "pano_depth"):
            (folder / part).mkdir()
        # camera 0 moves 2 m along its axis from frame to frame, and then to its right: our x and -y
        poses = [np.column_stack([np.eye(3), at]) for at in ((5.0, 0, 0), (5.0, 0, 2), (6.0, 0, 2))]
        (folder / "poses.txt").write_text("".join(" ".join(map(str, pose.ravel())) + "\n" for pose in poses))
        for scan in (folder / "velodyne").iterdir():
            column = np.tile(np.arange(columns), (rows, 1))
            colour = np.stack([column % 251, column // 251, np.full_like(column, int(scan.stem))], axis=-1)
            write_png(folder / "pano" / f"{scan.stem}.png", colour.astype(np.uint8))
            write_palette(folder / "pano_labels" / f"{scan.stem}.png", (column % 16).astype(np.uint8))
            write_depth(folder / "pano_depth" / f"{scan.stem}.png", column / 4.0)
    return root


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    return write_world(tmp_path_factory.mktemp("world") / "set")


def known(truth: Truth) -> set[str]:
    return {name for name in truth.__slots__ if getattr(truth, name) is not None}


def test_a_set_in_the_layout_tells_what_its_files_tell(layout):
    found = truths(layout, "train")
    assert found.kind == "frames" and len(found) == 3
    assert found.names == ("00/000000", "00/000001", "00/000002") == tuple(one.name for one in found)
    truth = found[1]
    assert known(truth) == {"name", "scan", "calibration", "picture", "camera_ids", "point_ids"}
    assert truth.scan.name == "00/000001" and truth.scan.label is None, "who is measured must not see labels"
    assert truth.calibration is not None and truth.calibration.size == SIZE
    assert truth.picture is not None and truth.picture.shape == (72, 240, 3) and truth.picture.dtype == np.uint8
    assert truth.picture[71, 100].tolist() == [90, 90, 95]
    assert truth.camera_ids is not None and truth.camera_ids.shape == (72, 240)
    assert (truth.camera_ids[:, :5] == UNSURE).all(), "unsure is masked"
    named = {COMMON15.classes[i] for i in np.unique(truth.camera_ids[:, 5:])}
    assert named == {"sky", "building", "road"} and COMMON15.classes[truth.camera_ids[70, 100]] == "road"
    assert truth.point_ids is not None and np.array_equal(truth.point_ids, street(1).label)


def test_what_is_not_there_is_none(tmp_path):
    root = write_data_set(tmp_path / "set")
    folder = root / "sequences" / "00"
    (folder / "image_2" / "000000.png").unlink()
    (folder / "labels" / "000001.label").unlink()
    (folder / "camera_labels" / "000002.png").unlink()
    a, b, c = truths(root, "train")
    assert known(a) == {"name", "scan", "calibration", "camera_ids", "point_ids"}
    assert known(b) == {"name", "scan", "calibration", "picture", "camera_ids"}
    assert known(c) == {"name", "scan", "calibration", "picture", "point_ids"}
    for part in ("camera_labels", "labels"):
        (folder / part / "000000.png").unlink(missing_ok=True)
        (folder / part / "000000.label").unlink(missing_ok=True)
    (folder / "calib.txt").unlink()
    assert known(truths(root, "train")[0]) == {"name", "scan"}, "a bare scan needs no calibration"
    with pytest.raises(InputError, match="calib.txt"):
        truths(root, "train")[1]


def test_a_world_tells_everything(world):
    found = truths(world, "train")
    assert found.kind == "world"
    truth = found[2]
    assert known(truth) == set(truth.__slots__)
    around, calibration = truth.panorama, truth.calibration
    assert around is not None and calibration is not None
    assert around.view.origin == pytest.approx(calibration.centre) and around.view.columns == EIGHTH.columns
    assert around.valid.all() and around.valid.shape == around.depth_m.shape == (48, 576)
    assert around.colour[7, 300].tolist() == [300 % 251, 1, 2] and around.colour.dtype == np.uint8
    assert around.ids is not None and around.ids.dtype == np.uint8 and (around.ids[5] == np.arange(576) % 16).all()
    assert around.depth_m.dtype == np.float32 and (around.depth_m[9] == np.arange(576) / 4).all()


def test_poses_lead_to_the_first_frames_place(world):
    a, b, c = (one.pose for one in truths(world, "train"))
    assert a == pytest.approx(np.eye(4), abs=1e-9)
    assert b is not None and b[:3, 3] == pytest.approx([2, 0, 0], abs=1e-9)
    assert c is not None and c[:3, 3] == pytest.approx([2, -1, 0], abs=1e-9)


def test_frames_are_read_when_they_are_asked_for(world, tmp_path, monkeypatch):
    read: list[str] = []
    real = module.frame_truth

    def counted(frame, view=None):
        read.append(frame.name)
        return real(frame, view)

    monkeypatch.setattr(module, "frame_truth", counted)
    found = truths(world, "train")
    assert len(found) == 3 and found.names[1:] == found[1:].names and found[1:].kind == "world" and not read
    assert found[-1].name == "00/000002" and read == ["00/000002"]
    assert [one.name for one in found[:2]] == ["00/000000", "00/000001"] and len(read) == 3
    with pytest.raises(IndexError):
        found[3]


@pytest.fixture(scope="module")
def painted(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("painted")
    write_pandaset(root / "pandaset")
    write_nuscenes(root / "nuscenes")
    return root


@pytest.mark.parametrize("kind", ["pandaset", "nuscenes"])
def test_surround_frames_tell_the_panorama(painted, kind):
    (truth,) = truths(painted / kind, "all", QUARTER)
    labelled = {"point_ids"} if kind == "pandaset" else set()
    assert known(truth) == {"name", "scan", "calibration", "picture", "panorama", "pose"} | labelled
    assert truth.scan.label is None and truth.scan.name == truth.name
    around, front = truth.panorama, truth.calibration
    assert around is not None and front is not None and around.depth_m is not None
    assert around.view == View(**QUARTER.as_dict() | {"origin": front.centre})
    size = (around.view.rows, around.view.columns)
    assert around.colour.shape == (*size, 3) and around.valid.shape == size and around.depth_m.shape == size
    assert around.valid.mean() > 0.9
    # the front camera's picture, looked up by hand, is the panorama ahead
    row, column = 48, 576
    azimuth = np.radians(180 - (column + 0.5) / 1152 * 360)
    slope = 0.24 - (row + 0.5) / 96 * 0.5236
    ray = front.K @ front.T_camera_lidar[:3, :3] @ (np.cos(azimuth), np.sin(azimuth), slope)
    u, v = (ray[:2] / ray[2]).round().astype(int)
    assert truth.picture is not None
    assert np.abs(around.colour[row, column].astype(int) - truth.picture[v, u]).max() <= 4
    image = project(truth.scan, around.view)
    assert np.array_equal(around.depth_m, image.channels[0].numpy()), "nothing of it is guessed"
    assert 0.2 < (around.depth_m > 0).mean() < 0.99


def test_surround_ids_are_those_of_labelled_points(painted):
    (truth,) = truths(painted / "pandaset", "all", QUARTER)
    around = truth.panorama
    assert (
        around is not None and around.ids is not None and around.ids.dtype == np.uint8 and truth.point_ids is not None
    )
    assert set(np.unique(around.ids)) == {COMMON15.id_of("road"), COMMON15.id_of("building"), UNSURE}
    assert np.array_equal(around.ids == UNSURE, around.depth_m == 0)
    number = 51_234
    x, y, z = (float(v) for v in truth.scan.xyz[number] - np.float32(around.view.origin))
    row, column = (int(part) for part in pixels(*torch.tensor([[x], [y], [z]]).unbind(0), around.view))
    assert SEMANTIC_KITTI.classes[truth.point_ids[number]] == COMMON15.classes[around.ids[row, column]]
    (none,) = truths(painted / "nuscenes", "all", QUARTER)
    assert none.panorama is not None and none.panorama.ids is None


def test_unlabeled_points_are_unsure(painted, tmp_path):
    root = tmp_path / "set"
    copytree(painted / "pandaset", root)
    path = root / "sequences/002/labels_pandaset/000000.label"
    ids = np.fromfile(path, "<u4")
    ids[:] = 0
    ids.tofile(path)
    (truth,) = truths(root, "all", QUARTER)
    assert truth.panorama is not None and truth.panorama.ids is not None
    assert (truth.panorama.ids == UNSURE).all() and truth.point_ids is not None and not truth.point_ids.any()


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a panorama without classes": (
        lambda r: (r / "sequences/01/pano_labels/000000.png").unlink(),
        r"pano_labels/000000.png: is missing",
    ),
    "a damaged panorama": (
        lambda r: (r / "sequences/01/pano_depth/000000.png").write_bytes(b"no"),
        r"pano_depth/000000.png: is no readable picture",
    ),
    "another raster": (
        lambda r: (r / "world.json").write_text('{"views": ["panorama/4"]}'),
        r"pano/000000.png: is \(48, 576, 3\) uint8, not 96x1152x3",
    ),
    "no raster": (lambda r: (r / "world.json").write_text('{"views": []}'), r"world.json: names no view"),
    "an unknown raster": (lambda r: (r / "world.json").write_text('{"views": ["x"]}'), r"world.json: names no view"),
    "half a card": (lambda r: (r / "world.json").write_text("{"), r"world.json: is no JSON"),
    "poses too short": (lambda r: (r / "sequences/01/poses.txt").write_text(""), r"poses.txt"),
    "another size": (
        lambda r: Image.new("RGB", (10, 10)).save(r / "sequences/01/image_2/000000.png"),
        r"camera_labels/000000.png: is 240x72 and its image 10x10",
    ),
    "too few labels": (
        lambda r: (r / "sequences/01/labels/000000.label").write_bytes(b"1234"),
        r"000000.label: 4 bytes",
    ),
    "no calibration": (lambda r: (r / "sequences/01/calib.txt").write_text(CALIB[:20]), r"calib.txt: row P2"),
}


@pytest.mark.filterwarnings("ignore:loadtxt")
@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_said_in_one_line(world, tmp_path, damage):
    harm, message = DAMAGES[damage]
    root = tmp_path / "set"
    copytree(world, root)
    harm(root)
    with pytest.raises(InputError, match=message) as caught:
        truths(root, "val")[0]
    assert str(root) in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_of_no_known_kind_is_told(tmp_path, layout, painted):
    with pytest.raises(
        InputError, match=r"is no data set with a known truth; name one in SemanticKITTI layout"
    ) as caught:
        truths(tmp_path, "val")
    assert str(tmp_path) in str(caught.value)
    for root in (layout, painted / "pandaset", painted / "nuscenes"):
        with pytest.raises(InputError, match="no split 'holiday'"):
            truths(root, "holiday")


def test_real_truths(kitti_mini, pandaset_mini):
    val = truths(kitti_mini, "val")
    truth = val[0]
    assert truth.picture is not None and truth.camera_ids is not None and truth.point_ids is not None
    assert truth.camera_ids.max() == UNSURE and (truth.camera_ids == COMMON15.id_of("road")).mean() > 0.05
    assert known(truths(kitti_mini, "unlabelled_scans")[0]) == {"name", "scan"}
    assert known(truths(kitti_mini, "labelled")[1]) == {"name", "scan", "point_ids"}
    around = truths(pandaset_mini, "all", VIEWS["panorama"].scaled(0.25))[3].panorama
    assert around is not None and around.ids is not None and around.valid.mean() > 0.9
    assert truths(pandaset_mini, "002").kind == "pandaset"
    road = around.colour[(around.ids == COMMON15.id_of("road")) & around.valid].astype(int)
    assert len(road) > 500 and np.ptp(road.mean(0)) < 25 and 30 < road.mean() < 130, "asphalt is grey"
