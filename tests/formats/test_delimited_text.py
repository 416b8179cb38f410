"""Tables of text: headers of this field's programs, units, and numbers of other places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import decode, is_table, numbers
from lidar2pano.formats.field_names import column
from lidar2pano.formats.readers import read

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
        "field.x,field.y,field.z",  # rostopic echo -p
        "/points/x,/points/y,/points/z",  # PlotJuggler
        "arrayPosition:0,arrayPosition:1,arrayPosition:2",  # RSView
        "Location_1,Location_2,Location_3",  # MATLAB
        "Col1,Col2,Col3",
        "Easting,Northing,Elevation",
        "px py pz",
        "Scanner: 12\nDate: 2024-01-02\n\nx;y;z",
        "x,y,z\n[m],[m],[m]",
    ],
)
def test_axes_of_headers(header):
    separator = next((sign for sign in ";,\t|" if sign in header), " ")
    lines = [separator.join(row) for row in (("1.5", "2.5", "3.5"), ("4", "5", "6"))]
    cloud = decode("\n".join([header, *lines, ""]).encode(), PATH)
    assert cloud.xyz.tolist() == [[1.5, 2.5, 3.5], [4, 5, 6]] and cloud.fields == ("x", "y", "z")


def test_units_of_headers():
    text = b"TIMESTAMP (ns), RANGE (mm), REFLECTIVITY (%), X (mm), Y (cm), Z (m)\n0,1,2,3000,400,5\n1e8,1,3,1,1,1\n"
    cloud = decode(text, PATH)
    np.testing.assert_allclose(cloud.xyz[0], [3, 4, 5])
    assert cloud.time_s is not None and cloud.time_s.tolist() == pytest.approx([0, 0.1])
    assert cloud.intensity is not None and cloud.intensity.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("\u00b5m", 1e-6), ("\u03bcm", 1e-6), ("um", 1e-6), ("microns", 1e-6), ("Millimetres", 1e-3), ("meters", 1),
     ("in", 0.0254), ("inches", 0.0254), ("feet", 0.3048), ("ftUS", 1200 / 3937), ("km", 1e3)],
)  # fmt: skip
def test_units_of_length(unit, metres):
    for text in (f"x ({unit}),y [{unit}],z\n2,3,4\n", f"x,y,z\n{unit},[{unit}],-\n2,3,4\n"):
        np.testing.assert_allclose(decode(text.encode(), PATH).xyz[0], [2 * metres, 3 * metres, 4])
    assert column("x_um") == ("x", 1e-6) and column("x_in") == ("x_in", 1) and column("time [\u00b5s]").factor == 1e-6


def test_a_line_of_units_below_the_header():
    cloud = decode(b"x,y,z,time\n[mm],[cm],m,ms\n3000,400,5,0\n1,1,1,100\n", PATH)
    np.testing.assert_allclose(cloud.xyz[0], [3, 4, 5])
    assert cloud.time_s is not None and cloud.time_s.tolist() == pytest.approx([0, 0.1])


@pytest.mark.parametrize("line", ["Total: 2 points", "x,y,z", "ERROR sensor timeout"])
@pytest.mark.parametrize("place", [1, 2, 3])
def test_a_line_of_words_among_numbers_is_left_out_and_said(line, place):
    lines = ["x,y,z", "1,2,3", "4,5,6"]
    cloud = decode("\n".join([*lines[:place], line, *lines[place:], ""]).encode(), PATH)
    assert cloud.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert place == 1 or cloud.doubts == ("1 of its lines hold no numbers, and are left out",)


def test_many_lines_of_words_are_no_table_of_points():
    with pytest.raises(InputError, match="its lines are no numbers"):
        decode(b"x,y,z\n1,2,3\n" + b"one,two,three\n4,5,6\n" * 200, PATH)


def test_a_table_may_begin_with_points_without_coordinates():
    assert np.isnan(numbers(b"nan nan nan 0\n1 2 3 4\n", PATH, 4).values[0, :3]).all()
    assert np.isnan(numbers(b"-nan(ind),1.#QNAN,1.#INF,0\n1,2,3,4\n", PATH, 4).values[0, :3]).all()


def test_numbers_with_commas_that_also_separate_are_named():
    with pytest.raises(InputError, match="names 3 columns, but lines have 6; repair it, or write its numbers with p"):
        decode(b"x,y,z\n1,5,2,5,3,5\n", PATH)


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
        ('"1,5","-2,5","3,5"\n', [1.5, -2.5, 3.5]),
        ("x,y,z\r1.5,2,3\r", [1.5, 2, 3]),
        ("(1.5, 2, 3)\n(4, 5, 6)\n", [1.5, 2, 3]),
        ("1.234,5;2,0;3\n", [1234.5, 2, 3]),
        ("\u22121,5;2;3\n", [-1.5, 2, 3]),
        ("1\u202f234,5;2;3\n", [1234.5, 2, 3]),
        ("1, 2, 3\n4, 5, 6\n", [1, 2, 3]),
        ("1,2,3\n", [1, 2, 3]),
        ("1.234 2.345 3.456\n", [1.234, 2.345, 3.456]),
        ("1.5;2.5;3.5\n", [1.5, 2.5, 3.5]),
        ("# exported 1.2.2026, 12:30\n1,5;2,5;3,5\n", [1.5, 2.5, 3.5]),
        ("x y z\n 1.5D+01 -2.D0 .3d-1\n 1.0D0 2.0D0 3.0D0\n", [15, -2, 0.03]),  # Fortran
        ("0.150D+02,2,3\n", [15, 2, 3]),
        ("x;y;z\n1'234.5;-2'000'000;3\n", [1234.5, -2e6, 3]),  # Switzerland
        ("1\u2019234.5;2;3\n", [1234.5, 2, 3]),
        ('x,y,z\n"1,234.5","-2,000.0",3\n', [1234.5, -2000, 3]),  # America
        ("[1.5, 2, 3]\n[4, 5, 6]\n", [1.5, 2, 3]),  # lists of Python
        ("[[1.5, 2, 3],\n [4, 5, 6]]\n", [1.5, 2, 3]),
        ("[[ 1.5  2.   3. ]\n [ 4.   5.   6. ]]\n", [1.5, 2, 3]),  # NumPy
        (" 1.5\t  2\t3   0.5 \n 4\t5\t6 1\n", [1.5, 2, 3]),
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
    assert not is_table(b"t,ax,ay,az\n1,2,3,4\n") and not is_table(b"time,tx,ty,tz,qx,qy,qz,qw\n1,2,3,4,5,6,7,8\n")
    assert not is_table(b" ".join([b"1"] * 12) + b"\n")  # poses


@pytest.mark.parametrize(
    ("header", "encoding"),
    [
        ("X\u5750\u6807,Y\u5750\u6807,Z\u5750\u6807,\u53cd\u5c04\u5f3a\u5ea6", "gbk"),
        ("X\u5ea7\u6a19,Y\u5ea7\u6a19,Z\u5ea7\u6a19,\u53cd\u5c04\u5f37\u5ea6", "shift-jis"),
        ("x,y,z,\ubc18\uc0ac\uac15\ub3c4", "euc-kr"),
        ("x,y,z,\u0418\u043d\u0442\u0435\u043d\u0441\u0438\u0432\u043d\u043e\u0441\u0442\u044c", "cp1251"),
        ("x,y,z,Intensit\xe4t", "cp1252"),
    ],
)
def test_headers_in_older_encodings_name_the_remission(header, encoding):
    cloud = decode(header.encode(encoding) + b"\n1,2,3,0.5\n4,5,6,0.25\n", PATH)
    assert cloud.intensity is not None and cloud.intensity.tolist() == [0.5, 0.25]
    assert cloud.fields[3] == header.split(",")[3]


@pytest.mark.parametrize("quotes", ["\u201c\u201d", "\u201e\u201c", "\xab\xbb", "\uff02\uff02"])
def test_quotes_of_word_processors_are_quotes(quotes):
    lines = [["x", "y", "z", "intensity"], ["1.5", "2", "3", "0.5"], ["4", "5", "6", "0.25"]]
    text = "\n".join(",".join(f"{quotes[0]}{cell}{quotes[1]}" for cell in line) for line in lines)
    cloud = decode(text.encode(), PATH)
    assert cloud.xyz.tolist() == [[1.5, 2, 3], [4, 5, 6]] and cloud.intensity is not None


def test_signs_of_chinese_keyboards_are_separators():
    assert decode("x\uff0cy\uff0cz\n1.5\uff0c\uff0d2\uff0c3\n".encode(), PATH).xyz.tolist() == [[1.5, -2, 3]]


def test_numbers_of_rows_need_no_name():
    """R's write.table and pandas' to_string leave the name of that column out."""
    text = b"x y z intensity\n1 1.5 2 3 0.5\n2 4 5 6 0.25\n3 7 8 9 1\n"
    assert decode(text, PATH).xyz.tolist() == [[1.5, 2, 3], [4, 5, 6], [7, 8, 9]]
    with pytest.raises(InputError, match="its header names 4 columns, but lines have 5"):
        decode(b"x y z intensity\n1.5 2 3 0.5 9\n4 5 6 0.25 9\n", PATH)


@pytest.mark.parametrize("time", ["20190402T074603.248383", "2019-04-02 07:46:03.2", "2019-04-02T07:46:03Z"])
def test_times_of_a_clock_are_no_words(time, tmp_path):
    """A table without a header, and one in a file named .bin."""
    points = np.random.default_rng(0).uniform(-9, 9, (900, 3)).round(3)
    path = tmp_path / "a.bin"
    path.write_text("".join(f"{time},{x},{y},{z}\n" for x, y, z in points))
    np.testing.assert_allclose(read(path).xyz, points, atol=1e-6)


def test_a_table_with_two_columns_of_numbers_is_one_line():
    with pytest.raises(InputError, match="its lines are no points"):
        decode(b'"Point:0";"Poi19;3,837;-1,800;9\n-1,176;3,677;-', Path("a.csv"))
