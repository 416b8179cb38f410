"""Scans of files, folders and recordings, and when those of a folder were taken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

import lidar2pano
from lidar2pano.drives.folders import drive_files, times
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.formats.scan_files import write_bin
from miniature import street
from miniature_recordings import START_NS, STEP_NS, points, write

DRIVE = [points(street(number, 200), START_NS + number * STEP_NS) for number in range(5)]


def folder_of(path: Path, stems) -> list[Path]:
    path.mkdir(parents=True, exist_ok=True)
    for number, stem in enumerate(stems):
        write_bin(path / f"{stem}.bin", street(number, 200))
    return sorted(path.glob("*.bin"))


def test_scans_of_a_recording_are_those_of_the_folder(tmp_path):
    folder_of(tmp_path / "in", ["0", "1", "2", "3", "4"])
    path = write(tmp_path, "mcap", DRIVE)
    for found, wanted in zip(lidar2pano.scans(path), lidar2pano.scans(tmp_path / "in"), strict=True):
        np.testing.assert_array_equal(found.xyz, wanted.xyz)
        np.testing.assert_array_equal(found.remission, wanted.remission)
    assert [scan.name for scan in lidar2pano.scans(path, every=2, end_s=0.35)] == ["drive-000000", "drive-000002"]
    assert lidar2pano.read(path).name == "drive-000000"


def test_scans_are_read_one_at_a_time(tmp_path):
    bad = DRIVE[1]._replace(fields=DRIVE[1].fields | {"fields": []})
    found = lidar2pano.scans(write(tmp_path, "bag", [DRIVE[0], bad]))
    assert next(found).name == "drive-000000"
    with pytest.raises(InputError, match="scan 1: has no field 'x'"):
        next(found)


def test_files_of_a_path(tmp_path):
    (bag,) = [write(tmp_path, "bag", DRIVE[:1])]
    whole = write(tmp_path, "folder", DRIVE[:1], stem="whole")
    files = folder_of(tmp_path / "in", ["b", "a"])
    bag = bag.rename(tmp_path / "in" / "drive.bag")
    options = ReadOptions()
    assert drive_files(bag, options) == [bag] and drive_files(whole, options) == [whole]
    assert drive_files(tmp_path / "in", options) == [*files, bag]
    assert drive_files(tmp_path / "in", ReadOptions(every=2)) == [files[0], bag]
    assert drive_files(files[1], ReadOptions(every=2)) == [files[1]]
    with pytest.raises(InputError, match="holds no scan"):
        drive_files(tmp_path, options)


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("times.txt", "0.000000e+00\n1.037360e-01\n2.072390e-01\n", [0, 0.103736, 0.207239]),
        (
            "timestamps.txt",
            "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.067\n2011-09-26 13:02:26.2\n",
            [0, 0.102611, 0.235611],
        ),
        ("timestamps.json", json.dumps([1557539924.4, 1557539924.5, 1557539924.6]), [0, 0.1, 0.2]),
    ],
)
@pytest.mark.parametrize("beside", [True, False])
def test_times_of_a_folder(tmp_path, name, text, wanted, beside):
    files = folder_of(tmp_path / "drive" / "velodyne", ["000000", "000001", "000002"])
    ((tmp_path / "drive") if beside else files[0].parent).joinpath(name).write_text(text)
    found = times(files)
    assert np.subtract(found, found[0]) == pytest.approx(wanted, abs=2e-6)
    assert times(files[2:]) == found[2:]  # by its number


def test_times_beside_the_folder_are_found_from_inside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(folder_of(tmp_path / "velodyne", ["000000", "000001"])[0].parent)
    (tmp_path / "times.txt").write_text("0\n0.1\n")
    assert times([Path("000000.bin"), Path("000001.bin")]) == [0, 0.1]


def test_times_by_names(tmp_path):
    nanoseconds = folder_of(tmp_path / "a", ["315966265259836000", "315966265359836000"])
    assert times(nanoseconds) == pytest.approx([315966265.259836, 315966265.359836])
    assert times(folder_of(tmp_path / "b", ["1317617735000000", "1317617735100000"]))[0] == 1317617735
    assert times(folder_of(tmp_path / "c", ["000000", "000001"])) is None


@pytest.mark.parametrize(
    ("text", "says"), [("a\nb\n", "cannot be read as times"), ("1\n", "holds 1 times, none for scan 1")]
)
def test_bad_times_are_one_line(tmp_path, text, says):
    files = folder_of(tmp_path / "in", ["000000", "000001"])
    (tmp_path / "in" / "times.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        times(files)


def test_a_folder_is_chosen_by_time(tmp_path):
    files = folder_of(tmp_path / "in", [f"3159662652598{number}6000" for number in range(10, 16)])
    assert drive_files(tmp_path / "in", ReadOptions(start_s=15e-6, end_s=45e-6)) == files[2:5]
    with pytest.raises(InputError, match="has no scan between --from and --to"):
        drive_files(tmp_path / "in", ReadOptions(start_s=9.0))
