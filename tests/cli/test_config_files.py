"""--config: options of a command from a file."""

from __future__ import annotations

from typing import Any

import pytest

from lidar2pano.cli import main
from random_weights import write_scan


@pytest.fixture
def taken(tmp_path, monkeypatch):
    """A function that runs `train` or another command with a file's text: the arguments that training gets."""
    monkeypatch.chdir(tmp_path)

    def run(text: str, *words: str, name: str = "run.yaml", command: str = "train") -> dict[str, Any]:
        calls: list[dict[str, Any]] = []

        def train(recipe, data, out, **further):
            calls.append({"recipe": recipe, "data": data, "out": out, **further})
            return out

        monkeypatch.setattr("lidar2pano.train.engine.train", train)
        (tmp_path / name).write_text(text)
        assert main([command, *words, "--config", name]) == 0
        return calls[0]

    return run


RUN = """
recipe: titan-pano-mini
data: streets
out: run
devices: 2
set:
  training:
    minutes: 5
    batch: 3
  training.seed: 7
"""


def test_a_whole_run_in_a_file(taken):
    call = taken(RUN)
    training = call["recipe"].training
    assert (call["recipe"].name, str(call["data"]), str(call["out"]), call["devices"]) == (
        "titan-pano-mini",
        "streets",
        "run",
        2,
    )
    assert (training.minutes, training.batch, training.seed) == (5, 3, 7)


def test_the_command_line_comes_first(taken):
    call = taken(RUN, "--devices", "1", "--set", "training.batch=4", "--out", "other")
    training = call["recipe"].training
    assert (call["devices"], str(call["out"]), training.batch, training.minutes) == (1, "other", 4, 5)


def test_json_and_a_list_of_assignments(taken):
    text = '{"data": "a", "out": "b", "set": ["training.batch=2", "training.precision=32-true"]}'
    call = taken(text, "titan-mini", name="run.json")
    assert (call["recipe"].name, call["recipe"].training.batch) == ("titan-mini", 2)


def test_flags_and_lists_of_translate(tmp_path, monkeypatch, random_weights, capsys):
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "a.bin")
    (tmp_path / "c.yaml").write_text(
        f"scans: [a.bin]\nweights: {random_weights}\ndevice: cpu\nsave: [rgb, depth]\njson: true\nout: o\nevery: 1\n"
    )
    assert main(["translate", "--config", "c.yaml"]) == 0
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["a.depth.png", "a.png"]
    assert capsys.readouterr().out.startswith("{")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("every: 2\nevrey: 3", "has no 'evrey'; did you mean 'every'?"),
        ("qqqq: 3", "has no 'qqqq'; there is annotations, at, calib, camera"),
        ("config: c.yaml", "has no 'config'"),
        ("- every", "holds no options"),
        ("every", "holds no options"),
        ("", "holds no options"),
        ("every: {a: 2}", "every: holds no plain value"),
        ("every:", "every: holds nothing"),
        ("every: two", "--every"),
        ("every: [1, 2]", "--every"),
        ("steady: 3", "steady: is on or off"),
        ("steady: 'no'", "steady: is on or off"),
        ("every: !!python/object/apply:os.system [true]", "is no YAML"),
        ("a: &a [x]\nb: *a", "aliases"),
        ("every: [", "is no YAML"),
        ("\x00", "is no YAML"),
    ],
)
def test_bad_files_are_one_line(tmp_path, monkeypatch, capsys, text, said):
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "a.bin")
    (tmp_path / "c.yaml").write_text(text)
    assert main(["translate", "a.bin", "--config", "c.yaml"]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and "?; there is" not in err, err


def test_a_missing_file_and_a_folder(tmp_path, capsys):
    for path in (tmp_path / "none.yaml", tmp_path):
        assert main(["translate", "a.bin", "--config", str(path)]) == 2
        assert f"{path}: cannot be read" in capsys.readouterr().err


def test_every_long_command_takes_one(capsys):
    for command in ("translate", "view", "bulk", "evaluate", "train", "prepare", "reproduce", "serve", "world"):
        assert main([command, "--help"]) == 0
        assert "--config" in capsys.readouterr().out
