"""Bulk runs: what a shard takes, what is done already, and that a run may be killed at any time."""

from __future__ import annotations

import json
import os
import platform
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bulk_runs import SCANS, assert_each_once, begin, contents, job_of, manifest, run
from lidar2pano.bulk import Entry, ScanKey, Shard, entries, stores
from lidar2pano.bulk.data_set import grow
from lidar2pano.bulk.entries import SEMANTIC_KITTI
from lidar2pano.bulk.stores import SCRATCH, open_store
from lidar2pano.cli.bulk import BAD_SCANS, TERMINATED
from lidar2pano.data.layouts import frames
from lidar2pano.drives.reading import Overrides, ReadingOptions
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import read_image
from lidar2pano.geometry.camera import CUBE_AXES
from lidar2pano.labels import COMMON15
from random_weights import CALIB, street, write_scan
from slow_definitions import grow_slowly
from stand_in_pipeline import StandIn

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture
def root(tmp_path):
    """Scans in three folders, one of them packed into a sequence."""
    folders = ["a", "b", "sequences/03/velodyne"]
    for number in range(SCANS):
        write_scan(tmp_path / "in" / folders[number % 3] / f"{number:06d}.bin", street(50, seed=number))
    return tmp_path / "in"


# --- killed runs ------------------------------------------------------------------------------------------------------


def killed(process: int, sign: signal.Signals, seconds: float) -> bool:
    """Whether a process ran for so long and was killed then; its exit code is 0 if it ended before."""
    time.sleep(seconds)
    os.kill(process, sign)
    _, status = os.waitpid(process, 0)
    code = os.waitstatus_to_exitcode(status)
    assert code in (0, TERMINATED, -signal.SIGKILL, -signal.SIGTERM)
    return code != 0


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_twenty_kills_leave_the_bytes_of_an_undisturbed_run(root, tmp_path):
    assert run(job_of(root, tmp_path / "whole")) == 0
    expected = contents(tmp_path / "whole")
    assert len(expected) == 2 * SCANS + 1
    draw, kills, number = random.Random(3), 0, 0
    while kills < 20:
        job = job_of(root, tmp_path / f"killed-{number}", pipeline=StandIn(seconds=0.002))
        if killed(begin(job), draw.choice([signal.SIGKILL, signal.SIGTERM]), draw.uniform(0, 0.12)):
            kills += 1
        else:
            number += 1
    for one in range(number + 1):
        out = tmp_path / f"killed-{one}"
        assert run(job_of(root, out)) == 0
        assert contents(out) == expected
        assert_each_once(out, root)
        assert not list(out.rglob(f"{SCRATCH}*"))


@pytest.mark.child
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_two_at_once_in_one_folder_give_the_bytes_of_one(root, tmp_path):
    assert run(job_of(root, tmp_path / "whole")) == 0
    processes = [begin(job_of(root, tmp_path / "both", pipeline=StandIn(seconds=0.002))) for _ in range(2)]
    assert [os.waitstatus_to_exitcode(os.waitpid(one, 0)[1]) for one in processes] == [0, 0]
    assert contents(tmp_path / "both") == contents(tmp_path / "whole")
    assert not list((tmp_path / "both").rglob(f"{SCRATCH}*"))


def test_sigterm_finishes_what_was_begun(root, tmp_path):
    process = begin(job_of(root, tmp_path / "out", pipeline=StandIn(seconds=0.05)))
    while not list(tmp_path.glob("out/a/*.png")):
        time.sleep(0.01)
    os.kill(process, signal.SIGTERM)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == TERMINATED
    done = manifest(tmp_path / "out")
    assert 0 < len(done) < SCANS
    assert len(contents(tmp_path / "out")) == 2 * len(done) + 1  # nothing of others


# --- going on ---------------------------------------------------------------------------------------------------------


def test_a_second_run_does_nothing(root, tmp_path, capsys):
    assert run(job_of(root, tmp_path / "out")) == 0
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}
    assert run(job_of(root, tmp_path / "out")) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")} == before
    assert capsys.readouterr().out.splitlines() == [
        "24 scans: 24 written; 24 of them doubted (see `doubts` in the manifest)",
        "24 scans: 24 there before",
    ]


def test_what_lacks_one_output_is_made_again(root, tmp_path):
    out = tmp_path / "out"
    run(job_of(root, out))
    expected = contents(out)
    (out / "a" / "000000.depth.png").unlink()
    (out / "b" / "000001.png").unlink()
    run(job_of(root, out))
    assert contents(out) == expected
    assert_each_once(out, root)


def test_the_manifest_is_put_right(root, tmp_path):
    out = tmp_path / "out"
    run(job_of(root, out))
    path = out / "manifest" / "0-of-1.jsonl"
    lines = path.read_text().splitlines()
    odd = [json.dumps(json.loads(lines[0]) | {"input": "odd.bin", "outputs": outputs}) for outputs in ([5], [["a"]])]
    path.write_text("\n".join([lines[0], lines[0], *odd, *lines[2:-1], lines[-1][:40]]))  # twice, lost, odd, torn
    run(job_of(root, out))
    assert_each_once(out, root)
    lost = {line["input"]: line for line in manifest(out)}[json.loads(lines[1])["input"]]
    forgotten = {"milliseconds": {}, "doubts": []}
    assert lost | {"points": 50, "dropped": 0} | forgotten == json.loads(lines[1]) | forgotten


@pytest.mark.child
def test_a_bad_scan_costs_a_line_and_is_tried_again(root, tmp_path, capsys):
    (root / "a" / "000000.bin").write_bytes(b"12345")
    far = street(50)
    for axis, name in enumerate(("refused", "bug")):
        far.xyz[0] = 0
        far.xyz[0, axis] = 2000
        write_scan(root / f"{name}.bin", far)
    assert run(job_of(root, tmp_path / "out")) == BAD_SCANS
    captured = capsys.readouterr()
    assert captured.out == "26 scans: 23 written, 3 bad; 23 of them doubted (see `doubts` in the manifest)\n"
    doubts = [line for line in captured.err.splitlines() if "only 50 of its points" in line]
    assert len(doubts) == len({path.parent for path in root.rglob("*.bin")})  # once a folder
    assert [line.split(": ")[1] for line in captured.err.splitlines() if line not in doubts] == [
        "bug.bin",
        f"{root}/refused.bin",
        f"{root}/a/000000.bin",
    ]
    errors = [line for line in manifest(tmp_path / "out") if line["error"]]
    assert len(manifest(tmp_path / "out")) == 26 and len(errors) == 3
    assert all(len(line["sha256"]) == 64 for line in errors)
    assert errors[0]["error"] == "bug.bin: RuntimeError: a bug" and errors[0]["outputs"] == []
    for name in ("a/000000", "bug", "refused"):
        write_scan(root / f"{name}.bin", street(50))
    assert run(job_of(root, tmp_path / "out")) == 0
    assert_each_once(tmp_path / "out", root)


def test_overrides_and_strictness(root, tmp_path):
    assert run(job_of(root, tmp_path / "out", reading=ReadingOptions(strict=True))) == BAD_SCANS
    assert all("an error because of --strict" in line["error"] for line in manifest(tmp_path / "out"))
    turned = job_of(root, tmp_path / "turned", reading=ReadingOptions(overrides=Overrides(forward="y")))
    assert run(turned) == 0
    assert json.loads((tmp_path / "turned" / "bulk.json").read_text())["forward"] == "y"
    with pytest.raises(InputError, match="made with another 'forward'"):
        run(replace(turned, reading=ReadingOptions()))
    assert run(job_of(root, tmp_path / "plain")) == 0
    assert contents(tmp_path / "plain")["a/000000.depth.png"] != contents(tmp_path / "turned")["a/000000.depth.png"]


def test_other_settings_are_refused(root, tmp_path):
    out = tmp_path / "out"
    run(job_of(root, out))
    with pytest.raises(InputError, match="made with another 'weights'; choose another --out"):
        run(job_of(root, out, weights="other"))
    (out / "bulk.json").unlink()
    with pytest.raises(InputError, match=r"000000\.png: is there already, but no bulk\.json"):
        run(job_of(root, out))
    with pytest.raises(InputError, match="is the folder of the scans"):
        run(job_of(root, root))


def test_other_image_formats(root, tmp_path):
    assert run(job_of(root, tmp_path / "out", image_format="jpeg")) == 0
    assert run(job_of(root, tmp_path / "out", image_format="jpeg")) == 0
    assert read_image(tmp_path / "out" / "a" / "000000.jpg", "RGB").shape == (24, 288, 3)
    assert not list(tmp_path.glob("out/*/*[0-9].png"))


@pytest.mark.parametrize(
    ("projection", "files"),
    [
        ("equirectangular", ["000000.depth.png", "000000.jpg", "000000.label"]),
        ("cubemap", sorted(f"000000.{face}{ending}" for face in CUBE_AXES for ending in (".jpg", ".depth.png"))),
    ],
)
def test_other_projections(root, tmp_path, projection, files):
    settings = {"image_format": "jpeg", "projection": projection, "save": ("depth", "rgb", "labels")}
    job = job_of(root, tmp_path / "out", **settings)
    assert run(job) == 0
    files = sorted({*files, "000000.label"})
    assert sorted(path.name for path in (tmp_path / "out" / "a").glob("000000.*")) == files
    listed = {name for record in manifest(tmp_path / "out") for name in record["outputs"]}
    assert listed == contents(tmp_path / "out").keys() - {"bulk.json"}
    before = contents(tmp_path / "out")
    assert run(job) == 0 and contents(tmp_path / "out") == before
    with pytest.raises(InputError, match="made with another 'projection'"):
        run(replace(job, projection="cylinder"))
    with Image.open(next((tmp_path / "out" / "a").glob("000000*.jpg"))) as image:
        assert image.format == "JPEG"


# --- shards -----------------------------------------------------------------------------------------------------------


def test_shards_together_are_the_whole(root, tmp_path):
    run(job_of(root, tmp_path / "whole"))
    for index in (0, 1):
        run(job_of(root, tmp_path / "parts"), Shard(index, 2))
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    assert_each_once(tmp_path / "parts", root)
    run(job_of(root, tmp_path / "parts"), Shard(1, 3))  # divided otherwise: nothing is entered twice
    assert_each_once(tmp_path / "parts", root)


def test_a_scan_stays_in_its_shard(root):
    def taken() -> list[set[str]]:
        return [{entry.key.input for entry in entries(open_store(root), Shard(index, 3))} for index in range(3)]

    before = taken()
    assert sum(map(len, before)) == len(set().union(*before)) == SCANS
    assert all(before)
    for number in range(100, 110):
        write_scan(root / "a" / f"{number}.bin", street(5))
    assert all(old <= new for old, new in zip(before, taken(), strict=True))
    assert [Shard(index, 3).takes("a/000000.bin") for index in range(3)] == [True, False, False]  # on any machine


@pytest.mark.parametrize("text", ["1", "2/2", "-1/2", "a/b", "0/0", "1/2/3", ""])
def test_shards_that_are_none(text):
    with pytest.raises(InputError, match="--shard"):
        Shard.parsed(text)
    assert Shard.parsed("3/8") == Shard(3, 8)


# --- names ------------------------------------------------------------------------------------------------------------


def stems(root: Path) -> dict[str, str]:
    return {str(entry.key): entry.stem for entry in entries(open_store(root), Shard())}


def test_names_of_outputs(tmp_path):
    for name in ("x/a.bin", "x/a.pcd", "x/b.bin.gz", "y/a.bin", "y/c.bin", "y/c.depth.bin", "y/e.pcd.bin", ".z/d.bin"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert stems(tmp_path) == {
        "x/a.bin": "x/a.bin",
        "x/a.pcd": "x/a.pcd",
        "x/b.bin.gz": "x/b",
        "y/a.bin": "y/a",
        "y/c.bin": "y/c.bin",  # its depth would be y/c.depth.png, and so would the other's colours
        "y/c.depth.bin": "y/c.depth.bin",
        "y/e.pcd.bin": "y/e",  # as `translate` calls it
    }
    (tmp_path / "x" / "a.bin.pcd").touch()
    with pytest.raises(InputError, match="two scans would have the outputs"):
        stems(tmp_path)
    with pytest.raises(InputError, match="holds no scan"):
        stems(tmp_path / ".z" / "nothing")


def test_a_folder_that_is_linked_into_itself_is_listed_once(tmp_path):
    write_scan(tmp_path / "a" / "x.bin", street(50))
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert list(stems(tmp_path)) == ["a/x.bin"]


def test_names_in_a_data_set():
    entry = Entry(
        key=ScanKey("town/sequences/07/velodyne/000012.bin"), stem="town/sequences/07/velodyne/000012", label="x"
    )
    assert job_of("in", "out", save=("rgb", "segments"), layout=SEMANTIC_KITTI).outputs(entry) == {
        "rgb": "sequences/town-07/pano/000012.png",
        "segments": "sequences/town-07/pano_labels/000012.png",
        "instances": "sequences/town-07/pano_instances/000012.png",
    }
    assert job_of("in", "out", save=("labels",), layout=SEMANTIC_KITTI).outputs(
        Entry(key=ScanKey("a.bin"), stem="a")
    ) == {"labels": "sequences/00/predicted_labels/a.label"}


# --- data sets --------------------------------------------------------------------------------------------------------


def labelled(root: Path, raw: int = 10, instance: int = 7) -> Path:
    """A sequence with calibration whose points are all of one raw class and instance."""
    for number in range(2):
        write_scan(root / "sequences" / "00" / "velodyne" / f"{number:06d}.bin", street(50, seed=number))
        path = root / "sequences" / "00" / "labels" / f"{number:06d}.label"
        path.parent.mkdir(exist_ok=True)
        np.full(50, instance << 16 | raw, dtype="<u4").tofile(path)
    (root / "sequences" / "00" / "calib.txt").write_text(CALIB)
    (root / "splits.json").write_text('{"val": ["00/000000", "00/000001"]}')
    return root


def test_a_data_set_is_read_back(tmp_path):
    root = labelled(tmp_path / "in")
    save = ("rgb", "segments", "depth")
    assert run(job_of(root, root, save=save, layout=SEMANTIC_KITTI)) == 0
    frame = frames(root, "val")[1]
    assert frame.panorama is not None and frame.panorama.labels is not None and frame.panorama.depth_m is not None
    assert frame.panorama.image.shape == (24, 288, 3)
    run(job_of(root, tmp_path / "out", save=save, layout=SEMANTIC_KITTI))
    there, beside = contents(tmp_path / "out"), contents(root)
    assert there.keys() - {"bulk.json"} >= {"splits.json", "sequences/00/calib.txt"}
    assert all(beside[name] == data for name, data in there.items())
    run(job_of(root, tmp_path / "own", save=save))  # not from the camera's place
    assert there["sequences/00/pano/000001.png"] != contents(tmp_path / "own")["sequences/00/velodyne/000001.png"]


def test_labels_take_the_segmenters_place(tmp_path):
    root = labelled(tmp_path / "in", raw=40)
    write_scan(root / "b.bin", street(50))
    assert run(job_of(root, tmp_path / "out", save=("labels",), use_labels=True)) == BAD_SCANS
    assert "b.bin: has no labels" in next(line["error"] for line in manifest(tmp_path / "out") if line["error"])
    values = np.fromfile(tmp_path / "out" / "sequences" / "00" / "velodyne" / "000000.label", "<u4")
    assert (values == 40).all()


def test_labels_of_another_scan_are_refused(tmp_path):
    root = labelled(tmp_path / "in")
    write_scan(root / "sequences" / "00" / "velodyne" / "000000.bin", street(49))
    assert run(job_of(root, tmp_path / "out", use_labels=True)) == BAD_SCANS
    assert "its scan has 49 points" in next(line["error"] for line in manifest(tmp_path / "out") if line["error"])


def test_instances_lie_on_their_class(tmp_path):
    root = labelled(tmp_path / "in", raw=10, instance=300)
    run(job_of(root, tmp_path / "out", save=("segments",), layout=SEMANTIC_KITTI))
    at = tmp_path / "out" / "sequences" / "00"
    instances, segments = (
        read_image(at / "pano_instances" / "000000.png"),
        read_image(at / "pano_labels" / "000000.png"),
    )
    assert instances.dtype == np.uint16 and set(np.unique(instances)) == {0, 300}
    assert (segments[instances > 0] == COMMON15.id_of("car")).all()


@pytest.mark.parametrize("seed", range(4))
def test_growing(seed):
    generator = torch.Generator().manual_seed(seed)
    inside = torch.rand(9, 14, generator=generator) < 0.7
    seeds = torch.randint(1, 0xFFFF, (9, 14), generator=generator) * (torch.rand(9, 14, generator=generator) < 0.1)
    seeds *= inside
    assert torch.equal(grow(seeds, inside, 3), grow_slowly(seeds, inside, 3))


# --- stores -----------------------------------------------------------------------------------------------------------


def test_urls(root, tmp_path):
    import fsspec

    run(job_of(root, tmp_path / "out"))
    expected = contents(tmp_path / "out")
    assert run(job_of(f"file://{root}", f"file://{tmp_path / 'again'}")) == 0
    assert contents(tmp_path / "again") == expected
    memory = fsspec.filesystem("memory")
    memory.put(str(root), "/scans", recursive=True)
    memory.pipe_file("/scans/bad.bin", b"123")
    assert run(job_of("memory://scans", "memory://panoramas")) == BAD_SCANS
    files = {name.removeprefix("/panoramas/"): memory.cat_file(name) for name in memory.find("/panoramas")}
    lines = [json.loads(line) for line in files.pop("manifest/0-of-1.jsonl").splitlines()]
    assert files == expected
    assert len(lines) == SCANS + 1
    assert "memory://scans/bad.bin: 3 bytes" in next(line["error"] for line in lines if line["error"])
    memory.rm_file("/scans/bad.bin")
    memory.rm_file("/panoramas/a/000000.png")
    assert run(job_of("memory://scans", "memory://panoramas")) == 0
    lines = [json.loads(line) for line in memory.cat_file("/panoramas/manifest/0-of-1.jsonl").splitlines()]
    assert Counter(line["input"] for line in lines).most_common(1)[0][1] == 1 and len(lines) == SCANS
    memory.store.clear()


def test_an_unknown_protocol():
    with pytest.raises(InputError, match="nosuch://x: cannot be opened"):
        open_store("nosuch://x")


def test_other_machines_unfinished_files_stay_for_a_day(tmp_path):
    store = open_store(tmp_path)
    fresh, old = tmp_path / f"{SCRATCH}elsewhere-7-abc", tmp_path / f"{SCRATCH}elsewhere-8-abc"
    fresh.mkdir()
    old.mkdir()
    os.utime(old, (0, 0))
    with store.scratch() as folder:
        assert folder.is_dir()
    assert sorted(tmp_path.iterdir()) == [fresh]


def test_unfinished_files_of_another_container_of_the_same_name_stay(tmp_path, monkeypatch):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    monkeypatch.setattr(stores, "MACHINE", f"{platform.node()[:64]}-elsewhere", raising=False)
    monkeypatch.setattr(os, "getpid", lambda: dead.pid)
    with open_store(tmp_path).scratch() as running:
        monkeypatch.undo()
        with open_store(tmp_path).scratch():
            assert running.is_dir()


def test_where_nothing_can_be_written_the_run_ends(root, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        run(job_of(root, tmp_path / "file" / "out"))
    blocked = tmp_path / "out"
    blocked.mkdir()
    (blocked / "a").touch()  # where a folder has to be
    with pytest.raises(InputError, match=r"a/000000\.png: cannot be written"):
        run(job_of(root, blocked))
    assert not list(blocked.glob(f"{SCRATCH}*"))
