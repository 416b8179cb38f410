"""Scans are found alike by all commands, in folders, data sets and stores."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lidar2pano.bulk import Shard, entries
from lidar2pano.bulk.stores import open_store
from lidar2pano.drives.folders import drive_files, find_sources, left_out
from lidar2pano.drives.reading import scans
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ENDINGS, ReadOptions
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.scan import Scan
from miniature import street


def some_scan() -> Scan:
    return street(0, 5)


def scan_files(path: Path | str) -> list[Path]:
    return drive_files(Path(path), ReadOptions())


def complaint(of) -> str:
    """The InputError's text, which must be one line."""
    with pytest.raises(InputError) as caught:
        of()
    assert "\n" not in str(caught.value) and str(caught.value)
    return str(caught.value)


def below(root: Path) -> list[str]:
    """What `bulk` takes."""
    return [entry.key.input for entry in entries(open_store(root), Shard())]


def test_sources_of_a_file_a_folder_and_a_sequence(tmp_path: Path):
    folder = tmp_path / "sequences" / "08" / "velodyne"
    folder.mkdir(parents=True)
    for number in (5, 2, 7, 0, 3, 6, 1, 4):
        write_bin(folder / f"00000{number}.bin", some_scan())
    (folder / "readme.txt").write_text("no scan")
    (folder / "000008.bin").mkdir()
    names = [f"00000{i}.bin" for i in range(8)]
    assert [path.name for path in scan_files(folder)] == names
    assert scan_files(str(folder.parent)) == scan_files(folder)
    assert scan_files(folder / "000001.bin") == [folder / "000001.bin"]
    assert [scan.name for scan in scans(folder.parent)] == [Path(name).stem for name in names]


def test_a_source_is_read_one_scan_at_a_time(tmp_path: Path):
    write_bin(tmp_path / "a.bin", some_scan())
    (tmp_path / "b.bin").write_bytes(b"short")
    found = scans(tmp_path)
    assert next(found).name == "a"
    assert "5 bytes are no whole number" in complaint(lambda: next(found))


def test_sources_that_are_none(tmp_path: Path):
    assert complaint(lambda: scan_files(tmp_path / "nowhere")).startswith(f"{tmp_path / 'nowhere'}: does not exist")
    assert complaint(lambda: scan_files(tmp_path)).startswith(f"{tmp_path}: holds no scan (known endings: {ENDINGS[0]}")
    (tmp_path / "velodyne").mkdir()
    assert complaint(lambda: scan_files(tmp_path)).startswith(f"{tmp_path}: holds no scan (")
    os.mkfifo(tmp_path / "pipe")
    assert "is a device, FIFO or socket, no file" in complaint(lambda: scan_files(tmp_path / "pipe"))


def test_a_folder_without_permission(tmp_path: Path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(os, "scandir", refuse)
    assert "cannot be looked into (Permission denied)" in complaint(lambda: scan_files(tmp_path))


def test_folders_of_any_format(tmp_path):
    for name in ("b.pcd", "a.bin.gz", "c.LAZ"):
        put(tmp_path, name, b"")
    put(tmp_path, "calib.txt", b"1 2 3\n")
    put(tmp_path, "image.png", b"")
    assert [path.name for path in scan_files(tmp_path)] == ["a.bin.gz", "b.pcd", "c.LAZ"]


def test_a_folder_of_text_only(tmp_path):
    put(tmp_path, "readme.txt", b"read me")
    put(tmp_path, "b.xyz", b"1 2 3\n")
    put(tmp_path, "a.csv", b"x,y,z\n1,2,3\n")
    assert [path.name for path in scan_files(tmp_path)] == ["a.csv", "b.xyz"]
    assert [scan.xyz.tolist() for scan in scans(tmp_path)] == [[[1, 2, 3]]] * 2


def test_a_topic_needs_a_recording(tmp_path):
    tree(tmp_path, "a.bin")
    topic, says = ReadOptions(topic="/points"), "holds no recording; leave out --topic /points"
    assert says in complaint(lambda: drive_files(tmp_path, topic))
    assert says in complaint(lambda: entries(open_store(tmp_path), Shard(), selection=topic))
    assert "is a single scan" in complaint(lambda: list(scans(tmp_path / "a.bin", end_s=3)))
    assert "ends before it begins" in complaint(lambda: list(scans(tmp_path, start_s=5, end_s=2)))
    put(tmp_path, "b.bag", b"#ROSBAG V2.0\n")
    assert len(drive_files(tmp_path, topic)) == 2


def test_files_that_may_be_scans_are_counted(tmp_path):
    for name in ("a.bin", "b.velo", "b2.velo", "c", "f.BIN", "d/1.bin", "d/2.velo", "e/3.velo"):
        put(tmp_path, name)
        write_bin(tmp_path / name, street(0, 200))
    put(tmp_path, "e.xyz", b"1 2 3\n4 5 6\n")
    for name in ("times.txt", "poses.txt", "gps.csv"):
        put(tmp_path, name, b"1 2 3\n4 5 6\n")
    for name, content in {
        "a.png": b"\x89PNG\r\n",
        "a.json": b"{}",
        "a.label": bytes(400),
        "calib.txt": b"P2: 1 2\n",
    }.items():
        put(tmp_path, name, content)
    put(tmp_path, "notes.md", b"# Notes\nread me\n")
    said = "files that may be scans are left out ({}); `translate` takes them by name"
    names = [path.name for path in scan_files(tmp_path)]
    assert names == ["a.bin", "f.BIN"]
    assert left_out(tmp_path, names).endswith(said.format("2 .velo, 1 .xyz, 1 without ending"))
    assert left_out(tmp_path, names[:1]).endswith(said.format("2 .velo, 1 .xyz, 1 without ending")), "as by --every"
    assert left_out(tmp_path, below(tmp_path)).endswith(said.format("3 .velo, 1 .xyz, 1 without ending"))


def test_tables_alone_leave_no_table_out(tmp_path):
    for name in ("a.csv", "b.xyz", "c.xyz"):
        put(tmp_path, name, b"1 2 3\n4 5 6\n")
    assert left_out(tmp_path, ["a.csv", "b.xyz"]) == ""


# --- data sets and trees ----------------------------------------------------------------------------------------------

RADAR = b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z dyn_prop id rcs vx vy\nSIZE 4 4 4 1 2 4 4 4\n"


def put(root: Path, name: str, content: bytes = b"") -> None:
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_bytes(content)


def tree(root: Path, *names: str) -> None:
    for name in names:
        put(root, name)
        write_bin(root / name, some_scan())


@pytest.mark.parametrize(
    "names",
    [
        ["velodyne_points/data/0000000000.bin", "velodyne_points/data/0000000001.bin"],  # KITTI's raw drive
        ["d_0001_sync/velodyne_points/data/1.bin", "d_0002_sync/velodyne_points/data/1.bin"],  # and a day of them
        ["sequences/00/velodyne/000000.bin", "sequences/08/velodyne/000000.bin"],
        ["dataset/sequences/00/velodyne/000000.bin"],
        ["testing/velodyne/000000.bin", "training/velodyne/000000.bin"],
        ["training/velodyne/0000/000000.bin", "training/velodyne/0001/000000.bin"],  # KITTI's tracking
        ["samples/LIDAR_TOP/a.pcd.bin", "sweeps/LIDAR_TOP/b.pcd.bin"],
        ["sensors/lidar/315966265259836000.bin"],
    ],
)
def test_data_sets_are_read_as_a_whole(tmp_path, names):
    tree(tmp_path, *names)
    for other in ("voxels/000000.bin", "lidarseg/v1.0-mini/a_lidarseg.bin", "oxts/data/0.txt", "poses.txt", "c.txt"):
        put(tmp_path / Path(names[0]).parents[1], other, " ".join(["1"] * 12).encode())
    put(tmp_path, "samples/RADAR_FRONT/r.pcd", RADAR)
    assert [str(path.relative_to(tmp_path)) for path in scan_files(tmp_path)] == names == below(tmp_path)


def test_tables_of_poses_are_no_scans_of_a_data_set(tmp_path):
    tree(tmp_path, "sensors/lidar/315966265259836000.feather", "city_SE3_egovehicle.feather", "calibration/a.feather")
    names = ["sensors/lidar/315966265259836000.feather"]
    assert [str(path.relative_to(tmp_path)) for path in scan_files(tmp_path)] == names == below(tmp_path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"CCB2" + bytes(90), "holds no scan, but 2 .xyzw (a.xyzw is a BIN of CloudCompare); export its points"),
        (b"PK\3\4" + bytes(90), "holds no scan, but archives (a.xyzw); unpack them"),
        (bytes(90), "holds no scan (known endings"),
    ],
)
def test_what_a_folder_holds_instead_is_said(tmp_path, content, says):
    for name in ("a.xyzw", "b.xyzw", "c.other"):
        put(tmp_path, name, content if name < "c" else bytes(90))
    assert says in complaint(lambda: scan_files(tmp_path))


def test_where_the_scans_are_is_said(tmp_path):
    tree(tmp_path, *(f"lidar/front/{number}.bin" for number in range(3)), "lidar/rear/0.bin")
    text = complaint(lambda: scan_files(tmp_path))
    assert text.startswith(
        f"{tmp_path}: holds no scan itself; lidar/front below it holds 3, lidar/rear below it holds 1"
    )
    assert below(tmp_path) == [f"lidar/front/{number}.bin" for number in range(3)] + ["lidar/rear/0.bin"]
    tree(tmp_path, *(f"more/{number}/0.bin" for number in range(3)))
    assert "2 more folders hold others" in complaint(lambda: scan_files(tmp_path))


def test_numbers_are_counted(tmp_path):
    names = ["0.bin", "1.bin", "2.bin", "10.bin", "11.bin"]
    tree(tmp_path, *names)
    assert [path.name for path in scan_files(tmp_path)] == names == below(tmp_path)
    assert [path.name for path in drive_files(tmp_path, ReadOptions(every=2))] == ["0.bin", "2.bin", "11.bin"]
    (tmp_path / "times.txt").write_text("".join(f"{number / 10}\n" for number in range(12)))
    late = drive_files(tmp_path, ReadOptions(start_s=0.15, end_s=1.05))
    assert [path.name for path in late] == ["2.bin", "10.bin"]


def test_a_radars_detections_are_no_scans(tmp_path):
    put(tmp_path, "radar.pcd", RADAR)
    put(tmp_path, "lidar.pcd", b"# .PCD v0.7\nFIELDS x y z intensity\n")
    assert [path.name for path in scan_files(tmp_path)] == ["lidar.pcd"] == below(tmp_path)
    (tmp_path / "lidar.pcd").unlink()
    assert "are a radar's detections" in complaint(lambda: scan_files(tmp_path))
    at_url = find_sources(["samples/RADAR_FRONT/a.pcd", "samples/LIDAR_TOP/a.pcd.bin"])
    assert [source.name for source in at_url] == ["samples/LIDAR_TOP/a.pcd.bin"]


def test_tables_count_where_nothing_else_is(tmp_path):
    put(tmp_path, "a/1.csv", b"x,y,z\n1,2,3\n")
    put(tmp_path, "a/gps.csv", b"time,latitude,longitude\n1,2,3\n")
    put(tmp_path, "b/0.txt", b"1 2 3\n")
    tree(tmp_path, "b/0.bin")
    assert [path.name for path in scan_files(tmp_path / "a")] == ["1.csv"]
    assert [path.name for path in scan_files(tmp_path / "b")] == ["0.bin"]
    assert below(tmp_path) == ["a/1.csv", "b/0.bin"]


def test_recordings_with_and_without_a_description(tmp_path):
    for name in ("run1/metadata.yaml", "run1/a.mcap", "run2/a.mcap", "run3/a.bag", "run3/b.mcap.zst"):
        put(tmp_path, name, b"")
    assert below_sources(tmp_path) == [
        ("run1", True),
        ("run2/a.mcap", True),
        ("run3/a.bag", True),
        ("run3/b.mcap.zst", True),
    ]
    assert drive_files(tmp_path / "run1", ReadOptions()) == [tmp_path / "run1"]
    assert drive_files(tmp_path / "run2", ReadOptions()) == [tmp_path / "run2" / "a.mcap"]


def below_sources(root: Path) -> list[tuple[str, bool]]:
    names = sorted(path.relative_to(root).as_posix() for path in root.rglob("*.*"))
    return [tuple(source) for source in find_sources(names)]
