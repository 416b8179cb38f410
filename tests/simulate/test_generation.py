"""A simulated data set: its files, their agreement with each other, and the same bytes however they come about."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from lidar2pano.calibration import read_calib
from lidar2pano.cli import main
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.labels import COMMON15, unpack_label
from lidar2pano.views import KITTI_CAMERA, VIEWS

pytest.importorskip("embreex", reason="the street world needs embreex: pip install 'lidar2pano[world]'")

from lidar2pano.simulate import generation  # noqa: E402 needs embreex

RUNS = Path(__file__).resolve().parents[2] / "runs"
RASTER = "panorama/4"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two frames of a street, with everything."""
    out = tmp_path_factory.mktemp("world") / "w"
    words = ["--frames", "2", "--seed", "5", "--place", "residential", "--view", RASTER, "--processes", "1"]
    assert main(["world", str(out), *words]) == 0
    return out, words


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_readers_read_it_like_any_data_set(made):
    root, _ = made
    first, second = frames(root, "all")
    scan = first.scan
    assert 60_000 < len(scan) < 140_000
    assert len(np.unique(first.point_labels)) >= 8
    assert first.image.shape == (375, 1242, 3)
    assert first.camera_labels.shape == (375, 1242)
    calibration = first.calibration
    assert np.allclose(calibration.centre, KITTI_CAMERA, atol=1e-6), "the panorama's origin"
    with Image.open(second.folder / "pano" / f"{second.stem}.png") as image:
        assert image.size == (VIEWS["panorama"].columns // 4, VIEWS["panorama"].rows // 4)
    assert json.loads((root / "splits.json").read_text())["val"] == ["00/000000", "00/000001"]


def test_the_page_says_how_it_was_made_and_stays(made, tmp_path):
    root, words = made
    text = (root / "README.md").read_text()
    header = yaml.safe_load(text.split("---\n")[1])
    assert header["license"] == "apache-2.0" and {"lidar", "synthetic"} <= set(header["tags"])
    (command,) = re.findall(r"`lidar2pano (world OUT .*?)`", text)
    again = [*command.replace("OUT", str(root)).split(), "--processes", "1"]  # the same settings, or it would refuse
    (root / "README.md").write_text("my own words")
    assert main(again) == 0 and (root / "README.md").read_text() == "my own words"
    (root / "README.md").write_text(text)
    folders = set(re.findall(r"`(\w+)/`", text.partition("| ---")[2]))
    assert folders == {path.name for path in (root / "sequences" / "00").iterdir() if path.is_dir()}


def test_instances_tell_things_apart(made):
    frame = frames(made[0], "all")[0]
    raw, instance = unpack_label(np.fromfile(frame.folder / "labels" / f"{frame.stem}.label", dtype="<u4"))
    counted = np.isin(raw, [10, 11, 13, 15, 18, 20, 30, 31, 32, 252, 253, 254, 255, 257, 258, 259])
    assert (instance[counted] > 0).all()
    assert (instance[np.isin(raw, [40, 48, 50, 70, 72])] == 0).all()
    cars = instance[raw == 10]
    assert len(np.unique(cars)) > 3
    xyz = frame.scan.xyz
    for number in np.unique(cars):
        # A few points at a car's edge lie between it and what is behind it.
        if (instance == number).sum() < 30:
            continue
        low, high = np.percentile(xyz[(raw == 10) & (instance == number), :2], [10, 90], axis=0)
        assert (high - low).max() < 6, "one car"


def test_points_images_and_depths_agree(made):
    sys.path.insert(0, str(RUNS))
    try:
        from check_world import agreement
    finally:
        sys.path.remove(str(RUNS))
    for frame in frames(made[0], "all"):
        found = agreement(frame, VIEWS["panorama"].scaled(1 / 4))
        assert found.panorama_points > 15_000 and found.camera_points > 5_000
        assert found.panorama_same > 0.97
        assert found.camera_same > 0.97
        assert found.depth_error_m < 0.03


def test_panorama_through_the_camera_is_the_camera_s_image(made):
    import torch

    from lidar2pano.geometry.camera import at_camera, panorama_in_camera

    frame = frames(made[0], "all")[0]
    calibration = frame.calibration.scaled(0.2)
    view = at_camera(VIEWS["panorama"].scaled(1 / 4), calibration)
    pano = np.array(Image.open(frame.folder / "pano" / f"{frame.stem}.png")).astype(np.float32)
    lookup = panorama_in_camera(view, calibration)
    resampled = lookup.linear(torch.from_numpy(pano).movedim(2, 0)).numpy().transpose(1, 2, 0)
    small = Image.fromarray(frame.image).resize(calibration.size, Image.Resampling.BOX)
    gap = np.abs(resampled - np.array(small).astype(np.float32))[lookup.valid.numpy()]
    assert np.median(gap) < 6
    assert gap.mean() < 16
    shifted = np.abs(np.roll(resampled, 6, axis=1) - np.array(small).astype(np.float32))[lookup.valid.numpy()]
    assert shifted.mean() > 1.25 * gap.mean(), "the test sees a shift"


def test_poses_carry_standing_points_onto_each_other(made):
    root, _ = made
    first, second = frames(root, "all")
    rows = np.loadtxt(first.folder / "poses.txt").reshape(-1, 3, 4)
    Tr = read_calib(first.folder / "calib.txt").T_camera_lidar
    pose = np.eye(4)
    pose[:3] = rows[1]
    step = np.linalg.inv(Tr) @ pose @ Tr  # second frame -> first
    assert np.allclose(rows[0], np.eye(4)[:3], atol=1e-9)
    depth = np.array(Image.open(first.folder / "pano_depth" / f"{first.stem}.png")) / 256
    scan = second.scan
    labels = second.point_labels
    fixed = np.isin(labels, [9, 11, 13])  # road, sidewalk, building
    xyz = scan.xyz[fixed] @ step[:3, :3].T + step[:3, 3] - np.array(KITTI_CAMERA)
    view = VIEWS["panorama"].scaled(1 / 4)
    flat = np.hypot(xyz[:, 0], xyz[:, 1])
    row = ((view.up - xyz[:, 2] / flat) / (view.up - view.down) * view.rows).astype(int)
    column = ((np.pi - np.arctan2(xyz[:, 1], xyz[:, 0])) / (2 * np.pi) * view.columns).astype(int) % view.columns
    inside = (row >= 0) & (row < view.rows)
    error = np.abs(depth[row[inside], column[inside]] - np.linalg.norm(xyz[inside], axis=1))
    assert np.median(error) < 0.08
    assert np.linalg.norm(step[:3, 3]) > 0.05, "it moves"


def test_a_stopped_run_goes_on_and_gives_the_same_bytes(made):
    root, words = made
    before = contents(root)
    lost = ["sequences/00/pano/000001.png", "sequences/00/velodyne/000001.bin", "sequences/00/poses.txt"]
    for name in lost:
        (root / name).unlink()
    kept = root / "sequences/00/pano/000000.png"
    written = kept.stat().st_mtime_ns
    assert main(["world", str(root), *words]) == 0
    assert contents(root) == before
    assert kept.stat().st_mtime_ns == written, "what was there is kept"


def test_two_processes_write_the_same_bytes_and_another_seed_others(tmp_path):
    words = ["--frames", "1", "--place", "motorway", "--save", "scans", "--sensor", "vlp16"]
    for name, more in {
        "one": ["--sequences", "2", "--processes", "1"],
        "two": ["--sequences", "2", "--processes", "2"],
        "other": ["--sequences", "1", "--processes", "1", "--seed", "1"],
    }.items():
        assert main(["world", str(tmp_path / name), *words, *more]) == 0
    one, two, other = (contents(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert one["sequences/00/velodyne/000000.bin"] != one["sequences/01/velodyne/000000.bin"]
    assert one["sequences/00/velodyne/000000.bin"] != other["sequences/00/velodyne/000000.bin"]


def test_a_taller_panorama_shows_the_same_and_more(tmp_path):
    words = ["--frames", "1", "--seed", "5", "--place", "residential", "--save", "panorama", "--processes", "1"]
    words += ["--view", "panorama-tall/4", "--view", RASTER, "--view", "panorama-tall/8"]
    assert main(["world", str(tmp_path / "w"), *words]) == 0
    folder = tmp_path / "w/sequences/00"
    layers = {
        name: np.array(Image.open(folder / name / "000000.png"))
        for name in ("pano_labels", "pano_labels-4", "pano_labels-tall-8")
    }
    tall, plain = layers["pano_labels"], layers["pano_labels-4"]
    assert tall.shape == (200, 1152) and layers["pano_labels-tall-8"].shape == (100, 576)
    assert np.array_equal(tall[40:136], plain)
    sky, road = COMMON15.id_of("sky"), COMMON15.id_of("road")
    assert (tall[0] == sky).mean() > (plain[0] == sky).mean() and (tall[-1] == road).mean() > 0.5
    frame = frames(tmp_path / "w", "all")[0]
    assert (frame.panorama.view.rows, frame.panorama.view.up) == (200, VIEWS["panorama-tall"].up)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--sensor", "hdl-64"], "hdl64e"),
        (["--look", "dya"], "day"),
        (["--place", "countri"], "country"),
        (["--save", "scan"], "scans"),
        (["--view", "panorama/3"], "panorama"),
        (["--hz", "0"], "hz"),
        (["--sensor-height", "0.1"], "--sensor-height must lie between 0.3 and 4.0 metres"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(words, part, tmp_path, capsys):
    assert main(["world", str(tmp_path / "w"), *words]) == 2
    line = capsys.readouterr().err
    assert part in line and line.count("\n") == 1
    assert not (tmp_path / "w").exists()


def test_another_world_is_not_mixed_in(made, capsys):
    root, words = made
    before = contents(root)
    assert main(["world", str(root), *words, "--look", "evening"]) == 2
    assert "another world" in capsys.readouterr().err
    assert contents(root) == before


def test_a_sensor_stands_as_high_as_it_is_asked_to(tmp_path, capsys):
    """Road points near it lie so far below it; the street is the same."""
    words = ["--frames", "1", "--seed", "5", "--place", "residential", "--save", "scans", "--processes", "1"]
    for height in (0.8, 1.73, 2.6):
        out = tmp_path / str(height)
        assert main(["world", str(out), *words, "--sensor-height", str(height)]) == 0
        (frame,) = frames(out, "all")
        xyz, road = frame.scan.xyz, frame.point_labels == 9
        near = road & (np.hypot(xyz[:, 0], xyz[:, 1]) < 8)
        assert near.sum() > 500
        assert np.median(xyz[near, 2]) == pytest.approx(-height, abs=0.08)
    assert f"--sensor-height {height}" in (out / "README.md").read_text()


def test_a_world_of_fewer_settings_goes_on(made):
    """It was made before sensors had heights; what was not said is as it is by default."""
    root, words = made
    card, before = root / "world.json", contents(root)
    said = json.loads(card.read_text())
    del said["sensor_height"]
    card.write_text(json.dumps(said))
    assert main(["world", str(root), *words]) == 0
    assert main(["world", str(root), *words, "--sensor-height", "1"]) == 2
    card.write_text("{}")
    assert main(["world", str(root), *words]) == 2
    card.write_bytes(before["world.json"])
    assert contents(root) == before


def test_a_folder_with_other_data_is_left_alone(tmp_path, capsys):
    (tmp_path / "sequences").mkdir()
    assert main(["world", str(tmp_path)]) == 2
    assert "no simulated world" in capsys.readouterr().err


def test_without_embree_the_error_says_what_to_install(monkeypatch):
    from lidar2pano.simulate.scene.raycast import Scene

    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match=r"lidar2pano\[world\]"):
        Scene([])


class Fatal:
    """A task that ends the process that receives it."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_killed_process_is_reported_in_one_line():
    with pytest.raises(InputError, match="a process was killed"):
        list(generation._in_parallel([(Fatal(),)], 2))


def test_workers_end_with_their_parent():
    """However it ends: here it is killed while its worker sleeps."""
    code = """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
import os, time
from lidar2pano.simulate.generation import _end_with_parent
if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_end_with_parent)
    print(pool.submit(os.getpid).result(), flush=True)
    time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        parent.kill()
    for _ in range(100):
        state = subprocess.run(
            ["ps", "-o", "stat=", "-p", str(worker)], capture_output=True, text=True, check=False
        ).stdout
        if not state or state.startswith("Z"):  # gone, or dead and not yet collected
            return
        time.sleep(0.1)
    pytest.fail("the worker outlived its parent")
