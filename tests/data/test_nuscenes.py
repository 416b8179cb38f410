"""nuScenes as it is downloaded: its points, cameras, poses, labels and splits, and what is damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copy, copytree, ignore_patterns

import numpy as np
import pytest
import torch

from lidar2pano.data import nuscenes_tables
from lidar2pano.data.frames import IGNORE, Frame
from lidar2pano.data.layouts import frames
from lidar2pano.data.nuscenes import CLASSES, MINI_VAL, SPLITS, VAL, NuscenesSample, class_table
from lidar2pano.data.nuscenes_tables import CHANNELS, nuscenes_index
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import pixels
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.views import VIEWS
from miniature_layouts import CAMERA_OF, NuscenesTables, nuscenes_pose, write_nuscenes_layout
from miniature_surround import painting, six, sweep

QUARTER = VIEWS["panorama"].scaled(1 / 4)
VERSION = "v1.0-mini"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_nuscenes_layout(tmp_path_factory.mktemp("layout") / "nuscenes")


@pytest.fixture
def copied(root, tmp_path) -> Path:
    copytree(root, tmp_path / "set", ignore=ignore_patterns(".lidar2pano"))
    return tmp_path / "set"


def sample(root: Path, split: str = "mini_val", number: int = 1) -> NuscenesSample:
    frame = frames(root, split, QUARTER)[number]
    assert isinstance(frame, NuscenesSample)
    return frame


def everything(frame: Frame) -> None:
    for part in ("scan", "point_labels", "calibration", "pose", "panorama"):
        getattr(frame, part)


def test_the_place_is_read_in_our_frame(root):
    frame = sample(root)
    points, ground = sweep(32, 500)
    assert frame.name == frame.whole_scan.name == "scene-0103/000001"
    assert np.abs(frame.whole_scan.xyz - points).max() < 1e-5
    assert frame.whole_scan.remission == pytest.approx(0.2) and frame.scan.label is None
    assert frame.pose == pytest.approx(nuscenes_pose(1, 1), abs=1e-9)
    assert sample(root, "mini_train", 0).pose == pytest.approx(nuscenes_pose(0, 0), abs=1e-9)
    assert frame.point_labels is not None
    named = np.array(SEMANTIC_KITTI.classes)[frame.point_labels]
    assert (named[::10] == "unlabeled").all()
    rest = np.arange(len(named)) % 10 > 0
    assert (named[rest & ground] == "road").all() and (named[rest & ~ground] == "building").all()


def test_a_point_of_the_world_is_where_each_camera_has_it(root):
    """Each camera took its image from elsewhere; still, points of the scan have the colours that they have there."""
    frame, mounts = sample(root), six()
    assert frame.front == next(iter(frame.cameras)) and set(frame.cameras) == set(CAMERA_OF)
    points = frame.whole_scan.xyz[7::13].astype(np.float64)
    for name, camera in frame.cameras.items():
        mount, calibration = mounts[CAMERA_OF[name]], camera.calibration
        assert calibration.T_camera_lidar == pytest.approx(mount.T_camera_lidar, abs=1e-9)
        assert pytest.approx(mount.K) == calibration.K and calibration.size == mount.size
        u, v, ahead = projected(points, calibration)
        inside = (ahead > 0.5) & (u > 1) & (u < mount.size[0] - 2) & (v > 1) & (v < mount.size[1] - 2)
        assert inside.sum() > 60
        colours = camera.image[v[inside].round().astype(int), u[inside].round().astype(int)]
        assert np.abs(colours - painting(points[inside])).mean() < 2.5
    assert frame.calibration.T_camera_lidar == pytest.approx(frame.cameras["CAM_FRONT"].calibration.T_camera_lidar)
    assert np.array_equal(frame.image, frame.cameras["CAM_FRONT"].image)


def projected(points: np.ndarray, calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y, z = calibration.T_camera_lidar[:3, :3] @ points.T + calibration.T_camera_lidar[:3, 3:]
    K = calibration.K
    return K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2], z


def test_a_point_is_in_the_panorama_where_it_lies(root):
    frame = sample(root)
    around = frame.panorama
    assert around.labels is not None and around.valid.mean() > 0.9
    assert around.view == replace(QUARTER, origin=frame.calibration.centre)
    away = frame.scan.xyz - np.float32(around.view.origin)
    row, column = (part.numpy().astype(int) for part in pixels(*torch.from_numpy(away).unbind(1), around.view))
    owners = np.flatnonzero((row >= 0) & (row < 96) & (np.arange(len(away)) % 10 > 0))
    own = owners[np.abs(around.depth_m[row[owners], column[owners]] - np.linalg.norm(away[owners], axis=1)) < 1e-4]
    assert len(own) > 3000
    at = row[own], column[own]
    names = {"road": COMMON15.id_of("road"), "building": COMMON15.id_of("building")}
    expected = [names[SEMANTIC_KITTI.classes[number]] for number in frame.point_labels[own]]
    assert (around.labels[at] == expected).all()
    off = np.abs(around.image[at] - painting(frame.scan.xyz[own]))
    assert off[around.valid[at]].mean() < 3
    assert (around.labels[around.depth_m == 0] == IGNORE).all()


def test_labels_of_the_panorama_are_known_without_its_images(copied):
    for file in (copied / "samples").glob("CAM_*/*"):
        if "CAM_FRONT__" not in file.name:
            file.unlink()
    frame = sample(copied)
    assert frame.panorama_labels is not None and (frame.panorama_labels != IGNORE).any()
    with pytest.raises(InputError, match="is missing"):
        frame.panorama  # noqa: B018


def test_splits_are_the_devkits(root, copied):
    assert frames(root, "mini_train").names == ("scene-0061/000000", "scene-0061/000001")
    assert frames(root, "mini_val").names == ("scene-0103/000000", "scene-0103/000001")
    everywhere = (*frames(root, "mini_train").names, *frames(root, "mini_val").names)
    assert frames(root, "all").names == frames(root, VERSION).names == everywhere
    assert frames(root, "scene-0103").names == frames(root, "mini_val").names
    for split in ("train", "holiday"):
        with pytest.raises(InputError, match=f"no split '{split}' of v1.0-mini") as caught:
            frames(root, split)
        assert "mini_train" in str(caught.value)
    with pytest.raises(InputError, match="no version has the scene 'scene-0999'"):
        frames(root, "scene-0999")
    copytree(copied / VERSION, copied / "v1.0-trainval")
    assert frames(copied, "val").names == frames(root, "mini_val").names, "scene 103 is in val, 61 is in train"
    assert frames(copied, "train").names == frames(root, "mini_train").names
    with pytest.raises(InputError, match="no split 'all' of v1.0-mini and v1.0-trainval"):
        frames(copied, "all")


def test_the_official_splits_have_as_many_scenes_as_nuscenes_says():
    def count(ranges: tuple[tuple[int, int], ...]) -> list[int]:
        return [number for first, last in ranges for number in range(first, last + 1)]

    assert len(count(VAL)) == len(set(count(VAL))) == 150 and count(VAL) == sorted(count(VAL))
    assert set(count(MINI_VAL)) < set(count(VAL)) and {553, 796} < set(count(VAL)), "both mini splits reach into it"
    assert {61, 655, 757, 1077, 1094, 1100}.isdisjoint(count(VAL))
    assert set(SPLITS) == {"train", "val", "test", "mini_train", "mini_val"}


def test_a_listing_may_name_scenes_and_samples(copied):
    (copied / "splits.json").write_text(json.dumps({"val": ["scene-0103/000001", "scene-0061"], "odd": ["scene-1"]}))
    assert frames(copied, "val").names == ("scene-0103/000001", "scene-0061/000000", "scene-0061/000001")
    assert frames(copied, "mini_val").names == frames(copied, "scene-0103").names, "the others hold as well"
    with pytest.raises(InputError, match="splits.json: split 'odd' must be a list of scenes"):
        frames(copied, "odd")
    (copied / "splits.json").write_text(json.dumps({"val": ["scene-0103/000002"]}))
    with pytest.raises(InputError, match="scene-0103 has 2 samples, none is 'scene-0103/000002'"):
        frames(copied, "val")


def test_the_index_is_built_once_and_again_when_a_table_changes(copied, monkeypatch):
    built: list[Path] = []
    real = nuscenes_tables._build
    monkeypatch.setattr(nuscenes_tables, "_build", lambda folder: built.append(folder) or real(folder))
    first = nuscenes_index(copied, VERSION)
    (kept,) = (copied / ".lidar2pano" / "nuscenes").iterdir()
    nuscenes_tables._index.cache_clear()
    again = nuscenes_index(copied, VERSION)
    assert len(built) == 1 and np.array_equal(again.poses, first.poses) and np.array_equal(again.files, first.files)
    assert again.T_world_sensor(0, 0) == pytest.approx(first.T_world_sensor(0, 0))
    kept.write_bytes(kept.read_bytes()[:-100])
    nuscenes_tables._index.cache_clear()
    assert nuscenes_index(copied, VERSION).samples("scene-0103") == range(2, 4) and len(built) == 2
    table = copied / VERSION / "scene.json"
    table.write_text(table.read_text().replace("scene-0103", "scene-0104"))
    assert not nuscenes_index(copied, VERSION).samples("scene-0103") and len(built) == 3


def test_a_read_only_data_set_has_its_index_in_the_users_cache(copied, tmp_path, monkeypatch):
    (copied / ".lidar2pano").write_text("in the way, as where the folder may not be written")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert len(frames(copied, "all")) == 4
    assert list((tmp_path / "user" / "lidar2pano" / "nuscenes").glob("v1.0-mini-*.npz"))


def test_every_class_of_lidarseg_has_a_place(root):
    table = class_table(root / VERSION / "category.json")
    rows = json.loads((root / VERSION / "category.json").read_text())
    assert len(rows) == len(CLASSES) == 32 and (table[:32] >= 0).all() and (table[32:] == -1).all()
    named = {row["name"]: SEMANTIC_KITTI.classes[table[row["index"]]] for row in rows}
    assert named["flat.driveable_surface"] == "road" and named["vehicle.bus.rigid"] == "other-vehicle"
    assert named["human.pedestrian.adult"] == "person" and named["vehicle.ego"] == named["noise"] == "unlabeled"


def test_without_lidarseg_there_are_no_labels(copied):
    for file in (copied / "lidarseg" / VERSION).iterdir():
        file.unlink()
    frame = sample(copied)
    assert frame.point_labels is None and frame.panorama.labels is None and frame.panorama_labels is None
    with pytest.raises(InputError, match=r"_lidarseg.bin: is missing; download nuScenes-lidarseg"):
        frame.require("point_labels")


def edited(root: Path, table: str, edit: Callable[[list[dict]], object]) -> None:
    path = root / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    edit(rows)
    path.write_text(json.dumps(rows))


def torn(root: Path, pattern: str) -> None:
    for path in root.glob(pattern):
        path.write_bytes(path.read_bytes()[:-301])


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no table": (
        lambda r: (r / VERSION / "ego_pose.json").unlink(),
        r"ego_pose.json: is missing; complete the data set",
    ),
    "half a table": (lambda r: torn(r, "v1.0-mini/sample_data.json"), r"sample_data.json: ends within a row"),
    "half a small table": (lambda r: torn(r, "v1.0-mini/sample.json"), r"sample.json: is no JSON"),
    "another table": (lambda r: (r / VERSION / "scene.json").write_text("{}"), r"scene.json: is no list of objects"),
    "no token": (
        lambda r: edited(r, "scene", lambda rows: rows[0].pop("token")),
        r"scene.json: row 'None' has no 'token'",
    ),
    "a strange token": (
        lambda r: edited(r, "sample", lambda rows: rows[0].update(scene_token="x")),
        r"sample.json: row '.*' names 'x', which scene.json has not",
    ),
    "a number for a name": (
        lambda r: edited(r, "sensor", lambda rows: rows[0].update(channel=3)),
        r"sensor.json: row '.*' has no 'channel' as nuScenes' schema has it",
    ),
    "no pose": (lambda r: edited(r, "ego_pose", lambda rows: rows.pop(0)), r"ego_pose.json: has no pose '"),
    "no rotation": (
        lambda r: edited(r, "ego_pose", lambda rows: rows[0].update(rotation=[0, 0, 0, 0])),
        r"ego_pose.json: row '.*' holds no translation and unit quaternion",
    ),
    "a pose in words": (
        lambda r: edited(r, "ego_pose", lambda rows: rows[0].update(translation=["x", 0, 0])),
        r"ego_pose.json: row '.*' holds no translation and unit quaternion",
    ),
    "a mount too short": (
        lambda r: edited(r, "calibrated_sensor", lambda rows: rows[0].update(rotation=[1.0])),
        r"calibrated_sensor.json: row '.*' holds no translation and unit quaternion",
    ),
    "no camera matrix": (
        lambda r: edited(r, "calibrated_sensor", lambda rows: rows[-1].update(camera_intrinsic=[[1, 2], [3]])),
        r"calibrated_sensor.json: row '.*': camera_intrinsic: holds no numbers",
    ),
    "four numbers for a camera matrix": (
        lambda r: edited(r, "calibrated_sensor", lambda rows: rows[-1].update(camera_intrinsic=[200, 200, 80, 45])),
        r"calibrated_sensor.json: row '.*': camera_intrinsic: is no camera matrix",
    ),
    "a camera missing": (
        lambda r: edited(r, "sample_data", lambda rows: rows.pop()),
        r"sample_data.json: has no CAM_FRONT_RIGHT of sample",
    ),
    "a file elsewhere": (
        lambda r: edited(r, "sample_data", lambda rows: rows[0].update(filename="/etc/passwd")),
        r"sample_data.json: names the file '/etc/passwd', outside of the data set",
    ),
    "half a sweep": (lambda r: torn(r, "samples/LIDAR_TOP/*"), r"pcd.bin: \d+ bytes are no whole number of points"),
    "half the labels": (lambda r: torn(r, "lidarseg/*/*"), r"_lidarseg.bin: has \d+ labels, but its scan 16000 points"),
    "a torn image": (lambda r: torn(r, "samples/CAM_BACK/*"), r"jpg: is no readable image"),
    "categories without ids": (
        lambda r: edited(r, "category", lambda rows: rows[3].pop("index")),
        r"category.json: has a row without a name and an index of a class; take nuScenes-lidarseg's file",
    ),
    "too few categories": (
        lambda r: edited(r, "category", lambda rows: rows.pop(24)),
        r"_lidarseg.bin: holds class 24, which category.json does not name",
    ),
    "an unknown category": (
        lambda r: edited(r, "category", lambda rows: rows[4].update(name="vehicle.kar")),
        r"category.json: class 'vehicle.kar' is not known; did you mean 'vehicle.car'",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_said_in_one_line(copied, damage):
    harm, message = DAMAGES[damage]
    harm(copied)
    with pytest.raises(InputError, match=message) as caught:
        everything(sample(copied))
    assert str(copied) in str(caught.value) and "\n" not in str(caught.value)


def test_the_real_sample_is_the_same_as_by_its_info_file(nuscenes, tmp_path):
    """Tables that are made of info.json; where the vehicle was when a camera measured is what its lidar2cam implies."""
    (old,) = frames(nuscenes, "all", QUARTER)
    entry = json.loads((nuscenes / "info.json").read_text().replace("NaN", "0"))["data_list"][0]
    tables, ego = NuscenesTables(), np.array(entry["ego2global"])
    lidar2ego = np.array(entry["lidar_points"]["lidar2ego"])
    scene = tables.add("scene", name="scene-0061")
    row = tables.add("sample", scene_token=scene, timestamp=1)
    files = {CHANNELS[0]: entry["lidar_points"]["lidar_path"]}
    tables.add_data(row, tables.add_sensor(CHANNELS[0], lidar2ego), ego, f"samples/{files[CHANNELS[0]]}")
    drives = {}
    for name, camera in entry["images"].items():
        cam2ego = np.array(camera["cam2ego"])
        then = ego @ lidar2ego @ np.linalg.inv(camera["lidar2cam"]) @ np.linalg.inv(cam2ego)
        drives[camera["timestamp"]] = np.linalg.inv(ego) @ then
        files[name] = camera["img_path"]
        tables.add_data(row, tables.add_sensor(name, cam2ego, camera["cam2img"]), then, f"samples/{files[name]}")
    tables.write(tmp_path / VERSION)
    (tmp_path / "samples").mkdir()
    for file in files.values():
        copy(nuscenes / file, tmp_path / "samples")
    new = sample(tmp_path, "all", 0)
    assert np.array_equal(new.scan.xyz, old.scan.xyz, equal_nan=True)
    assert np.array_equal(new.scan.remission, old.scan.remission)
    assert new.pose == pytest.approx(old.pose, abs=1e-4)
    assert isinstance(new, NuscenesSample) and list(new.cameras) == list(old.cameras)
    for name, camera in new.cameras.items():
        other = old.cameras[name]
        assert camera.calibration.T_camera_lidar == pytest.approx(other.calibration.T_camera_lidar, abs=1e-4)
        assert pytest.approx(other.calibration.K) == camera.calibration.K
        assert np.array_equal(camera.image, other.image)
        assert (camera.ego_mask is None) == (other.ego_mask is None)
    # the implied way is a car's: ahead, the farther back the earlier the image was taken
    times = sorted(drives)
    ahead = [drives[time][0, 3] for time in times]
    assert ahead == sorted(ahead) and -1.0 < ahead[0] < ahead[-1] < 0.05
    speed = (ahead[-1] - ahead[0]) / (times[-1] - times[0])
    assert 5 < speed < 15 and max(abs(drives[time][1, 3]) for time in times) < 0.1
