"""Every script of runs/ can be imported without doing anything, and explains itself."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named

SUPPORT = Path(__file__).resolve().parents[1] / "support"
RUNS = Path(__file__).resolve().parents[2] / "runs"
SCRIPTS = [path.name for path in sorted(RUNS.glob("*.py"))]
WITH_OPTIONS = [name for name in SCRIPTS if "argparse" in (RUNS / name).read_text(encoding="utf-8")]


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, and no help from pytest's own path: a script has to find tests/support itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).resolve() != SUPPORT])
    for path in SUPPORT.glob("*.py"):
        monkeypatch.delitem(sys.modules, path.stem, raising=False)
    return tmp_path


def test_scripts_are_found() -> None:
    assert len(SCRIPTS) > len(WITH_OPTIONS) > 10


@pytest.mark.parametrize("name", SCRIPTS)
def test_importing_a_script_does_nothing(name: str, alone: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = runpy.run_path(str(RUNS / name))
    assert callable(found["main"]) and found["__doc__"]
    assert capfd.readouterr() == ("", "")
    assert list(alone.iterdir()) == []


@pytest.mark.parametrize("name", WITH_OPTIONS)
def test_a_script_with_options_explains_them(
    name: str, alone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(RUNS / name), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(RUNS / name), run_name="__main__")
    assert ended.value.code == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted(RUNS.glob("*.sh")), ids=lambda path: path.name)
def test_shell_scripts_parse(path: Path) -> None:
    assert subprocess.run(["bash", "-n", path], capture_output=True, text=True, check=False).stderr == ""


def test_every_stage_of_a_release_is_a_recipe_with_settings_that_exist(tmp_path: Path) -> None:
    calls = tmp_path / "calls"
    programs = {
        "lidar2pano": 'printf "%s\\t" "$@" >>"$CALLS"; echo >>"$CALLS"',
        "python": f'if [ "$1" = -c ]; then exec {sys.executable} "$@"; fi',
        "cp": "",
    }
    (tmp_path / "bin").mkdir()
    for name, text in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "CALLS": str(calls)}
    subprocess.run(["bash", RUNS / "release.sh", "KITTI", tmp_path / "out"], check=True, env=environment)
    commands = [line.rstrip("\t").split("\t") for line in calls.read_text().splitlines()]
    stages = [words for words in commands if words[0] == "train"]
    assert len(stages) >= 10
    made = set()
    for _, name, *options in stages:
        recipe = recipe_named(name)
        for option, value in zip(options, options[1:], strict=False):
            if option == "--set":
                recipe = override(recipe, value)
                file = value.partition("=")[2]
                assert not file.endswith(".safetensors") or Path(file).parents[1] in made, value
        made.add(Path(options[options.index("--out") + 1]))
