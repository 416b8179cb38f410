"""`lidar2pano bulk` with networks, on the scan that ships with the package."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from typer.main import get_command

from lidar2pano import demo
from lidar2pano.bulk import Shard
from lidar2pano.cli import app, main
from lidar2pano.memory import Memory
from lidar2pano.pipeline import load
from random_weights import street


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """A working folder with the demo's scan in a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive" / "one").mkdir(parents=True)
    shutil.copy(demo.street(), tmp_path / "drive" / "one" / "a.bin")
    return tmp_path


def test_the_bytes_are_those_of_translate(drive, random_weights, capsys):
    options = ["--weights", str(random_weights), "--device", "cpu", "--save", "all"]
    assert main(["bulk", "drive", "--out", "bulk", *options]) == 0
    captured = capsys.readouterr()
    assert captured.out == "1 scan: 1 written\n"
    assert captured.err.count("\n") == 1 and "not for commercial use" in captured.err
    assert main(["translate", "drive/one/a.bin", "--out", "single", *options]) == 0
    names = ["a.depth.png", "a.label", "a.png", "a.segments.png"]
    assert sorted(path.name for path in (drive / "bulk" / "one").iterdir()) == names
    for name in names:
        assert (drive / "bulk" / "one" / name).read_bytes() == (drive / "single" / name).read_bytes()
    (line,) = map(json.loads, (drive / "bulk" / "manifest" / "0-of-1.jsonl").read_text().splitlines())
    assert line["outputs"] == ["one/a.png", "one/a.segments.png", "one/a.label", "one/a.depth.png"]
    assert line["weights"] == str(random_weights) and line["milliseconds"]["translate"] > 0
    settings = json.loads((drive / "bulk" / "bulk.json").read_text())
    assert settings["elevation"] is None, "as if it were not there, as in runs of before"
    assert settings["save"] == ["rgb", "segments", "labels", "depth"] and len(settings["sha256"]["painter"]) == 64


def test_an_empty_shard_is_said(drive, random_weights, capsys):
    index = next(index for index in (0, 1) if not Shard(index, 2).takes("one/a.bin"))
    options = ["--weights", str(random_weights), "--device", "cpu", "--shard", f"{index}/2"]
    assert main(["bulk", "drive", "--out", "bulk", *options]) == 0
    assert capsys.readouterr().out == f"shard {index}/2 is empty; scans in all: 1\n"


def test_files_that_may_be_scans_are_said(drive, random_weights, capsys):
    shutil.copy(drive / "drive/one/a.bin", drive / "drive/one/b.velo")
    options = ["--weights", str(random_weights), "--device", "cpu"]
    assert main(["bulk", "drive", "--out", "bulk", *options]) == 0
    assert main(["translate", "drive/one", "--out", "single", *options]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(said) == 2 and all(
        "may be scans are left out (1 .velo); `translate` takes them" in line for line in said
    )


def test_given_labels_do_what_the_segmenters_do(random_weights):
    pipeline, scan = load(random_weights, "cpu"), street()
    _, own = pipeline.step(Memory(), scan)
    _, again = pipeline.step(Memory(), scan, labels=own.labels)
    assert np.array_equal(own.confidence, again.confidence) and np.array_equal(own.labels, again.labels)
    _, changed = pipeline.step(Memory(), scan, labels=(own.labels + 1) % 20)
    assert not np.array_equal(own.confidence, changed.confidence)


@pytest.mark.parametrize(
    ("words", "address"),
    [
        ([], ""),
        (["--ray"], "auto"),
        (["--ray", "--shard", "0/2"], "auto"),
        (["--ray", "head:6379"], "head:6379"),
    ],
)
def test_the_address_may_be_left_out(words, address):
    command = get_command(app).commands["bulk"]
    context = command.make_context("bulk", ["drive", "--out", "o", *words])
    assert context.params["address"] == address and context.params["root"] == "drive"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "--out", "o"], "nowhere: is neither a folder nor a recording; name one, or a URL"),
        (["drive", "--out", "o", "--shard", "3/3"], "--shard 3/3: is not of the form i/n"),
        (["drive", "--out", "o", "--as", "semantikitti"], "did you mean 'semantickitti'?"),
        (["drive", "--out", "o", "--save", "rbg"], "did you mean 'rgb'?"),
        (["drive", "--out", "o", "--format", "webp", "--as", "semantickitti"], "a data set's panoramas are PNG"),
        (["drive", "--out", "o", "--elevation", "auto", "--as", "semantickitti"], "panoramas have the usual rows"),
        (["drive", "--out", "o", "--elevation", "9,8"], "elevation '9,8': is neither auto nor LOW,HIGH"),
        (["drive", "--out", "o", "--look", "B"], "the painter knows no look 'B'; it knows day"),
        (["drive", "--out", "drive"], "drive: is the folder of the scans; choose another --out"),
        (["drive/one/a.bin", "--out", "o"], "drive/one/a.bin: is neither a folder nor a recording"),
        (
            ["drive", "--out", "o", "--workers", "4"],
            "--workers and --cores: are those of a Ray cluster; name --ray too",
        ),
        (["drive", "--out", "o", "--cores", "4"], "--workers and --cores: are those of a Ray cluster; name --ray too"),
        (["drive"], "Missing option '--out'"),
    ],
)
def test_mistakes(drive, random_weights, capsys, arguments, message):
    assert main(["bulk", *arguments, "--weights", str(random_weights), "--device", "cpu"]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "commercial" not in line]
    assert len(lines) == 1 and message in lines[0]
    assert not list(drive.rglob("*.png")) and not list(drive.rglob(".lidar2pano*"))


def test_a_device_that_does_not_exist_is_refused_for_ray_too(drive, random_weights, capsys, monkeypatch):
    monkeypatch.setattr("lidar2pano.bulk.on_ray.connected", None)
    assert main(["bulk", "drive", "--out", "o", "--ray", "--weights", str(random_weights), "--device", "cuad"]) == 2
    assert capsys.readouterr().err == "lidar2pano: no device 'cuad'; there is auto, cpu and cuda\n"
