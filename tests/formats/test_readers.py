"""Every format gives the points that were written, whatever the file is called, and as independent libraries do."""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lidar2pano
import sample_files as made
from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import DATATYPES, cloud_of, cloud_of_message
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.point_cloud import PointCloud, cloud_of_columns, seconds
from lidar2pano.formats.readers import open_path, read

XYZ, RING = made.street(beams=16, columns=180)
INTENSITY = np.floor(made.remission(len(XYZ), 255))
FILES = made.every_format(XYZ, RING)
FLOAT16 = {"argoverse.feather"}
MILLIMETRES = {"packed.laz", "plain.las"}


def cloud(path: Path) -> PointCloud:
    """The cloud of a file."""
    return open_path(path).cloud(path)


def complaint(of) -> str:
    """The InputError's text, which must be one line."""
    with pytest.raises(InputError) as caught:
        of()
    assert "\n" not in str(caught.value) and str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("called", ["as it is", "wrong"])
def test_every_format_gives_the_points(tmp_path, name, called):
    path = made.write(tmp_path, name if called == "as it is" else "wrong.jpeg", FILES[name])
    found = cloud(path)
    if name in FLOAT16:
        np.testing.assert_array_equal(found.xyz, XYZ.astype(np.float16).astype(np.float32))
    elif name in MILLIMETRES:
        np.testing.assert_allclose(found.xyz, XYZ, atol=0.0006)
    else:
        np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
    np.testing.assert_array_equal(found.intensity, INTENSITY)
    assert found.name == (name.split(".")[0] if called == "as it is" else "wrong")
    assert len(found.fields) >= 4 and found.format


def test_beams_and_times_are_found(tmp_path):
    found = cloud(made.write(tmp_path, "a.pcd.bin", FILES["nuscenes.pcd.bin"]))
    np.testing.assert_array_equal(found.ring, RING)
    found = cloud(made.write(tmp_path, "315966265259836000.feather", FILES["argoverse.feather"]))
    assert found.stamp_s == pytest.approx(315966265.259836) and found.time_s is not None
    np.testing.assert_allclose(found.time_s, np.arange(len(XYZ)) * 1e-6)


def test_twins_give_identical_scans(tmp_path):
    others = FLOAT16 | MILLIMETRES | {"nuscenes.pcd.bin"}  # of less digits, or with other axes
    paths = [made.write(tmp_path, name, FILES[name]) for name in FILES if name not in others]
    whole = [read(path) for path in paths]
    for scan in whole:
        np.testing.assert_array_equal(scan.xyz, whole[0].xyz)
        np.testing.assert_array_equal(scan.remission, whole[0].remission)
    assert whole[0].xyz.dtype == np.float32 and 0 < whole[0].remission.max() <= 1


def test_in_nuscenes_y_is_forward(tmp_path):
    there = np.column_stack([-XYZ[:, 1], XYZ[:, 0], XYZ[:, 2]])
    read_here = read(made.write(tmp_path, "a.pcd.bin", made.rows(there, INTENSITY, RING)))
    np.testing.assert_array_equal(read_here.xyz, XYZ)


# --- against other libraries -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["ascii", "binary", "binary_compressed"])
def test_pcd_as_pypcd4_reads_it(tmp_path, layout):
    pypcd4 = pytest.importorskip("pypcd4")
    path = made.write(
        tmp_path, "a.pcd", made.pcd(XYZ, INTENSITY, layout).replace(b" _ ", b" p ").replace(b"2 1\n", b"2 1\n")
    )
    theirs = pypcd4.PointCloud.from_path(path)
    found = cloud(path)
    np.testing.assert_array_equal(found.xyz, theirs.numpy(("x", "y", "z")))
    np.testing.assert_array_equal(found.intensity, theirs.pc_data["intensity"])
    np.testing.assert_array_equal(found.ring, theirs.pc_data["ring"])


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_as_plyfile_reads_it(tmp_path, layout):
    plyfile = pytest.importorskip("plyfile")
    path = made.write(tmp_path, "a.ply", made.ply(XYZ, INTENSITY, layout))
    vertex = plyfile.PlyData.read(path)["vertex"]
    found = cloud(path)
    np.testing.assert_array_equal(found.xyz, np.column_stack([vertex[axis] for axis in "xyz"]))
    np.testing.assert_array_equal(found.intensity, vertex["scalar_intensity"])


def test_a_compressed_pcd_that_did_not_shrink_is_read_as_it_is(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3)).astype("<f4")
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 9\nHEIGHT 1\nPOINTS 9\nDATA binary_compressed\n"
    flat = points.T.tobytes()
    stored = head + np.array([len(flat), len(flat)], "<u4").tobytes() + flat
    np.testing.assert_array_equal(cloud(made.write(tmp_path, "a.pcd", stored)).xyz, points)
    packed = bytearray(made.pcd(XYZ, INTENSITY, "binary_compressed"))
    packed[-900:] = bytes([0x20]) * 900
    assert "cannot be unpacked (" in complaint(lambda: read(made.write(tmp_path, "b.pcd", bytes(packed))))


# --- PCD and PLY -----------------------------------------------------------------------------------------------------


def test_pcd_headers_of_others(tmp_path):
    plain = made.pcd(XYZ, INTENSITY)
    changed = {
        "no comment": made.pcd(XYZ, INTENSITY, first=""),
        "width 0": plain.replace(f"WIDTH {len(XYZ)}".encode(), b"WIDTH 0"),
        "no counts at all": plain.replace(f"WIDTH {len(XYZ)}".encode(), b"WIDTH 0").replace(
            f"POINTS {len(XYZ)}".encode(), b"POINTS 0"
        ),
        "organised": plain.replace(f"WIDTH {len(XYZ)}\nHEIGHT 1".encode(), b"WIDTH 1\nHEIGHT %d" % len(XYZ)),
        "windows": plain.replace(b"DATA binary\n", b"DATA binary\r\n"),
        "columns": plain.replace(b"FIELDS", b"COLUMNS"),
        "a newline behind": plain + b"\n",
        "matlab": made.pcd(XYZ, INTENSITY, first="# This file was generated using\n # pcwrite function\n# .PCD v.7\n"),
    }
    for name, content in changed.items():
        np.testing.assert_array_equal(cloud(made.write(tmp_path, "a.pcd", content)).xyz, XYZ, err_msg=name)


def test_a_pcd_with_too_few_sizes_is_read_if_its_length_agrees(tmp_path):
    """The last of its fields has the usual type (Livox-SDK/livox_lane_detection #4)."""
    lines = b"".join(b"%f %f %f 7\n" % tuple(xyz) for xyz in XYZ.tolist())
    head = "VERSION 0.7\nFIELDS x y z class\nSIZE {0}\nTYPE {1}\nCOUNT {2}\nWIDTH {3}\nHEIGHT 1\nPOINTS {3}\nDATA {4}\n"
    short = head.format("4 4 4", "F F F", "1 1 1", len(XYZ), "ascii").encode()
    np.testing.assert_allclose(cloud(made.write(tmp_path, "a.pcd", short + lines)).xyz, XYZ, atol=1e-5)
    binary = head.format("4 4 4", "F F F", "1 1 1", len(XYZ), "binary").encode()
    rows = np.column_stack([XYZ, np.zeros(len(XYZ))]).astype("<f4")
    np.testing.assert_array_equal(cloud(made.write(tmp_path, "b.pcd", binary + rows.tobytes())).xyz, XYZ)
    doubles = binary + rows.astype(np.float64).tobytes()
    assert "more follow" in complaint(lambda: read(made.write(tmp_path, "c.pcd", doubles)))
    long = head.format("4 4 4 4 4", "F F F F", "1 1 1 1", len(XYZ), "binary").encode()
    told = complaint(lambda: read(made.write(tmp_path, "d.pcd", long + rows.tobytes())))
    assert "its header names 4 FIELDS, but has 5 in SIZE" in told


def test_a_ply_of_carla_is_mirrored_and_said_so(tmp_path):
    for further in ([("float32", "I")], [("float32", "CosAngle"), ("uint32", "ObjIdx"), ("uint32", "ObjTag")]):
        properties = "".join(
            f"property {kind} {name}\n" for kind, name in [("float32", axis) for axis in "xyz"] + further
        )
        head = f"ply\nformat ascii 1.0\nelement vertex {len(XYZ)}\n{properties}end_header\n".encode()
        lines = b"".join(b"%.4f %.4f %.4f" % tuple(xyz) + b" 1" * len(further) + b"\n" for xyz in XYZ.tolist())
        found = cloud(made.write(tmp_path, "a.ply", head + lines))
        np.testing.assert_allclose(found.xyz, XYZ * [1, -1, 1], atol=1e-4)
        assert "it was mirrored" in found.doubts[0]
    other = cloud(made.write(tmp_path, "b.ply", head.replace(b"float32", b"float") + lines))
    np.testing.assert_allclose(other.xyz, XYZ, atol=1e-4)


def test_files_without_points_say_so(tmp_path):
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    contents = {
        "a.pcd": made.pcd(nothing, none),
        "b.pcd": made.pcd(nothing, none, "ascii"),
        "a.ply": made.ply(nothing, none),
        "a.npy": made.npy(nothing),
        "a.las": made.las(nothing, none, packed=False),
    }
    for name, content in contents.items():
        path = made.write(tmp_path, name, content)
        told = complaint(lambda path=path: read(path))
        assert told.endswith(f"{name}: holds no points; name a scan that has some")


def test_a_mesh_is_doubted(tmp_path):
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header"
    content = made.ply(XYZ, INTENSITY).replace(b"end_header", faces) + bytes([3]) + bytes(12)
    assert cloud(made.write(tmp_path, "a.ply", content)).doubts == ("it has 1 faces: a mesh, and no scan of a LiDAR",)


def test_a_ply_whose_header_ends_with_a_space(tmp_path):
    content = made.ply(XYZ, INTENSITY).replace(b"end_header", b"end header")  # LSD-SLAM
    np.testing.assert_array_equal(cloud(made.write(tmp_path, "a.ply", content)).xyz, XYZ)
    assert "a line end_header" in complaint(
        lambda: read(made.write(tmp_path, "b.ply", content.replace(b"end h", b"h")))
    )


@pytest.mark.parametrize(
    "arrays",
    [
        [XYZ, INTENSITY],
        [INTENSITY, XYZ],
        [*XYZ.T, INTENSITY],
        [np.linalg.norm(XYZ, axis=1), XYZ, INTENSITY],
        [np.arange(len(XYZ)) * 7 % 19, np.column_stack([XYZ, INTENSITY])],  # labels
        [np.column_stack([XYZ, INTENSITY]), np.eye(4)],  # a pose
    ],
)
def test_arrays_of_an_npz_without_names(tmp_path, arrays):
    named = {f"arr_{place}": array for place, array in enumerate(arrays)}
    found = cloud(made.write(tmp_path, "a.npz", made.npz(**named)))
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
    assert found.intensity is not None
    np.testing.assert_array_equal(found.intensity, INTENSITY)


def test_pcd_of_doubles_keeps_them(tmp_path):
    far = np.array([[455123.123, 5412345.678, 110.25]])
    content = (
        b"VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
    )
    found = cloud(made.write(tmp_path, "a.pcd", content + far.tobytes()))
    assert found.xyz.dtype == np.float64 and (found.xyz == far).all()


def test_ply_skips_what_it_does_not_know(tmp_path):
    header = (
        b"ply\nformat binary_big_endian 1.0\nelement camera 2\nproperty double f\nelement vertex 2\n"
        b"property uchar red\nproperty float64 x\nproperty float64 y\nproperty float64 z\nelement face 1\n"
        b"property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.array([(7, 1, 2, 3), (8, 4, 5, 6)], dtype=">u1, >f8, >f8, >f8")
    found = cloud(made.write(tmp_path, "a.ply", header + bytes(16) + rows.tobytes() + b"\3" + bytes(12)))
    assert found.xyz.tolist() == [[1, 2, 3], [4, 5, 6]] and found.intensity is None


# --- text ------------------------------------------------------------------------------------------------------------

LINES = ["1 2 3 10", "4 5 6 20.5", "-7e0 +8 .9 30"]
TABLE = [[1, 2, 3], [4, 5, 6], [-7, 8, 0.9]]
TEXTS = {
    "plain": "\n".join(LINES),
    "windows": "\r\n".join(LINES) + "\r\n",
    "separator at the end": "\n".join(",".join(line.split()) + "," for line in LINES),
    "tabs": "\n".join("\t".join(line.split()) for line in LINES),
    "decimal comma": "\n".join(";".join(line.split()).replace(".", ",") for line in LINES),
    "count": "3\n" + "\n".join(LINES),
    "cloudcompare": "//X Y Z Scalar_field\n3\n" + "\n".join(LINES),
    "comments": "# made up\n" + "\n# between\n".join(LINES),
    "blank lines": "\n\n".join(LINES) + "\n\n",
    "byte order mark": "\ufeffx,y,z,intensity\n" + "\n".join(",".join(line.split()) for line in LINES),
    "quoted names": '"X","Y","Z","reflectivity"\n' + "\n".join(",".join(line.split()) for line in LINES),
    "veloview": '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","intensity"\n' + "\n".join(LINES).replace(" ", ","),
    "a column of text": "x,y,z,intensity,when\n" + "\n".join(",".join(line.split()) + ",noon" for line in LINES),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_of_others(tmp_path, name):
    found = cloud(made.write(tmp_path, "a.txt", TEXTS[name].encode()))
    np.testing.assert_allclose(found.xyz, TABLE)
    if name != "cloudcompare":
        np.testing.assert_allclose(found.intensity, [10, 20.5, 30])


def test_text_with_empty_cells_and_colours(tmp_path):
    found = cloud(made.write(tmp_path, "a.csv", b"x,y,z,intensity\n1,2,3,\n,,,\n4,5,6,9\n"))
    np.testing.assert_array_equal(found.xyz, [[1, 2, 3], [math.nan] * 3, [4, 5, 6]])
    np.testing.assert_array_equal(found.intensity, [math.nan, math.nan, 9])
    found = cloud(made.write(tmp_path, "a.xyz", b"1 2 3 255 0 17\n4 5 6 1 2 3\n"))
    assert found.fields == ("x", "y", "z", "red", "green", "blue") and found.intensity is None


# --- arrays, archives, messages, clouds of other libraries -----------------------------------------------------------


def test_arrays_of_any_shape_and_name(tmp_path):
    table = np.column_stack([XYZ, INTENSITY]).astype(np.float64)
    structured = np.zeros(len(XYZ), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("remission", "u1"), ("normal", "f4", 3)])
    for column, axis in enumerate("xyz"):
        structured[axis] = XYZ[:, column]
    structured["remission"] = INTENSITY
    half = len(XYZ) // 2 * 2
    for array, points in (
        (table, len(table)),
        (np.asfortranarray(table), len(table)),
        (table.T, len(table)),
        (table[:half].reshape(2, -1, 4), half),
        (structured, len(table)),
    ):
        for found in (cloud_of(array), cloud(made.write(tmp_path, "a.npy", made.npy(array)))):
            np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ[:points])
            np.testing.assert_array_equal(found.intensity, INTENSITY[:points])
    assert cloud_of(XYZ).intensity is None
    assert read(XYZ.tolist()).xyz.shape == XYZ.shape


def test_archives_of_any_names(tmp_path):
    x, y, z = XYZ.T
    for arrays in (
        {"data": np.column_stack([XYZ, INTENSITY])},
        {"normals": np.ones_like(XYZ), "points": XYZ, "intensity": INTENSITY[:, None]},
        {"x": x, "y": y, "z": z, "remission": INTENSITY, "pose": np.eye(4)},
        {"pose": np.eye(4), "whatever": XYZ, "reflectivity": INTENSITY, "words": np.array(["a", "b"])},
    ):
        found = cloud(made.write(tmp_path, "a.npz", made.npz(**arrays)))
        np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
        np.testing.assert_array_equal(found.intensity, INTENSITY)


def message(order: str = "<", padding: int = 3, rows: int = 2, **changed: Any) -> SimpleNamespace:
    """A PointCloud2 of XYZ and more, in `rows` rows with padding behind each, at offsets that are not aligned."""
    count = len(XYZ) // rows * rows
    names = ["z", "intensity", "x", "ring", "y", "t"]
    types = ["f4", "u1", "f8", "u2", "f4", "u4"]
    offsets = list(np.cumsum([1, *(np.dtype(of).itemsize for of in types)]))
    dtype = np.dtype({"names": names, "formats": [order + of for of in types], "offsets": offsets[:-1],
                      "itemsize": int(offsets[-1]) + 2})  # fmt: skip
    points = np.zeros(count, dtype)
    for column, axis in enumerate("xyz"):
        points[axis] = XYZ[:count, column]
    points["intensity"], points["ring"], points["t"] = INTENSITY[:count], RING[:count], np.arange(count) * 1000
    step = dtype.itemsize
    data = b"".join(row.tobytes() + bytes(padding) for row in points.reshape(rows, -1))
    number = {name: number for number, name in DATATYPES.items()}
    fields = [SimpleNamespace(name=name, offset=int(offset), datatype=number[of], count=1)
              for name, of, offset in zip(names, types, offsets, strict=False)]  # fmt: skip
    header = SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=500_000_000), frame_id="velodyne")
    whole = {"header": header, "height": rows, "width": count // rows, "fields": fields, "is_bigendian": order == ">",
             "point_step": step, "row_step": step * (count // rows) + padding, "data": data}  # fmt: skip
    return SimpleNamespace(**whole | changed)


@pytest.mark.parametrize("order", ["<", ">"])
def test_messages_of_ros(order):
    found = cloud_of_message(message(order), "scan")
    count = len(XYZ) // 2 * 2
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ[:count])
    np.testing.assert_array_equal(found.intensity, INTENSITY[:count])
    np.testing.assert_array_equal(found.ring, RING[:count])
    np.testing.assert_allclose(found.time_s, np.arange(count) * 1e-6)
    assert (found.stamp_s, found.frame, found.fields[0]) == (12.5, "velodyne", "z")
    assert len(read(message(order, rows=1, padding=0))) == len(XYZ)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"width": 10**6}, "2 x 1000000 points of 26 bytes need 52000000 bytes, but "),
        ({"width": 10**12}, "are no single sweep"),
        ({"width": 0}, "holds no points"),
        ({"point_step": 0, "data": bytes(1001)}, "points of 0 bytes need"),
        ({"fields": []}, "has no field 'x'"),
        ({"fields": [SimpleNamespace(name="x", offset=900, datatype=7, count=1)]}, "begins at byte 900 of points of"),
    ],
)
def test_messages_that_make_no_sense(changed, says):
    assert says in complaint(lambda: read(message(**changed)))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"row_step": 17}, "row_step is 17"),
        ({"row_step": 10**7}, "row_step is 10000000"),
        ({"point_step": 0}, "point_step is 0"),
        ({"row_step": 0, "point_step": 0}, "point_step is 0"),
    ],
)
@pytest.mark.parametrize("rows", [1, 2])
def test_a_step_that_is_not_needed_condemns_no_message(changed, says, rows):
    found = cloud_of_message(message(rows=rows, padding=0, **changed), "scan")
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ[: len(found)])
    assert len(found) == len(XYZ) // rows * rows and says in found.doubts[0]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"width": 0, "height": 0}, "height x width is 0 x 0, but"),
        ({"width": len(XYZ) + 7}, f"height x width is 1 x {len(XYZ) + 7}, but"),
        ({"point_step": 12}, "point_step is 12, but"),
        ({"point_step": 52}, "point_step is 52, but"),
        ({"is_bigendian": True}, "is_bigendian is True, but only the other order gives places"),
    ],
)
def test_a_number_that_the_others_contradict_condemns_no_message(changed, says):
    found = cloud_of_message(message(rows=1, padding=0, **changed), "scan")
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
    assert says in found.doubts[0]


def test_fields_of_64_bits_are_read():
    """PCL names them 9 and 10, and bool 11 (ros2/common_interfaces #300)."""
    rows = np.zeros(len(XYZ), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "u8"), ("first", "u1")])
    rows["x"], rows["y"], rows["z"] = XYZ.T
    rows["timestamp"] = 1_700_000_000_000_000_000 + np.linspace(0, 1e8, len(XYZ)).astype(np.uint64)
    kinds = {"x": 7, "y": 7, "z": 7, "timestamp": 10, "first": 11}
    fields = [SimpleNamespace(name=name, offset=rows.dtype.fields[name][1], datatype=kind, count=1)
              for name, kind in kinds.items()]  # fmt: skip
    step = rows.dtype.itemsize
    whole = {"fields": fields, "height": 1, "width": len(rows), "point_step": step, "row_step": step * len(rows),
             "is_bigendian": False, "data": rows.tobytes()}  # fmt: skip
    found = cloud_of_message(SimpleNamespace(**whole), "scan")
    assert found.time_s is not None and found.time_s[-1] == pytest.approx(0.1) and not found.doubts


def test_a_field_of_no_type_is_left_out():
    whole = message()
    next(part for part in whole.fields if part.name == "intensity").datatype = 0
    assert "field 'intensity' has a type that is none (0), and is not read" in cloud_of_message(whole, "scan").doubts


def test_a_field_beyond_the_point_is_left_out():
    whole = message()
    next(part for part in whole.fields if part.name == "intensity").offset = whole.point_step
    found = cloud_of_message(whole, "scan")
    assert found.intensity is None and found.ring is not None and "field 'intensity' begins at byte" in found.doubts[0]
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ[: len(found)])


@dataclass
class Open3D:
    points: Any


@dataclass
class Tensor:
    array: np.ndarray

    def numpy(self) -> np.ndarray:
        return self.array


@dataclass
class PyVista:
    points: np.ndarray
    point_data: dict[str, np.ndarray] = field(default_factory=dict)


def test_clouds_of_other_libraries():
    for source in (
        PyVista(XYZ, {"intensity": INTENSITY}),
        SimpleNamespace(point={"positions": Tensor(XYZ), "intensity": Tensor(INTENSITY[:, None])}),
    ):
        found = cloud_of(source)
        np.testing.assert_array_equal(found.xyz, XYZ)
        np.testing.assert_array_equal(found.intensity, INTENSITY)
    assert cloud_of(Open3D([tuple(point) for point in XYZ.tolist()])).xyz.shape == XYZ.shape


@pytest.mark.parametrize("source", [7, None, np.zeros((5, 2)), np.array(["a"]), [[1, 2], [3]], object()])
def test_what_is_no_cloud(source):
    assert complaint(lambda: read(source))


# --- times -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values", "stamp_s", "first_s", "start_s"),
    [
        ("time", np.linspace(-0.1, 0, 5, dtype=np.float32), None, -0.1, None),
        ("t", np.arange(0, 100_000_000, 25_000_000, dtype=np.uint32), 9.0, 0.0, 9.0),
        ("timestamp", np.linspace(1.7e9, 1.7e9 + 0.1, 5), None, 0.0, 1.7e9),
        ("timestamp", np.linspace(1.7e18, 1.7e18 + 1e8, 5).astype(np.int64), 1.7e9 - 1, 1.0, 1.7e9 - 1),
        ("timestamp", np.linspace(0, 1e5, 5), None, 0.0, None),
    ],
)
def test_units_of_times(name, values, stamp_s, first_s, start_s):
    found, start, odd = seconds(name, values, stamp_s)
    assert found is not None and found[0] == pytest.approx(first_s, abs=1e-6)
    assert np.ptp(found) == pytest.approx(0.1, rel=0.3) and start == start_s and not odd


def test_a_constant_time_is_none():
    assert seconds("time", np.zeros(5, np.float32), None) == (None, None, 0)
    assert cloud_of_columns({"x": XYZ[:, 0], "Y": XYZ[:, 1], "z": XYZ[:, 2]}, format="", name="a").time_s is None


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "stem"),
    [("a.pcd.bin", "a"), ("a.bin.gz", "a"), ("a.b.pcd", "a.b"), ("a.pcd.zst", "a"), ("a", "a"), (".bin", ".bin")],
)
def test_names_without_their_endings(name, stem):
    assert stem_of(Path(name)) == stem


def test_the_public_names_read_files_and_arrays(tmp_path):
    path = made.write(tmp_path, "a.bin.gz", gzip.compress(FILES["kitti.bin"]))
    np.testing.assert_array_equal(lidar2pano.read(path).xyz, lidar2pano.read(np.column_stack([XYZ, INTENSITY])).xyz)


@pytest.mark.parametrize(("ending", "pack"), [("gz", gzip.compress), ("bz2", bz2.compress), ("xz", lzma.compress)])
@pytest.mark.parametrize("name", ["kitti.bin", "header.csv"])
def test_packed_files_of_several_parts(tmp_path, ending, pack, name):
    content = FILES[name]
    whole = made.write(tmp_path, name, content)
    packed = made.write(tmp_path, f"{name}.{ending}", pack(content[:1000]) + pack(b"") + pack(content[1000:]))
    np.testing.assert_array_equal(lidar2pano.read(packed).xyz, lidar2pano.read(whole).xyz)
    assert stem_of(packed) == stem_of(whole)
    packed.write_bytes(pack(content)[:-20])
    with pytest.raises(InputError, match="cannot be unpacked .* it is damaged or cut off"):
        lidar2pano.read(packed)


EXTENSION = b"HEADER_EXT_START 2\nSENSOR_TYPE VELODYNE_LIDAR\nTIMESTAMP 1635320299.25\nHEADER_EXT_END\n"


def test_a_second_header_and_values_behind_the_fields_of_a_pcd(tmp_path):
    head, mark, lines = FILES["ascii.pcd"].partition(b"DATA ascii\n")
    rows = b"".join(line + b" 7\n" for line in lines.splitlines())
    path = made.write(tmp_path, "a.pcd", head + mark + EXTENSION + rows)
    found = cloud(path)
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
    np.testing.assert_array_equal(found.intensity, INTENSITY)
    assert found.doubts == ("its lines have 8 values for 7 of its header; those behind them are left out",)


def test_a_compressed_pcd_that_did_not_shrink(tmp_path):
    head, mark, _ = FILES["compressed.pcd"].partition(b"DATA binary_compressed\n")
    columns = b"".join(np.asarray(column, "<f4").tobytes() for column in (*XYZ.T, INTENSITY)) + bytes(4 * len(XYZ))
    sizes = np.array([len(columns)] * 2, "<u4").tobytes()
    found = cloud(made.write(tmp_path, "a.pcd", head + mark + sizes + columns))
    np.testing.assert_array_equal(found.xyz.astype(np.float32), XYZ)
    np.testing.assert_array_equal(found.intensity, INTENSITY)
