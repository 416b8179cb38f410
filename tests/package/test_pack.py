"""runs/pack.py: a data set in one small file and back."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.data.semantic_kitti import frames
from lidar2pano.errors import InputError
from lidar2pano.scan import Scan
from miniature import write_data_set

PACK = runpy.run_path(str(Path(__file__).parents[2] / "runs/pack.py"))
pack, unpack, packed, unpacked = (PACK[name] for name in ("pack", "unpack", "packed", "unpacked"))


def test_a_data_set_comes_back(tmp_path: Path):
    root, back = write_data_set(tmp_path / "data"), tmp_path / "back"
    labels = next(iter(root.glob("sequences/*/labels/*.label")))
    raw = np.fromfile(labels, "<u4")
    raw[:3] = [2**31 + 40, 0, 0xFFFF0001]  # instances stand in the high bits
    raw.tofile(labels)
    pack(root, tmp_path / "small.zip", ["train", "val"])
    unpack(tmp_path / "small.zip", back)
    assert {path.relative_to(back) for path in back.rglob("*")} <= {path.relative_to(root) for path in root.rglob("*")}
    assert json.loads((back / "splits.json").read_text()).keys() == {"train", "val"}
    for split in ("train", "val"):
        for before, after in zip(frames(root, split), frames(back, split), strict=True):
            assert before.name == after.name
            a, b = before.scan, after.scan
            np.testing.assert_allclose(b.xyz, a.xyz, rtol=0, atol=0.5 / 128 + 1e-6)
            np.testing.assert_allclose(b.remission, a.remission, rtol=0, atol=0.5 / 200 + 1e-6)
            assert np.array_equal(before.image, after.image)
            assert np.array_equal(before.camera_labels, after.camera_labels)
            for name in (f"labels/{before.stem}.label", "calib.txt"):
                assert (before.folder / name).read_bytes() == (after.folder / name).read_bytes()


def test_steps_between_points_may_be_as_large_as_the_range():
    xyz = np.array([[-255.5, 255.5, 0], [255.5, -255.5, 1], [-255.5, 3, -1]], np.float32)
    scan, label = unpacked(packed(Scan(xyz=xyz, remission=np.array([1, 0, 0.5], np.float32)), None))
    assert np.array_equal(scan.xyz, xyz) and scan.remission.tolist() == [1, 0, 0.5] and label is None


@pytest.mark.parametrize("x", [257, np.nan])
def test_a_point_that_does_not_fit_is_an_error(x: float):
    with pytest.raises(InputError, match="beyond 256 m"):
        packed(Scan(xyz=np.array([[x, 0, 0]], np.float32), remission=np.zeros(1, np.float32)), None)


def test_scans_become_small(tmp_path: Path):
    root = write_data_set(tmp_path / "data")
    pack(root, tmp_path / "small.zip", ["train"])
    scans = sum(
        frame.folder.joinpath("velodyne", f"{frame.stem}.bin").stat().st_size for frame in frames(root, "train")
    )
    assert (tmp_path / "small.zip").stat().st_size < scans / 2
