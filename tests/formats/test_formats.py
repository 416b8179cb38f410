from __future__ import annotations

import math
import os
import platform
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.errors import InputError, closest
from lidar2pano.formats import image_files
from lidar2pano.formats.image_files import MACHINE, PART, append_bytes, fast_png, read_image, write_colour, write_whole
from lidar2pano.formats.readers import read
from lidar2pano.formats.scan_files import read_bin, read_label, write_bin, write_label
from lidar2pano.geometry.projection import pixels
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View

P2 = "7.0e+02 0 6.0e+02 4.5e+01 0 7.0e+02 1.8e+02 2.0e-01 0 0 1 2.7e-03"
TR = "0 -1 0 -0.002 0 0 -1 -0.075 1 0 0 -0.27"


def some_scan(points: int = 5, name: str = "000007") -> Scan:
    generator = np.random.default_rng(0)
    xyz = generator.normal(0, 20, (points, 3)).astype(np.float32)
    return Scan(xyz=xyz, remission=generator.random(points, dtype=np.float32), name=name)


def complaint(of) -> str:
    """The InputError's text, which must be one line."""
    with pytest.raises(InputError) as caught:
        of()
    text = str(caught.value)
    assert "\n" not in text and text
    return text


def write_text(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("coder", ["zlib", "isal.isal_zlib"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (1, 5), (24, 40)])
def test_a_fast_png_holds_every_value(tmp_path: Path, shape, coder, monkeypatch):
    module = pytest.importorskip(coder)
    monkeypatch.setattr(image_files, "_zlib", lambda: module)
    colour = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    (tmp_path / "a.png").write_bytes(fast_png(colour))
    assert np.array_equal(read_image(tmp_path / "a.png"), colour)
    turned = np.rot90(colour)  # not contiguous
    (tmp_path / "b.png").write_bytes(fast_png(turned))
    assert np.array_equal(read_image(tmp_path / "b.png"), turned)


def test_the_faster_coder_is_used_where_it_is_installed(monkeypatch):
    module = pytest.importorskip("isal.isal_zlib")
    image_files._zlib.cache_clear()
    assert image_files._zlib() is module
    image_files._zlib.cache_clear()
    monkeypatch.setitem(sys.modules, "isal", None)
    assert image_files._zlib() is zlib
    image_files._zlib.cache_clear()


@pytest.mark.parametrize("image_format", ["webp", "jpeg"])
def test_other_formats_lose_a_little(tmp_path: Path, image_format):
    down, across = np.linspace(0, 255, 64)[:, None], np.linspace(0, 255, 96)
    colour = np.stack(np.broadcast_arrays(down, across, (down + across) / 2), axis=2).astype(np.uint8)
    write_colour(tmp_path / "a", colour, image_format)
    difference = np.abs(read_image(tmp_path / "a", "RGB").astype(int) - colour)
    assert 0 < difference.mean() < 4


def test_bin_there_and_back(tmp_path: Path):
    scan = some_scan()
    scan.xyz[2] = math.nan
    write_bin(tmp_path / "000007.bin", scan)
    assert (tmp_path / "000007.bin").stat().st_size == 5 * 16
    found = read(tmp_path / "000007.bin")
    np.testing.assert_array_equal(found.xyz, scan.xyz)
    np.testing.assert_array_equal(found.remission, scan.remission)
    assert found.name == "000007" and found.label is None and len(found) == 5
    assert found.xyz.flags.writeable and found.xyz.flags.c_contiguous


def test_bin_holds_x_y_z_remission(tmp_path: Path):
    path = tmp_path / "a.bin"
    np.array([[1, 2, 3, 0.5], [4, 5, 6, 0.25]], dtype="<f4").tofile(path)
    scan = read_bin(path)
    assert scan.xyz.tolist() == [[1, 2, 3], [4, 5, 6]] and scan.remission.tolist() == [0.5, 0.25]


def test_label_there_and_back(tmp_path: Path):
    ids = np.arange(20)
    write_label(tmp_path / "a.label", ids)
    np.testing.assert_array_equal(np.fromfile(tmp_path / "a.label", "<u4")[[0, 1, 19]], [0, 10, 81])
    found = read_label(tmp_path / "a.label", 20)
    assert found.tolist() == ids.tolist() and found.dtype == np.int64


def test_label_without_its_instances(tmp_path: Path):
    np.array([(3 << 16) | 252, (9 << 16) | 40], dtype="<u4").tofile(tmp_path / "a.label")
    assert read_label(tmp_path / "a.label", 2).tolist() == [1, 9]


def test_a_label_file_of_another_scan(tmp_path: Path):
    write_label(tmp_path / "a.label", np.zeros(7, np.int64))
    text = complaint(lambda: read_label(tmp_path / "a.label", 8))
    assert text == f"{tmp_path / 'a.label'}: 28 bytes, but its scan has 8 points (4 bytes each); pair them again"
    (tmp_path / "b.label").write_bytes(bytes(30))
    assert "30 bytes" in complaint(lambda: read_label(tmp_path / "b.label", 7))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (bytes(16 * 3 + 4), "52 bytes are no whole number of points"),
        (None, r"cannot be read (No such file"),
    ],
)
def test_what_is_no_bin(tmp_path: Path, content, says):
    path = tmp_path / "a.bin"
    if content is not None:
        path.write_bytes(content)
    text = complaint(lambda: read(path))
    assert text.startswith(f"{path}: ") and says in text


def test_what_is_no_label(tmp_path: Path):
    assert "cannot be read (No such file" in complaint(lambda: read_label(tmp_path / "a.label", 1))
    assert "cannot be read (Is a directory" in complaint(lambda: read_label(tmp_path, 1))


def test_what_is_of_no_format(tmp_path: Path):
    (tmp_path / "a").write_bytes(b"QIF89a" + bytes(500))
    assert "is of no format that is read (PCD, PLY, NPY" in complaint(lambda: read(tmp_path / "a"))


@pytest.mark.parametrize(
    "text", ["header:\n  name: a\n", "Car 0.00 0 -1.57 1 2 3\n", "P0 = 1 0 0 0 0 1\n", "0.1\n0.2\n"]
)
def test_a_text_of_no_table_is_shown(tmp_path: Path, text):
    (tmp_path / "a.txt").write_text(text)
    told = complaint(lambda: read(tmp_path / "a.txt"))
    assert f"is text, but no table of points (it begins {text.split(chr(10))[0]!r}); name a scan" in told


def test_closest():
    assert closest("titen", ["titan", "salsanext"]) == "; did you mean 'titan'?"
    assert closest("zzz", ["b", "a"]) == "; there is a, b"
    assert closest("zzz", []) == ""


def test_calib(tmp_path: Path):
    path = write_text(tmp_path / "calib.txt", f"P0: 1 2\ncalib_time: 09-Jan-2012 13:57:47\n\nP2: {P2}\n Tr: {TR}\n")
    calibration = read_calib(path, (1224, 370))
    assert calibration.size == (1224, 370)
    np.testing.assert_array_equal(calibration.K, [[700, 0, 600], [0, 700, 180], [0, 0, 1]])
    # pixel ~ P2 [Tr; 0 0 0 1] X, by the definition
    P, T = (
        np.array(P2.split(), float).reshape(3, 4),
        np.vstack([np.array(TR.split(), float).reshape(3, 4), [0, 0, 0, 1]]),
    )
    X = np.array([12.0, 3.0, -1.0, 1.0])
    wanted, found = P @ T @ X, calibration.K @ (calibration.T_camera_lidar @ X)[:3]
    np.testing.assert_allclose(found[:2] / found[2], wanted[:2] / wanted[2], rtol=1e-12)
    np.testing.assert_allclose(found[2], wanted[2], rtol=1e-12)


def test_calib_of_kitti(kitti_mini: Path):
    for path in sorted(kitti_mini.glob("sequences/*/calib.txt")):
        x, y, z = read_calib(path).centre
        assert 0.2 < x < 0.4 and 0 < y < 0.1 and -0.1 < z < 0, "the camera stands before, left of and below the LiDAR"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"P2: {P2}\n", "has no row Tr:"),
        (f"Tr: {TR}\n", "has no row P2:"),
        (f"P2: {P2} 1\nTr: {TR}\n", "row P2: must hold 12 finite numbers (3x4), it has 13"),
        (f"P2: {P2}\nTr: 1 2 3\n", "row Tr: must hold 12 finite numbers (3x4), it has 3"),
        (f"P2: {P2}\nTr: {TR.replace('-0.27', 'nan')}\n", "row Tr: must hold 12 finite numbers"),
        (f"P2: {P2.replace('6.0e+02', 'six')}\nTr: {TR}\n", "row P2: holds something that is no number"),
        (f"P2: {'0 ' * 12}\nTr: {TR}\n", "row P2: is no camera matrix"),
        (f"P2: 7 0 0 0 0 0 7 0 0 7 0 0\nTr: {TR}\n", "row P2: is no camera matrix"),
        (f"P2: {P2}\nTr: {'0 ' * 12}\n", "row Tr: holds no rotation"),
        (f"P2: {P2}\nTr: 0 1 0 0 0 0 -1 0 1 0 0 0\n", "row Tr: holds no rotation"),
        (f"P2: {P2}\nTr: 0 -2 0 0 0 0 -2 0 2 0 0 0\n", "row Tr: holds no rotation"),
        ("", "has no row P2:"),
    ],
)
def test_what_is_no_calib(tmp_path: Path, text, says):
    path = write_text(tmp_path / "calib.txt", text)
    found = complaint(lambda: read_calib(path))
    assert found.startswith(f"{path}: ") and says in found


def test_a_calib_that_cannot_be_read(tmp_path: Path):
    assert "cannot be read as calib.txt (No such file" in complaint(lambda: read_calib(tmp_path / "calib.txt"))
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\xfa")
    assert "cannot be read as calib.txt (not text)" in complaint(lambda: read_calib(tmp_path / "binary.txt"))


def test_a_calibration_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"K \(3, 3\), T \(4, 4\)"):
        Calibration(K=np.eye(4), T_camera_lidar=np.eye(4), size=(10, 10))
    with pytest.raises(ValueError, match="size must be positive"):
        Calibration(K=np.eye(3), T_camera_lidar=np.eye(4), size=(10, 0))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"xyz": np.zeros((5, 4), np.float32)}, r"xyz must be \(N, 3\) float32, got \(5, 4\)"),
        ({"xyz": np.zeros((5, 3))}, r"xyz must be \(N, 3\) float32, got \(5, 3\) float64"),
        ({"remission": np.zeros(4, np.float32)}, r"remission must be \(5,\) float32 like Scan.xyz, got \(4,\)"),
        ({"remission": np.zeros(5, np.uint8)}, r"remission must be \(5,\) float32 like Scan.xyz, got \(5,\) uint8"),
        ({"label": np.zeros(6, np.int64)}, r"label must be \(5,\) int64 like Scan.xyz, got \(6,\)"),
        ({"label": np.zeros(5, np.uint32)}, r"label must be \(5,\) int64 like Scan.xyz, got \(5,\) uint32"),
    ],
)
def test_a_scan_of_arrays_that_do_not_fit_is_refused(changed, says):
    fitting = {"xyz": np.zeros((5, 3), np.float32), "remission": np.zeros(5, np.float32)}
    with pytest.raises(ValueError, match=says):
        Scan(**fitting | changed)


@pytest.mark.parametrize(
    "changed",
    [
        {"rows": 0},
        {"columns": 0},
        {"up": -30.0},
        {"up": math.nan},
        {"left": 10.0, "right": 10.0},
        {"left": 270.0},
        {"kind": "Sphere"},
        {"origin": (0.0, 0.0)},
    ],
)
def test_a_view_without_an_inside_is_refused(changed):
    with pytest.raises(ValueError, match="a View "):
        View(**{"rows": 64, "columns": 2048, "up": 3.0, "down": -25.0} | changed)


@pytest.mark.parametrize("name", VIEWS)
def test_views_survive_json(name):
    import json

    view = VIEWS[name]
    assert View(**json.loads(json.dumps(view.as_dict()))) == view


def test_a_scaled_view_covers_the_same():
    half = VIEWS["panorama"].scaled(0.5)
    assert (half.rows, half.columns, half.up, half.circular) == (192, 2304, 0.24, True)
    assert VIEWS["panorama"].focal_px == pytest.approx(733.4, abs=0.05)
    assert not VIEWS["titan-front"].circular


def test_a_taller_panorama_has_the_rows_of_the_panorama_and_more():
    half = VIEWS["panorama-tall"].scaled(0.5)
    assert (half.rows % 16, half.columns, half.origin) == (0, 2304, (0.27, 0.06, -0.07))
    assert half.up > 0.4453 and half.down < -0.6249  # tangents of 24 and of 32 degrees
    slope = torch.tensor([0.2399, 0.0, -0.1, -0.2835, 0.4453, -0.6248])
    row = [
        pixels(torch.ones(6), torch.zeros(6), slope, view)[0].floor() for view in (half, VIEWS["panorama"].scaled(0.5))
    ]
    assert row[1][:4].tolist() == [0, 88, 124, 191]
    assert (row[0][:4] - row[1][:4]).unique().tolist() == [80], "the same rows, 80 of them further down"
    assert 0 <= row[0][4] < 16 and 384 <= row[0][5] < 400
    default = VIEWS["panorama"].scaled(0.5)
    assert half.between(0.24, -0.2836, 16) == default and default.between(half.up, half.down, 16) == half


@pytest.mark.parametrize(
    ("up", "down", "step", "rows", "ends"),
    [
        (0.5, -0.5, 1, 10, (0.5, -0.5)),
        (0.31, -0.5, 1, 9, (0.4, -0.5)),
        (0.1, -0.1, 1, 2, (0.1, -0.1)),
        (0.51, -0.6, 4, 18, (0.9, -0.9)),
        (0.5, 0.2, 2, 4, (0.5, 0.1)),
    ],
)
def test_rows_are_added_and_left_out_in_steps(up, down, step, rows, ends):
    view = View(rows=10, columns=20, up=0.5, down=-0.5, kind="cylinder").between(up, down, step)
    assert (view.rows, (view.up, view.down)) == (rows, pytest.approx(ends))


# --- complete or not at all -----------------------------------------------------------------------------------------


def test_a_sparse_giant_is_refused_before_it_is_read(tmp_path):
    giant = tmp_path / "giant.bin"
    with giant.open("wb") as file:
        file.truncate(100 << 30)
    with pytest.raises(InputError, match=r"giant.bin: \d+ bytes are no single scan"):
        read(giant)
    with pytest.raises(InputError, match="at most 268435456 belong there"):
        read_label(giant, 5)


def test_a_name_that_is_too_long_is_one_line(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_whole(tmp_path / f"{'n' * 252}.png", lambda path: path.write_bytes(b"1"))
    assert list(tmp_path.iterdir()) == []


def test_unfinished_files_of_dead_processes_are_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    left = tmp_path / f".{MACHINE}-{dead.pid}-1{PART}"
    running = tmp_path / f".{MACHINE}-{os.getpid()}-1{PART}"
    elsewhere = tmp_path / f".another-{MACHINE}-{dead.pid}-1{PART}"
    for part in (left, running, elsewhere):
        part.write_bytes(b"half")
    assert write_whole(tmp_path / "a", lambda path: path.write_bytes(b"1")).read_bytes() == b"1"
    assert sorted(tmp_path.iterdir()) == sorted([running, elsewhere, tmp_path / "a"])


def test_unfinished_files_of_another_container_of_the_same_name_stay(tmp_path, monkeypatch):
    """Its processes are not seen here, as if they were dead; what is a day old goes."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()

    def write(part: Path) -> None:
        monkeypatch.undo()
        image_files._sweep.cache_clear()
        write_whole(tmp_path / "b", lambda path: path.write_bytes(b"1"))
        part.write_bytes(b"1")
        old = tmp_path / f".elsewhere-1-1{PART}"
        old.touch()
        os.utime(old, (0, 0))
        image_files._sweep.cache_clear()
        write_whole(tmp_path / "b", lambda path: path.write_bytes(b"1"))
        assert part.exists() and not old.exists()

    monkeypatch.setattr(image_files, "MACHINE", f"{platform.node()[:64]}-elsewhere", raising=False)
    monkeypatch.setattr(os, "getpid", lambda: dead.pid)
    assert write_whole(tmp_path / "a", write).read_bytes() == b"1"


def test_a_short_write_is_completed_or_an_error(tmp_path, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[:3]))
    append_bytes(tmp_path / "a", b"one line\n")
    assert (tmp_path / "a").read_bytes() == b"one line\n"


def test_a_calibration_may_be_named_by_a_string(tmp_path):
    (tmp_path / "calib.txt").write_text(f"P2: {P2}\nTr: {TR}\n")
    assert np.array_equal(read_calib(str(tmp_path / "calib.txt")).K, read_calib(tmp_path / "calib.txt").K)


def test_a_scan_takes_lists():
    scan = Scan(xyz=[[1, 2, 3]], remission=[0.5], label=[7])
    assert (scan.xyz.dtype, scan.remission.dtype, scan.label.dtype) == (np.float32, np.float32, np.int64)
