"""Tables of text: headers of this field's programs, units, and numbers of other places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import column, decode, is_table

PATH = Path("a.csv")


@pytest.mark.parametrize(
    "header",
    [
        '"Point:0","Point:1","Point:2"',  # Ouster Studio
        "Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2",  # VeloView
        "Points:0,Points:1,Points:2",  # ParaView
        "Points_0,Points_1,Points_2",
        "//X,Y,Z",  # CloudCompare
        "// Scalar_X Scalar_Y Scalar_Z",
        "x [m];y [m];z [m]",
        "x [m] y [m] z [m]",
        "X (m), Y (m), Z (m)",  # ouster-cli
        "x_m|y_m|z_m",
        "position.x,position.y,position.z",
        "x_coord,y_coord,z_coord",
        "xyz[0],xyz[1],xyz[2]",
        "pos_x\tpos_y\tpos_z",
        "sep=,\nX,Y,Z",
    ],
)
def test_axes_of_headers(header):
    separator = next((sign for sign in ";,\t|" if sign in header.partition("\n")[2] or sign in header), " ")
    lines = [separator.join(row) for row in (("1.5", "2.5", "3.5"), ("4", "5", "6"))]
    cloud = decode("\n".join([header, *lines, ""]).encode(), PATH)
    assert cloud.xyz.tolist() == [[1.5, 2.5, 3.5], [4, 5, 6]] and cloud.fields == ("x", "y", "z")


def test_units_of_headers():
    text = b"TIMESTAMP (ns), RANGE (mm), REFLECTIVITY (%), X (mm), Y (cm), Z (m)\n0,1,2,3000,400,5\n1e8,1,3,1,1,1\n"
    cloud = decode(text, PATH)
    np.testing.assert_allclose(cloud.xyz[0], [3, 4, 5])
    assert cloud.time_s is not None and cloud.time_s.tolist() == pytest.approx([0, 0.1])
    assert cloud.intensity is not None and cloud.intensity.tolist() == [2, 3]


def test_remarks_in_brackets_are_no_part_of_a_name():
    cloud = decode(b"Point ID,X (m),Y (m),Z (m),Intensity (0-255)\n1,2,3,4,5\n", PATH)
    assert cloud.xyz.tolist() == [[2, 3, 4]] and cloud.intensity is not None and cloud.intensity.tolist() == [5]


def test_other_names_are_no_axes():
    for name in ("xyz", "0", "m", "points", "column 1", "ring_0", "Range (m)", "vx", "scan_2"):
        assert column(name).name not in {"x", "y", "z"}


@pytest.mark.parametrize(
    ("text", "xyz"),
    [
        ("x;y;z\n1,5;-2,25;0,1\n", [1.5, -2.25, 0.1]),
        ("1,5\t2,5\t3,5\t0,2\n4\t5\t6\t1\n", [1.5, 2.5, 3.5]),
        ("1,5 2,5 3,5\n4,5 5 6\n", [1.5, 2.5, 3.5]),
        ('"1,5";"2,5";"3,5"\n', [1.5, 2.5, 3.5]),
        ("1.234,5;2,0;3\n", [1234.5, 2, 3]),
        ("\u22121,5;2;3\n", [-1.5, 2, 3]),
        ("1\u202f234,5;2;3\n", [1234.5, 2, 3]),
        ("1, 2, 3\n4, 5, 6\n", [1, 2, 3]),
        ("1,2,3\n", [1, 2, 3]),
        ("1.234 2.345 3.456\n", [1.234, 2.345, 3.456]),
        ("1.5;2.5;3.5\n", [1.5, 2.5, 3.5]),
        ("# exported 1.2.2026, 12:30\n1,5;2,5;3,5\n", [1.5, 2.5, 3.5]),
    ],
)
def test_numbers_of_other_places(text, xyz):
    np.testing.assert_allclose(decode(text.encode(), PATH).xyz[0], xyz)


def test_a_header_without_axes_is_shown():
    with pytest.raises(InputError, match=r"names no axes \(it has Azimuth, Distance, Laser\); call three"):
        decode(b"Azimuth,Distance,Laser\n1,2,3\n", PATH)


def test_tables_of_points_among_files():
    assert is_table(b"x,y,z\n1,2,3\n") and is_table(b"2\n1 2 3 4\n5 6 7 8\n")
    assert not is_table(b"time,latitude,longitude\n1,2,3\n") and not is_table(b"read me 1 2\n1 2 3\n")
    assert not is_table(b" ".join([b"1"] * 12) + b"\n")  # poses
