"""Bulk runs over recordings: every scan is an item of its own, in any format, shard or store."""

from __future__ import annotations

import gc
import os
import random
import shutil
import signal
import time
import tracemalloc
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from bulk_runs import assert_each_once, begin, contents, job_of, manifest, run
from lidar2pano.bulk import Shard, entries
from lidar2pano.bulk.data_set import untimed, write_times
from lidar2pano.bulk.entries import SEMANTIC_KITTI
from lidar2pano.bulk.scan_reading import ScanReading
from lidar2pano.bulk.stores import SCRATCH, Folder, open_store
from lidar2pano.cli import main
from lidar2pano.cli.bulk import BAD_SCANS, TERMINATED
from lidar2pano.data.poses import lidar_poses
from lidar2pano.data.semantic_kitti import open_frame
from lidar2pano.drives.reading import ReadingOptions, ReadOptions, posed_scans
from lidar2pano.errors import InputError
from lidar2pano.formats.scan_files import read_bin, write_bin
from lidar2pano.recordings import mcap_files
from miniature import street
from miniature_recordings import START_NS, STEP_NS, TF, points, transform, write
from stand_in_pipeline import StandIn

pytestmark = pytest.mark.usefixtures("in_this_process")
COUNT = 12
DRIVE = [points(street(number, 300), START_NS + number * STEP_NS) for number in range(COUNT)]
DOUBTED = " of them doubted (see `doubts` in the manifest)"


def recorded(folder: Path, format: str = "mcap-raw", stem: str = "drive", sent=DRIVE) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return write(folder, format, sent, stem)


def keys(root: Path, shard: Shard = Shard(), **options) -> list[tuple[str, int | None]]:  # noqa: B008
    selection = ReadOptions(**options)
    return [tuple(entry.key) for entry in entries(open_store(root), shard, selection=selection)]


def images(root: Path, only: str = "") -> list[str]:
    found = entries(open_store(root), Shard(), only=only)
    return [job_of(root, "out", save=("rgb",)).outputs(entry)["rgb"] for entry in found]


# --- the same panoramas -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "format", ["bag-lz4", "db3", "folder", "folder-mcap", pytest.param("mcap", marks=pytest.mark.child), "mcap-plain"]
)
def test_scans_of_a_recording_are_those_of_files(tmp_path, format):
    for number in range(COUNT):
        (tmp_path / "files").mkdir(exist_ok=True)
        write_bin(tmp_path / "files" / f"drive-{number:06d}.bin", street(number, 300))
    root = tmp_path / "in"
    path = recorded(root / "town", format)
    assert run(job_of(tmp_path / "files", tmp_path / "wanted")) == 0
    assert run(job_of(root, tmp_path / "out")) == 0
    wanted, found = contents(tmp_path / "wanted"), contents(tmp_path / "out")
    assert {f"town/{name}": data for name, data in wanted.items() if name != "bulk.json"} == {
        name: data for name, data in found.items() if name != "bulk.json"
    }
    assert_each_once(tmp_path / "out", root, {f"town/{path.name}": COUNT})
    assert len({line["sha256"] for line in manifest(tmp_path / "out")}) == COUNT
    assert run(job_of(root / "town", tmp_path / "itself"), only=path.name) == 0  # ROOT is the recording
    assert {f"town/{name}" for name in contents(tmp_path / "itself")} >= found.keys() - {"bulk.json"}


def moving(turned: float = 0.0):
    """A drive whose points have times and whose recording holds poses: `translate` takes out its skew.

    turned  the direction in which it begins, radians.
    """
    for number in range(5):
        stamp_ns, half = START_NS + number * STEP_NS, 0.01 * number + turned / 2
        for part in range(10):
            at_ns = stamp_ns + part * STEP_NS // 10
            pose = (0.12 * (10 * number + part), 0, 0, 0, 0, np.sin(half), np.cos(half))
            yield transform(at_ns, "odom", "velodyne", pose)
        yield points(street(number, 4000), stamp_ns, time=np.linspace(0, 0.1, 4000, dtype=np.float32))


@pytest.mark.child
def test_the_bytes_are_those_of_translate(tmp_path, monkeypatch, random_weights, capsys):
    monkeypatch.chdir(tmp_path)
    recorded(tmp_path / "in", "bag", sent=moving())
    options = ["--weights", str(random_weights), "--device", "cpu", "--save", "rgb,depth"]
    assert main(["translate", "in/drive.bag", "--out", "one", *options]) == 0
    assert main(["bulk", "in", "--out", "many", "--shard", "1/2", *options]) == 0
    assert main(["bulk", "in/drive.bag", "--out", "many", "--shard", "0/2", *options]) == 0
    expected, found = contents(tmp_path / "one"), contents(tmp_path / "many")
    assert len(expected) == 10
    assert {name: found[name] for name in expected} == expected
    shutil.rmtree(tmp_path / "one")
    assert main(["bulk", "in", "--out", "later", "--every", "2", "--from", "0.1", *options]) == 0
    found = contents(tmp_path / "later")
    assert sorted(found) == [
        "bulk.json", "drive-000001.depth.png", "drive-000001.png", "drive-000003.depth.png", "drive-000003.png",
    ]  # fmt: skip
    assert all(found[name] == expected[name] for name in expected.keys() & found.keys())
    assert "2 scans: 2 written" in capsys.readouterr().out


# --- shards, kills, damage --------------------------------------------------------------------------------------------


def test_shards_take_consecutive_scans_and_read_little_else(tmp_path, monkeypatch):
    for stem in ("a", "b", "c"):
        recorded(tmp_path, "mcap", stem)
    parts = [keys(tmp_path, Shard(index, 5)) for index in range(5)]
    assert sorted(key for part in parts for key in part) == keys(tmp_path) and len(keys(tmp_path)) == 3 * COUNT
    for part in parts:
        assert 3 * 2 <= len(part) <= 3 * 3
        for name in ("a.mcap", "b.mcap", "c.mcap"):
            numbers = [number for one, number in part if one == name]
            assert len(numbers) in (2, 3) and numbers == list(range(numbers[0], numbers[-1] + 1))
    unpacked, count = mcap_files.unpacked, []
    monkeypatch.setattr(mcap_files, "unpacked", lambda chunk: count.append(0) or unpacked(chunk))
    run(job_of(tmp_path, tmp_path / "out"))
    whole = len(count)
    count.clear()
    run(job_of(tmp_path, tmp_path / "part"), Shard(2, 5))
    assert 3 * 2 <= len(count) < 0.6 * whole


@pytest.mark.child
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_kills_leave_the_bytes_of_an_undisturbed_run(tmp_path):
    root, out = tmp_path / "in", tmp_path / "out"
    recorded(root / "a", "db3")
    recorded(root / "b", "mcap")
    assert run(job_of(root, tmp_path / "whole")) == 0
    draw, kills, times = random.Random(1), 0, {}
    while kills < 6:
        process = begin(job_of(root, out, pipeline=StandIn(seconds=0.02)))
        time.sleep(draw.uniform(0.05, 0.4))
        os.kill(process, draw.choice([signal.SIGKILL, signal.SIGTERM]))
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        assert code in (0, TERMINATED, -signal.SIGKILL, -signal.SIGTERM)
        kills += 1 if code else 6  # it has ended before
        now = {path: path.stat().st_mtime_ns for path in out.rglob("*.png")}
        assert all(now[path] == stamp for path, stamp in times.items())  # nothing is done twice
        depths = {path for path in now if ".depth" in path.name}
        times = {path: now[path] for path in now if path in depths or path.with_suffix(".depth.png") in depths}
    assert run(job_of(root, out)) == 0
    assert contents(out) == contents(tmp_path / "whole")
    assert_each_once(out, root, {"a/drive.db3": COUNT, "b/drive.mcap": COUNT})
    assert not list(out.rglob(f"{SCRATCH}*"))


@pytest.mark.parametrize("format", ["bag", "mcap-plain"])
def test_a_line_that_was_lost_is_written_again(tmp_path, format):
    path = recorded(tmp_path / "in", format)
    out = tmp_path / "out"
    run(job_of(tmp_path / "in", out))
    lines = manifest(out)
    file = out / "manifest" / "0-of-1.jsonl"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:4]))
    assert run(job_of(tmp_path / "in", out)) == 0
    assert_each_once(out, tmp_path / "in", {path.name: COUNT})
    assert [line["sha256"] for line in manifest(out)] == [line["sha256"] for line in lines]


@pytest.mark.child
def test_a_damaged_recording_costs_a_line(tmp_path, capsys):
    root, out = tmp_path / "in", tmp_path / "out"
    root.mkdir()
    write_bin(root / "drive.bin", street(0, 300))
    whole = recorded(root, "mcap-raw").read_bytes()
    (root / "drive.mcap").write_bytes(whole[: len(whole) // 2])
    assert run(job_of(root, out)) == BAD_SCANS
    captured = capsys.readouterr()
    assert captured.out == f"2 scans: 1 written, 1 bad; 1{DOUBTED}\n"
    assert captured.err.count("\n") == 2 and f"{root}/drive.mcap: is damaged or cut short" in captured.err
    assert "lidar2pano: drive.bin: only 300 of its points can be used" in captured.err
    assert [line["scan"] for line in manifest(out)] == [None, None]
    assert sum(len(entries(open_store(root), Shard(index, 3))) for index in range(3)) == 2  # one shard reports it
    assert run(job_of(root, out)) == BAD_SCANS  # the outputs of drive.bin are not its own
    (root / "drive.mcap").write_bytes(whole)
    assert run(job_of(root, out)) == 0
    assert_each_once(out, root, {"drive.mcap": COUNT})


@pytest.mark.child
def test_damage_in_the_middle_costs_the_scans_that_it_hits(tmp_path, capsys):
    path = recorded(tmp_path / "in", "mcap-raw")
    data = bytearray(path.read_bytes())
    bad = street(5, 300).xyz[:50].tobytes()[:12]  # the first point of scan 5
    data[data.index(bad)] ^= 0xFF
    path.write_bytes(data)
    assert run(job_of(tmp_path / "in", tmp_path / "out")) == BAD_SCANS
    lines = manifest(tmp_path / "out")
    hit = [line["scan"] for line in lines if line["error"]]
    assert 5 in hit and len(hit) <= 6 and len(lines) == COUNT  # those of its chunk
    captured = capsys.readouterr()
    assert f"{path}: is damaged" in captured.err and captured.err.count("\n") == 2
    assert captured.err.count("only 300 of its points can be used") == 1  # once for the recording
    counts = f"{COUNT - len(hit)} written, {len(hit)} bad; {COUNT - len(hit)}{DOUBTED}"
    assert captured.out == f"{COUNT} scans: {counts}\n"


# --- which scans, and what they are called ----------------------------------------------------------------------------


def test_scans_are_chosen(tmp_path):
    recorded(tmp_path / "a", "bag")
    for number in range(4):
        (tmp_path / "b").mkdir(exist_ok=True)
        write_bin(tmp_path / "b" / f"{number:06d}.bin", street(number, 50))
    names = [f"b/{number:06d}.bin" for number in range(4)]
    assert keys(tmp_path, every=3) == [("a/drive.bag", 0), ("a/drive.bag", 3), ("a/drive.bag", 6), ("a/drive.bag", 9),
                                       (names[0], None), (names[3], None)]  # fmt: skip
    (tmp_path / "b" / "times.txt").write_text("10\n10.1\n10.2\n10.3\n")
    assert keys(tmp_path, start_s=0.15, end_s=0.35) == [
        ("a/drive.bag", 2),
        ("a/drive.bag", 3),
        (names[2], None),
        (names[3], None),
    ]
    found = entries(open_store(tmp_path), Shard(), selection=ReadOptions(start_s=0.9))
    assert [str(entry.key) for entry in found if not entry.error] == [f"a/drive.bag, scan {n}" for n in (9, 10, 11)]
    assert [entry.error for entry in found if entry.error] == [
        f"{tmp_path}/b: has no scan between --from and --to; it lasts 0.3 s"
    ]


def test_the_topic_is_named_or_a_line_says_so(tmp_path, capsys):
    other = [one._replace(topic="/rear") for one in DRIVE[:3]]
    recorded(tmp_path / "in", "mcap", sent=[*DRIVE[:3], *other])
    assert run(job_of(tmp_path / "in", tmp_path / "out")) == BAD_SCANS
    assert "holds points on /points, /rear; choose one with --topic" in capsys.readouterr().err
    job = job_of(tmp_path / "in", tmp_path / "rear", reading=ReadingOptions(selection=ReadOptions(topic="/rear")))
    assert run(job) == 0 and len(manifest(tmp_path / "rear")) == 3
    with pytest.raises(InputError, match="made with another 'topic'"):
        run(job_of(tmp_path / "in", tmp_path / "rear", reading=ReadingOptions(selection=ReadOptions(topic="/points"))))


def test_names_of_outputs(tmp_path):
    recorded(tmp_path / "x", "bag", sent=DRIVE[:2])
    recorded(tmp_path / "y", "bag", sent=DRIVE[:1])
    recorded(tmp_path / "y", "mcap", sent=DRIVE[:1])
    recorded(tmp_path / "z", "folder", sent=DRIVE[:1])
    write_bin(tmp_path / "z" / "drive-7.bin", street(0, 50))
    assert images(tmp_path) == [
        "x/drive-000000.png",
        "x/drive-000001.png",
        "y/drive.bag-000000.png",
        "y/drive.mcap-000000.png",
        "z/drive-7.png",  # recordings come behind the files of their folder
        "z/drive-000000.png",
    ]
    assert images(tmp_path / "z", "drive") == ["drive-000000.png"]
    write_bin(tmp_path / "x" / "drive-000001.bin", street(0, 50))
    assert images(tmp_path / "x") == ["drive-000001.bin.png", "drive.bag-000000.png", "drive.bag-000001.png"]
    write_bin(tmp_path / "x" / "drive.bag-000001.bin", street(0, 50))
    with pytest.raises(InputError, match="two scans would have the outputs of"):
        images(tmp_path / "x")


def test_a_recording_is_a_sequence(tmp_path, capsys):
    recorded(tmp_path / "in" / "town", "bag", "07")
    (tmp_path / "in" / "town" / "calib.txt").write_text("of another sequence")
    job = job_of(tmp_path / "in", tmp_path / "out", layout=SEMANTIC_KITTI)
    assert run(job) == 0
    sequence = tmp_path / "out" / "sequences" / "town-07"
    assert sorted(path.name for path in sequence.iterdir()) == ["pano", "pano_depth", "times.txt", "velodyne"]
    assert len(list((sequence / "pano").iterdir())) == COUNT
    scan = read_bin(sequence / "velodyne" / "000003.bin")
    np.testing.assert_array_equal(scan.xyz, street(3, 300).xyz)
    assert run(job) == 0 and "12 there before" in capsys.readouterr().out
    write_bin(tmp_path / "in" / "town" / "a.bin", street(0, 300))
    (tmp_path / "in" / "town-07").mkdir()
    write_bin(tmp_path / "in" / "town-07" / "a.bin", street(0, 300))
    with pytest.raises(InputError, match=r"'town/07.bag' and 'town-07' would both be sequence town-07|'town-07' and"):
        run(job)


def test_recordings_become_a_data_set_in_their_own_folder_and_again(tmp_path, capsys):
    recorded(tmp_path / "town", "bag", "07")
    write_bin(tmp_path / "a.bin", street(0, 300))
    job = job_of(tmp_path, tmp_path, layout=SEMANTIC_KITTI)
    assert run(job) == 0 and "13 written" in capsys.readouterr().out
    assert run(job) == 0 and "13 there before" in capsys.readouterr().out  # what was written is no scan of ROOT
    (tmp_path / "sequences" / "town-07" / "pano" / "000003.png").unlink()
    assert run(job) == 0 and "12 there before" in capsys.readouterr().out


@pytest.mark.parametrize("format", ["bag", "mcap-plain"])
def test_times_and_poses_of_a_recording(tmp_path, format):
    """They are those with which `translate` reads the recording, though the data set is read as KITTI's."""
    path = recorded(tmp_path / "in", format, sent=moving(turned=0.3))
    job = job_of(
        tmp_path / "in", tmp_path / "out", layout=SEMANTIC_KITTI, reading=ReadingOptions(selection=ReadOptions(every=4))
    )
    assert run(job) == 0
    folder = tmp_path / "out" / "sequences" / "drive"
    assert (folder / "times.txt").read_text() == "0.000000\n0.100000\n0.200000\n0.300000\n0.400000\n"
    wanted = [pose for _, pose in posed_scans(path)]
    found = lidar_poses(folder)
    assert len(wanted) == 5 and np.ptp(np.array(wanted)[:, 0, 3]) > 4
    for number, pose in enumerate(wanted):
        motion = np.linalg.inv(found.at("0")) @ found.at(f"{number:06d}")
        np.testing.assert_allclose(motion, np.linalg.inv(wanted[0]) @ pose, atol=1e-7)
        np.testing.assert_allclose(open_frame(folder.parent, f"drive/{number:06d}").pose, motion, atol=1e-12)
    np.testing.assert_allclose(found.rows[0], np.eye(4)[:3], atol=1e-9)  # the world is the first camera's frame
    assert (found.rows[4, :, 3] @ [0, 0, 1]) > 4, "camera 0 looks along z"
    again = job_of(tmp_path / "out", tmp_path / "painted", layout=SEMANTIC_KITTI)
    assert run(again) == 0, "calib.txt tells of no camera, so that scans are painted as the recording's were"
    for name in (f"sequences/drive/{part}" for part in ("times.txt", "poses.txt", "calib.txt", "pano/000004.png")):
        assert (tmp_path / "painted" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_what_is_unknown_of_times_and_poses(tmp_path):
    """A scan before the first pose has none; a damaged one has the time at which it was recorded, and none."""
    late = [one for one in moving() if one.type != TF or one.stamp_ns >= START_NS + 2 * STEP_NS]
    late = [one._replace(stamp_ns=one.stamp_ns + 20_000_000) for one in late]
    early = [points(street(9, 4000), START_NS - 10 * STEP_NS)._replace(stamp_ns=START_NS - 10 * STEP_NS + 20_000_000)]
    late[-1].fields["data"] = late[-1].fields["data"][:100]
    recorded(tmp_path / "in", "mcap", sent=[*early, *late])
    assert run(job_of(tmp_path / "in", tmp_path / "out", layout=SEMANTIC_KITTI)) == BAD_SCANS
    folder = tmp_path / "out" / "sequences" / "drive"
    times = np.loadtxt(folder / "times.txt")
    np.testing.assert_allclose(times, [0, 1, 1.1, 1.2, 1.3, 1.4], atol=1e-5)
    poses = lidar_poses(folder)
    assert poses.at("0") is None and poses.at("3") is not None and poses.at("5") is None
    assert open_frame(folder.parent, "drive/000000").pose is None
    with pytest.raises(InputError, match="or without this frame's pose"):
        open_frame(folder.parent, "drive/000000").require("pose")


def test_one_shard_writes_times(tmp_path):
    """That which takes the last scans, of however many shards; another topic's poses are not this one's."""
    recorded(tmp_path / "in", "db3", sent=moving())
    assert run(job_of(tmp_path / "in", tmp_path / "whole", layout=SEMANTIC_KITTI)) == 0
    for count in (2, 9):
        job, shards = job_of(tmp_path / "in", tmp_path / str(count), layout=SEMANTIC_KITTI), range(count)
        found = [entries(open_store(tmp_path / "in"), Shard(index, count), SEMANTIC_KITTI) for index in shards]
        assert sum(len(untimed(job, found[index], Shard(index, count))) for index in shards) == 1
        for index in shards:
            assert run(job, Shard(index, count)) == 0
        assert contents(tmp_path / str(count)) == contents(tmp_path / "whole")


def test_times_that_a_kill_has_cost(tmp_path, monkeypatch):
    recorded(tmp_path / "in", "db3", sent=moving())
    job = job_of(tmp_path / "in", tmp_path / "out", layout=SEMANTIC_KITTI)
    assert run(job) == 0
    whole, folder = contents(tmp_path / "out"), tmp_path / "out" / "sequences" / "drive"
    (sequence,) = untimed(job_of(tmp_path / "in", tmp_path / "new", layout=SEMANTIC_KITTI), entries(
        open_store(tmp_path / "in"), Shard(), SEMANTIC_KITTI), Shard())  # fmt: skip
    for lost in (["times.txt"], ["times.txt", "poses.txt"], ["times.txt", "poses.txt", "calib.txt"]):
        for name in lost:
            (folder / name).unlink()
        assert not write_times(job, *sequence, lambda: True) and not (folder / "times.txt").exists()
        assert run(job) == 0 and contents(tmp_path / "out") == whole

    def killed(store: Folder, file: Path, name: str) -> None:
        if name.endswith("poses.txt"):
            raise InputError("killed")
        put(store, file, name)

    put = Folder.put
    monkeypatch.setattr(Folder, "put", killed)
    for name in ("times.txt", "poses.txt"):
        (folder / name).unlink()
    with pytest.raises(InputError, match="killed"):
        run(job)
    assert not (folder / "times.txt").exists(), "it would say that poses.txt is there"


def test_labels_are_of_no_recording(tmp_path, capsys):
    recorded(tmp_path / "in", "bag")
    assert run(job_of(tmp_path / "in", tmp_path / "out", use_labels=True)) == BAD_SCANS
    assert capsys.readouterr().err.count("\n") == 1
    assert {line["error"] for line in manifest(tmp_path / "out")} == {
        f"{tmp_path}/in/drive.bag, scan {n}: has no labels (.label beside it, or in labels/); leave --labels out"
        for n in range(COUNT)
    }


# --- stores, memory, real files ---------------------------------------------------------------------------------------


def test_urls(tmp_path):
    import fsspec

    recorded(tmp_path / "in" / "town", "folder")
    recorded(tmp_path / "in", "bag")
    assert run(job_of(tmp_path / "in", tmp_path / "out")) == 0
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "in"), "/drives", recursive=True)
    memory.pipe_file("/drives/bad.bag", b"#ROSBAG V2.0\n")
    assert run(job_of("memory://drives", "memory://made"), Shard(0, 2)) in (0, BAD_SCANS)
    assert run(job_of("memory://drives", "memory://made"), Shard(1, 2)) in (0, BAD_SCANS)
    files = {name.removeprefix("/made/"): memory.cat_file(name) for name in memory.find("/made")}
    lines = b"".join(data for name, data in files.items() if name.startswith("manifest/")).decode()
    assert {name: data for name, data in files.items() if not name.startswith("manifest/")} == contents(
        tmp_path / "out"
    )
    assert lines.count("\n") == 2 * COUNT + 1 and "memory://drives/bad.bag: is damaged" in lines
    memory.store.clear()


@pytest.mark.parametrize("format", ["bag", "db3", "mcap"])
def test_memory_does_not_grow_with_messages(tmp_path, format, request):
    request.addfinalizer(partial(gc.set_threshold, *gc.get_threshold()))
    gc.set_threshold(700, 10, 10)  # Python's own: the tests' is higher

    def peak(count: int) -> int:
        scan = street(0, 20_000)
        sent = (points(scan, START_NS + number * STEP_NS) for number in range(count))
        path = recorded(tmp_path / str(count), format, sent=sent)
        store = open_store(path.parent)
        tracemalloc.start()
        try:
            reading = ScanReading(store, ReadingOptions())
            for entry in entries(store, Shard()):
                reading.request(entry).read(lambda _: None)
            reading.close()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(3)  # libraries are loaded
    assert peak(24) < 1.5 * peak(6)


@pytest.mark.parametrize(
    ("name", "count", "error"),
    [
        ("sample_velodyne_vlp16_gps.pcap", 4, ""),
        ("512x10_raw.bag", 1, "holds packets, not points"),
        ("rosbags_rs_test_bag_sqlite3.db3", 2, "none of its 3 points has a place"),
        ("rosbags_rs_test_bag_mcap.mcap", 2, "none of its 3 points has a place"),
        ("OS-0-128-U1_v2.3.0_1024x10.pcap", 1, ""),
    ],
)
def test_real_files(tmp_path, capsys, name, count, error):
    path = Path(__file__).resolve().parents[3] / "shared/realdata/formats" / name
    if not path.exists():
        pytest.skip("the real files are not here")
    if path.suffix == ".pcap":
        pytest.importorskip("velodyne_decoder", reason="packet captures are read by the extra 'recordings'")
    code = run(job_of(path.parent, tmp_path / "out"), only=name)
    lines = manifest(tmp_path / "out")
    if error:
        assert code == BAD_SCANS and len(lines) == count and all(error in line["error"] for line in lines)
        assert capsys.readouterr().err.count("\n") == 1
    else:
        assert code == 0 and [line["scan"] for line in lines] == list(range(count))
        parts = [entries(open_store(path.parent), Shard(index, 2), only=name) for index in range(2)]
        assert sorted(entry.key.scan for part in parts for entry in part) == list(range(count))
