"""translate over recordings and drives: the same panoramas as of a folder, times and numbers, --follow, bad files."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from lidar2pano.cli import main
from lidar2pano.drives import reading as drive_reading
from lidar2pano.drives.reading import follow_folder
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import read_image
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.scan import Scan
from miniature import CALIB, street
from miniature_recordings import START_NS, STEP_NS, points, transform, write

COUNT = 12
pytestmark = pytest.mark.usefixtures("in_this_process")


def pose(number: int) -> tuple[float, ...]:
    return (0.8 * number, 0.0, 0.0, 0.0, 0.0, np.sin(0.01 * number), np.cos(0.01 * number))


def scan(number: int) -> Scan:
    return street(number, 4000)


def sent(**columns):
    for number in range(COUNT):
        stamp = START_NS + number * STEP_NS
        yield transform(stamp, "odom", "velodyne", pose(number))
        yield points(scan(number), stamp, **columns)


def write_folder(root: Path) -> Path:
    """The drive in SemanticKITTI's layout; its Tr is the identity, so that its poses are the sensor's."""
    folder = root / "sequences" / "00" / "velodyne"
    folder.mkdir(parents=True)
    for number in range(COUNT):
        write_bin(folder / f"{number:06d}.bin", scan(number))
    identity = "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    (folder.parent / "calib.txt").write_text(CALIB.splitlines()[0] + "\n" + identity)
    rows = []
    for number in range(COUNT):
        x, *_, sine, cosine = pose(number)
        c, s = cosine * cosine - sine * sine, 2 * sine * cosine
        rows.append(f"{c!r} {-s!r} 0 {x!r} {s!r} {c!r} 0 0 0 0 1 0".replace("np.float64(", "").replace(")", ""))
    (folder.parent / "poses.txt").write_text("\n".join(rows) + "\n")
    return folder


def outputs(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.iterdir())]


@pytest.fixture(scope="module")
def wanted(tmp_path_factory, random_weights) -> Path:
    """Panoramas of the drive's folder: `plain` of every fourth scan, everything saved, and `steady` of all."""
    root = tmp_path_factory.mktemp("wanted")
    command = ["translate", str(write_folder(root)), "--weights", str(random_weights), "--device", "cpu"]
    assert main([*command, "--every", "4", "--save", "all", "--out", str(root / "plain")]) == 0
    assert main([*command, "--steady", "--out", str(root / "steady")]) == 0
    return root


@pytest.mark.parametrize("format", [pytest.param("bag", marks=pytest.mark.child), "mcap-ros1"])
def test_a_recording_gives_the_panoramas_of_the_folder(tmp_path, translate, wanted, format):
    path = write(tmp_path, format, sent())
    assert translate(path, "--every", 4, "--out", tmp_path / "found", "--save", "all")[0] == 0
    assert outputs(wanted / "plain") == outputs(tmp_path / "found") and len(outputs(tmp_path / "found")) == 12
    assert (tmp_path / "found" / "drive-000008.depth.png").exists()


@pytest.mark.parametrize(
    ("format", "count"), [("bag", 12), pytest.param("db3", 3, marks=pytest.mark.child), ("mcap", 3), ("folder", 2)]
)
def test_a_steady_recording_gives_the_panoramas_of_the_folder(tmp_path, translate, wanted, format, count):
    path = write(tmp_path, format, sent())
    code, _, _ = translate(path, "--steady", "--to", 0.1 * count - 0.05, "--out", tmp_path / "found")
    assert code == 0 and len(outputs(tmp_path / "found")) == count
    assert outputs(wanted / "steady")[:count] == outputs(tmp_path / "found")
    assert (wanted / "steady" / "000008.png").read_bytes() != (wanted / "plain" / "000008.png").read_bytes()


def test_files_named_one_by_one_are_chosen_as_those_of_a_folder(tmp_path, translate):
    files = sorted(write_folder(tmp_path).iterdir())[:5]
    assert translate(*files, "--every", 2, "--out", tmp_path / "o")[0] == 0
    assert {image.name for image in (tmp_path / "o").glob("*.png")} == {"000000.png", "000002.png", "000004.png"}


def test_without_poses_they_are_estimated(tmp_path, translate):
    pytest.importorskip("kiss_icp", reason="poses are estimated by KISS-ICP")
    folder = write_folder(tmp_path)
    (folder.parent / "poses.txt").unlink()
    assert translate(folder, "--steady", "--every", 4, "--out", tmp_path / "wanted")[0] == 0
    path = write(tmp_path, "bag", [one for one in sent() if one.topic != "/tf"])
    assert translate(path, "--steady", "--every", 4, "--out", tmp_path / "found")[0] == 0
    assert outputs(tmp_path / "wanted") == outputs(tmp_path / "found")


def test_points_with_times_are_deskewed(tmp_path, translate, monkeypatch):
    """A recording whose points carry times gives what a recording of the deskewed points gives."""
    monkeypatch.setattr("lidar2pano.scene.depth.SPARSE", np.inf)  # jumps that rounding tips over
    from dataclasses import replace

    from lidar2pano.geometry.motion import SensorMotion, Trajectory, deskewed

    stamps_s = [(START_NS + number * STEP_NS) * 1e-9 for number in range(COUNT)]
    motion = SensorMotion((Trajectory.of([(stamp_s, *pose(n)) for n, stamp_s in enumerate(stamps_s)]),))
    time_s = np.linspace(0, 0.09, 4000).astype(np.float32)
    straight = []
    for number in range(COUNT):
        xyz = deskewed(scan(number).xyz, time_s.astype(np.float64), stamps_s[number], motion)
        straight.append(points(replace(scan(number), xyz=xyz), START_NS + number * STEP_NS))
    assert translate(write(tmp_path, "bag", straight), "--to", 0.15, "--out", tmp_path / "wanted")[0] == 0
    path = write(tmp_path, "mcap", sent(time=time_s))
    assert translate(path, "--to", 0.15, "--out", tmp_path / "found")[0] == 0
    pairs = zip(*(sorted((tmp_path / name).iterdir()) for name in ("wanted", "found")), strict=True)
    for one, other in pairs:  # points that are written and read are rounded once more
        assert np.abs(np.subtract(*(read_image(file).astype(int) for file in (one, other)))).max() <= 1
    plain = write(tmp_path, "db3", sent())
    assert translate(plain, "--to", 0.15, "--out", tmp_path / "skewed")[0] == 0
    assert outputs(tmp_path / "skewed")[1:] != outputs(tmp_path / "found")[1:]


def test_json_has_number_and_stamp(tmp_path, translate):
    path = write(tmp_path, "bag", sent())
    _, out, _ = translate(path, "--from", 0.2, "--to", 0.7, "--every", 3, "--json", "--out", tmp_path / "o")
    records = [json.loads(line) for line in out.splitlines()]
    assert [record["scan"] for record in records] == [2, 5]
    assert [record["stamp_s"] for record in records] == pytest.approx([1.7e9 + 0.2, 1.7e9 + 0.5], abs=1e-6)
    assert [record["input"] for record in records] == [str(path)] * 2
    assert records[1]["outputs"] == [str(tmp_path / "o" / "drive-000005.png")]


def test_a_folder_of_recordings_and_scans(tmp_path, translate):
    (tmp_path / "in").mkdir()
    write(tmp_path / "in", "bag", [*sent()][:2], stem="a")
    write(tmp_path / "in", "mcap", [*sent()][:2], stem="b")
    write_bin(tmp_path / "in" / "c.bin", scan(0))
    code, out, _ = translate(tmp_path / "in", "--out", tmp_path / "o")
    assert code == 0 and f"{tmp_path / 'in' / 'a.bag'}, scan 0: 4000 points;" in out
    assert f"{tmp_path / 'in' / 'c.bin'}: 4000 points;" in out
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["a-000000.png", "b-000000.png", "c.png"]


def test_a_folders_scans_are_chosen_by_their_times(tmp_path, translate):
    folder = write_folder(tmp_path)
    code, _, err = translate(folder, "--from", 0.5, "--out", tmp_path / "o")
    assert code == 2 and "--from and --to need the scans' times: times.txt" in err
    (folder.parent / "times.txt").write_text("".join(f"{0.1 * n:e}\n" for n in range(COUNT)))
    assert translate(folder, "--from", 0.45, "--to", 0.75, "--every", 2, "--out", tmp_path / "o")[0] == 0
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["000005.png", "000007.png"]


def refused(translate, tmp_path: Path, *arguments: object) -> str:
    """The one line of a command that must fail and write nothing."""
    code, out, err = translate(*arguments, "--out", tmp_path / "o")
    assert code == 2 and out == "" and err.count("\n") == 1 and not (tmp_path / "o").exists()
    return err


@pytest.mark.parametrize("format", ["bag", "db3", pytest.param("mcap", marks=pytest.mark.child)])
def test_bad_recordings_are_one_line(tmp_path, translate, format):
    path = write(tmp_path, format, sent())
    whole = path.read_bytes()
    for share in (0.0, 0.02, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(len(whole) * share)])
        assert path.name in refused(translate, tmp_path, path)
    bad = [one._replace(fields=one.fields | {"fields": []}) if one.topic == "/points" else one for one in sent()]
    path = write(tmp_path, format, bad, stem="bad")
    assert "scan 0: has no field 'x'" in refused(translate, tmp_path, path)
    assert "11 more of its scans failed" in refused(translate, tmp_path, path, "--steady")
    assert "has no topic '/other'" in refused(translate, tmp_path, path, "--topic", "/other")


def test_a_bad_scan_does_not_stop_the_others(tmp_path, translate):
    messages = [*sent()][:6]
    messages[3] = messages[3]._replace(fields=messages[3].fields | {"width": 0, "data": np.zeros(0, np.uint8)})
    path = write(tmp_path, "bag", messages)
    code, out, err = translate(path, "--out", tmp_path / "o")
    assert code == 2 and out.count(".png") == 2 and f"{path}, scan 1: holds no points" in err
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["drive-000000.png", "drive-000002.png"]


def test_damaged_poses_are_one_line(tmp_path, translate):
    path = write(tmp_path, "db3", sent())
    with sqlite3.connect(path) as database:
        database.execute(
            "UPDATE messages SET data = x'0001000001' WHERE topic_id = (SELECT id FROM topics WHERE name = '/tf')"
        )
    assert "its topic /tf must be recorded again" in refused(translate, tmp_path, path, "--steady")


# --- --follow -------------------------------------------------------------------------------------------------------


def wait_for(path: Path, seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.05)
    return path.exists()


@pytest.fixture
def follower(tmp_path, random_weights):
    """`translate --follow IN --out OUT` as a process; killed at the end if it still runs."""
    (tmp_path / "in").mkdir()
    command = [sys.executable, "-m", "lidar2pano", "translate", "--follow", "in", "--out", "out", "--device", "cpu"]
    process = subprocess.Popen(
        [*command, "--weights", str(random_weights)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    yield process
    if process.poll() is None:
        process.kill()
        process.communicate()


def test_follow_takes_what_is_complete_until_interrupted(tmp_path, follower):
    whole = write_bin_bytes(tmp_path / "whole.bin", scan(0))
    (tmp_path / "in" / "a.bin").write_bytes(whole)
    assert wait_for(tmp_path / "out" / "a.png")
    with (tmp_path / "in" / "b.bin").open("wb") as slow:  # a recorder that writes piece by piece
        for start in range(0, len(whole), 16_000):
            slow.write(whole[start : start + 16_000])
            slow.flush()
            time.sleep(0.25)
            assert not (tmp_path / "out" / "b.png").exists()
    (tmp_path / "in" / "part.tmp").write_bytes(whole[:1600])
    (tmp_path / "in" / "c.bin.part").write_bytes(whole)
    (tmp_path / "in" / "c.bin.part").rename(tmp_path / "in" / "c.bin")
    assert wait_for(tmp_path / "out" / "b.png") and wait_for(tmp_path / "out" / "c.png")
    follower.send_signal(signal.SIGINT)
    out, err = follower.communicate(timeout=30)
    assert follower.returncode == 0 and out.count(".png") == 3, err
    assert "Traceback" not in err
    assert len({path.read_bytes() for path in (tmp_path / "out").iterdir()}) == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png", "c.png"]


def write_bin_bytes(path: Path, scan: Scan) -> bytes:
    write_bin(path, scan)
    return path.read_bytes()


def aged(path: Path, content: bytes, age_s: float) -> None:
    path.write_bytes(content)
    os.utime(path, (time.time() - age_s,) * 2)


def test_follow_waits_for_what_may_still_grow(tmp_path, monkeypatch):
    monkeypatch.setattr("lidar2pano.drives.reading.GIVE_UP_S", 1000.0)
    whole = write_bin_bytes(tmp_path / "whole.bin", scan(0))
    folder, stopped, found = tmp_path / "in", threading.Event(), []
    folder.mkdir()
    aged(folder / "a.bin", whole, 50)
    aged(folder / "growing.bin", b"12345", 50)
    aged(folder / "old.bin", b"12345", 2000)
    aged(folder / "writing.bin", whole, -5)  # a clock ahead of ours
    for one in follow_folder(folder, ReadOptions(), stopped):
        name = Path(one.title).name
        if name == "old.bin":
            with pytest.raises(InputError, match="5 bytes"):
                one.cloud()
            aged(folder / "growing.bin", whole, 50)
            aged(folder / "a.bin", whole + bytes(16), 50)
            found.append((name, 0))
        else:
            found.append((name, len(one.cloud())))
        if len(found) == 5:
            stopped.set()
    assert found[:2] == [("a.bin", 4000), ("old.bin", 0)]
    assert sorted(found[2:]) == [("a.bin", 4001), ("growing.bin", 4000), ("writing.bin", 4000)]


def test_follow_calls_scans_of_all_sequences_differently(tmp_path):
    whole, stopped, stems = write_bin_bytes(tmp_path / "whole.bin", scan(0)), threading.Event(), []
    for sequence in ("00", "01", "02"):
        (tmp_path / "in" / "sequences" / sequence / "velodyne").mkdir(parents=True)
        aged(tmp_path / "in" / "sequences" / sequence / "velodyne" / "000000.bin", whole, 50)
    for one in follow_folder(tmp_path / "in", ReadOptions(), stopped):
        stems.append(one.stem)
        if len(stems) == 3:
            stopped.set()
    assert stems == ["000000", *(f"sequences-{number}-velodyne-000000.bin" for number in ("01", "02"))]


@pytest.fixture
def early():
    """Signals that come before or after a command's own handler is there: they do not end the tests."""
    found: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: found.append(number))
    yield found
    signal.signal(signal.SIGTERM, before)


def test_a_clock_that_jumps_completes_no_file(tmp_path, monkeypatch):
    write_bin(tmp_path / "a.bin", scan(0))
    monkeypatch.setattr("time.time", lambda: 1e12)
    assert not drive_reading._settled_files(tmp_path, {}, {})


def test_follow_leaves_handlers_as_they_were(tmp_path, translate, early):
    (tmp_path / "in").mkdir()
    before, over = signal.getsignal(signal.SIGTERM), threading.Event()

    def stop() -> None:
        while signal.getsignal(signal.SIGTERM) is before and not over.wait(0.05):
            pass
        if not over.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    sender = threading.Thread(target=stop)
    sender.start()
    try:
        code, out, err = translate("--follow", tmp_path / "in", "--out", tmp_path / "o")
    finally:
        over.set()
        sender.join()
    assert (code, out, err) == (0, "", "") and signal.getsignal(signal.SIGTERM) is before and not early


def test_follow_needs_one_folder(tmp_path, translate):
    write_bin(tmp_path / "a.bin", scan(0))
    assert "name one folder" in refused(translate, tmp_path, "--follow", tmp_path / "a.bin")
    assert "name one folder" in refused(translate, tmp_path, "--follow", tmp_path, tmp_path)
    assert "leave out --from and --to" in refused(translate, tmp_path, "--follow", tmp_path, "--from", "3")
