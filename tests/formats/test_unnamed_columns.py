"""Rows of numbers without names: how wide they are, and what their columns hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import cloud_of
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import interpreted, open_path
from lidar2pano.formats.unnamed_columns import column_names, row_width


def cloud(path: Path) -> PointCloud:
    return open_path(path).cloud(path)


XYZ, RING = made.street(beams=32, columns=360)
COUNT = len(XYZ)
GENERATOR = np.random.default_rng(2)
FORMS = made.remission(COUNT)
TIME = (np.pi - np.arctan2(XYZ[:, 1], XYZ[:, 0])) / (2 * np.pi) * 0.1
RANGE = np.linalg.norm(XYZ, axis=1)
LABEL, SCORE = GENERATOR.integers(0, 20, COUNT), GENERATOR.random(COUNT)
TABLES = {
    "x y z": (XYZ,),
    "x y z intensity": (XYZ, FORMS),
    "x y z ring": (XYZ, RING),
    "x y z intensity ring": (XYZ, FORMS, RING),
    "x y z intensity time": (XYZ, FORMS, TIME),
    "x y z intensity -": (XYZ, FORMS, LABEL),
    "x y z intensity ring time": (XYZ, FORMS, RING, TIME),
    "x y z intensity time ring": (XYZ, FORMS, TIME, RING),
    "x y z intensity - -": (XYZ, FORMS, SCORE, SCORE**2),
    "x y z intensity ring time -": (XYZ, FORMS, RING, TIME, LABEL),
    "x y z intensity ring time - -": (XYZ, FORMS, RING, TIME, LABEL, SCORE),
    "range x y z intensity": (RANGE, XYZ, FORMS),
    "x y z range intensity": (XYZ, RANGE, FORMS),
    "x y z intensity range -": (XYZ, FORMS, RANGE, LABEL),
    "- x y z intensity": (np.zeros(COUNT), XYZ, FORMS),
    "intensity x y z": (FORMS, XYZ),
    "x y z nx ny nz": (XYZ, XYZ / RANGE[:, None]),
    "x y z intensity nx ny nz": (XYZ, FORMS, XYZ / RANGE[:, None]),
    "x y z red green blue": (XYZ, np.floor(GENERATOR.random((COUNT, 3)) * 255)),
}


@pytest.mark.parametrize("order", ["by beam", "shuffled", "by column"])
@pytest.mark.parametrize("names", TABLES)
def test_columns_are_told_by_their_numbers(names, order):
    table = np.column_stack(TABLES[names]).astype(np.float32)
    if order != "by beam":
        keys = GENERATOR.random(COUNT) if order == "shuffled" else np.arctan2(XYZ[:, 1], XYZ[:, 0])
        table = table[np.argsort(keys, kind="stable")]
    assert row_width(table.reshape(-1)) == table.shape[1]
    told = [name if not name.startswith("column") else "-" for name in column_names(table)]
    assert " ".join(told) == names


def test_a_column_that_alternates_makes_no_wider_rows():
    """KITTI's raw scans have a remission in every second point."""
    assert row_width(np.column_stack([XYZ, FORMS * (np.arange(COUNT) % 2)]).reshape(-1)) == 4


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4", ">f8"])
@pytest.mark.parametrize("names", TABLES)
def test_rows_of_any_width_and_type_are_no_more_points_than_there_are(tmp_path, names, kind):
    table = np.column_stack(TABLES[names]).astype(np.float32)
    path = made.write(tmp_path, "a.bin", table.astype(kind).tobytes())
    cloud = open_path(path).cloud(path)
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    assert (cloud.intensity is not None) == ("intensity" in names) and (cloud.ring is not None) == ("ring" in names)


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_columns_one_after_the_other_are_told_from_rows(tmp_path, kind):
    columns = [*XYZ.T, FORMS]
    path = made.write(tmp_path, "a.bin", np.concatenate(columns).astype(kind).tobytes())
    scan, _ = interpreted(path)
    np.testing.assert_array_equal(scan.xyz, XYZ)
    np.testing.assert_allclose(scan.remission, FORMS, rtol=1e-6)


def test_an_array_with_ranges_is_told_from_one_without():
    cloud = cloud_of(np.column_stack([RANGE, XYZ, FORMS]))
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    np.testing.assert_array_equal(cloud.intensity, FORMS)


def test_bytes_that_are_no_points_are_refused(tmp_path):
    path = made.write(tmp_path, "a.bin", GENERATOR.bytes(48_000))
    with pytest.raises(InputError, match="its bytes are no points"):
        open_path(path).cloud(path)
    path = made.write(tmp_path, "b.bin", np.column_stack(TABLES["x y z intensity ring"]).astype("<f4").tobytes()[:-4])
    with pytest.raises(InputError, match="20 bytes each: 5 float32"):
        open_path(path).cloud(path)


def test_one_odd_number_condemns_no_rows(tmp_path):
    table = np.column_stack([XYZ, FORMS])
    table[7, 0], table[9, 3], table[11, 3] = 1e20, -1.0, np.nan
    path = made.write(tmp_path, "a.bin", table.astype("<f4").tobytes())
    cloud = open_path(path).cloud(path)
    assert len(cloud) == COUNT


def test_every_scan_of_kitti_has_four_columns(kitti_mini: Path):
    for file in sorted(kitti_mini.glob("sequences/*/velodyne/*.bin")):
        assert row_width(np.fromfile(file, "<f4")) == 4, file


def test_angles_of_points_are_no_remission_and_no_time(tmp_path):
    """USVInland's text: x y z, horizontal and vertical angle, range, reflectivity, time."""
    azimuth, elevation = np.degrees(np.arctan2(XYZ[:, 1], XYZ[:, 0])) % 360, np.degrees(np.arcsin(XYZ[:, 2] / RANGE))
    for angle, vertical in ((azimuth, np.round(elevation)), (np.radians(360 - azimuth), np.radians(elevation))):
        table = np.column_stack([XYZ, angle, vertical, RANGE, FORMS, TIME])
        names = column_names(table)
        assert names == ["x", "y", "z", "angle", "angle", "range", "intensity", "time"]


@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("behind", [[], [0, 0, 0, 1]])
def test_matrices_are_poses_and_no_points(before, behind, tmp_path):
    angle = np.linspace(0, 3, 300)
    turn = np.stack([np.cos(angle), -np.sin(angle), 0 * angle, 9 * angle, np.sin(angle), np.cos(angle), 0 * angle,
                     angle, 0 * angle, 0 * angle, 0 * angle + 1, 0 * angle], axis=1)  # fmt: skip
    table = np.column_stack([np.arange(300.0)[:, None][:, :before], turn, np.tile(behind, (300, 1))])
    np.savetxt(tmp_path / "poses.txt", table)
    with pytest.raises(InputError, match=r"poses.txt: holds places with orientations \(poses, a trajectory\)"):
        cloud(tmp_path / "poses.txt")
    table[:, before] *= 1.01  # no rotation: columns of points and what is known of them
    np.savetxt(tmp_path / "points.txt", table)
    assert len(cloud(tmp_path / "points.txt")) == 300


@pytest.mark.parametrize(
    "names",
    [
        "#t [ns],p_x [m],p_y [m],p_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        "time,x,y,z,qx,qy,qz,qw",
        "t,pose.x,pose.y,pose.z,orientation.x,orientation.y,orientation.z,orientation.w",
    ],
)
def test_a_quaternion_among_the_names_is_a_pose(names, tmp_path):
    (tmp_path / "a.csv").write_text(names + "\n" + "1,2,3,4,0,0,0,1\n" * 5)
    with pytest.raises(InputError, match="holds places with orientations"):
        cloud(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("x,y,z,qx,qy,qz\n" + "1,2,3,4,0,0\n" * 5)  # of no quaternion
    assert len(cloud(tmp_path / "b.csv")) == 5


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("unit_m", [1e-3, 1e-6])
def test_rows_may_be_in_millimetres_and_micrometres(unit_m, kind, tmp_path):
    np.column_stack([XYZ / unit_m, made.remission(len(XYZ))]).astype(kind).tofile(tmp_path / "a.bin")
    scan, found = interpreted(tmp_path / "a.bin")
    assert found.unit_m == unit_m
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-4)


def test_records_with_numpys_own_names_are_a_table(tmp_path):
    """numpy.genfromtxt gives f0, f1, ..."""
    table = np.column_stack([XYZ, made.remission(len(XYZ))])
    records = np.rec.fromarrays(table.T)
    (tmp_path / "a.npy").write_bytes(made.npy(np.array(records)))
    read = cloud(tmp_path / "a.npy")
    assert np.array_equal(read.xyz, XYZ) and read.intensity is not None
