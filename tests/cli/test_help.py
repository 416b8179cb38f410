"""The help's layout, completion, and how much a command says on stderr."""

from __future__ import annotations

import logging
import os
import shlex
import subprocess
import sys

import pytest

from lidar2pano.cli import main
from lidar2pano.cli.app import COMPLETION, make_program
from lidar2pano.cli.help_layout import EXAMPLES, LONG, PANEL_BY_OPTION, PANELS, commands_of, options_of
from random_weights import write_scan

UNGROUPED = {"--config"}  # stands with --help


def flags_of(command) -> set[str]:
    """The options of a command."""
    return {flag for item in options_of(command) for flag in item.opts}


@pytest.fixture
def translate_help(capsys, monkeypatch) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["translate", "--help"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(("command", "argument"), [("translate", "SCAN"), ("view", "PATH"), ("evaluate", "RUN")])
def test_usage_says_once_that_there_may_be_several(command, argument, capsys):
    assert main([command, "--help"]) == 0
    usage = capsys.readouterr().out.splitlines()[1]
    assert argument in usage and usage.count("...") == 1


def test_options_stand_in_groups(translate_help):
    groups = [line.split()[1] for line in translate_help.splitlines() if line.startswith("\u256d\u2500 ")]
    assert groups[:2] == ["Arguments", "Options"] and {"Scans", "Cameras", "Panoramas", "Output"} <= set(groups)


def test_every_option_of_a_long_list_has_a_group():
    for command in commands_of(make_program()):
        options = options_of(command)
        if len(options) >= LONG and not hasattr(command, "commands"):
            assert {item.opts[0] for item in options if item.rich_help_panel not in PANELS} == UNGROUPED, command.name


@pytest.mark.parametrize(
    "command", [c for c in commands_of(make_program()) if options_of(c)], ids=lambda c: c.name or "program"
)
def test_no_word_is_cut_at_80_columns(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    words = ["weights", "import"] if command.name == "import" else [command.name] * bool(command.name)
    assert main([*words, "--help"]) == 0
    out = capsys.readouterr().out
    assert "\u2026" not in out
    printed = set(out.replace("[default:", " ").split())
    for item in command.params:
        texts = [item.help or "", *([item.metavar] if item.metavar else []), *item.opts]
        missing = [word for text in texts for word in text.split() if word not in printed]
        assert item.param_type_name == "argument" or not missing, (item.name, missing)


def test_flags_have_no_type(translate_help):
    assert "<bool>" not in translate_help and "--steady" in translate_help


def test_examples_stand_at_the_end_and_exist(translate_help):
    tail = " ".join(translate_help.partition("Examples:")[2].split())
    assert all(example in tail for example in EXAMPLES["translate"])
    for command, examples in EXAMPLES.items():
        for example in examples:
            words = shlex.split(example)
            flags = {word for word in words if word.startswith("--")}
            assert words[0] != "lidar2pano" or flags <= flags_of(make_program().commands[command]), example


def test_every_grouped_option_exists():
    known = {flag for command in commands_of(make_program()) for item in command.params for flag in item.opts}
    assert set(PANEL_BY_OPTION) <= known


def test_short_lists_stay_whole():
    for command in commands_of(make_program()):
        options = options_of(command)
        if len(options) < LONG:
            assert not any(item.rich_help_panel in PANELS for item in options), command.name


def test_a_shell_gets_completions():
    environment = os.environ | {COMPLETION: "complete_bash", "COMP_WORDS": "lidar2pano tran", "COMP_CWORD": "1"}
    code = "from lidar2pano.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["translate"], done.stderr


@pytest.mark.parametrize(("flags", "said"), [([], "licensed"), (["--quiet"], ""), (["--verbose"], "by torch")])
def test_how_much_is_said(tmp_path, monkeypatch, random_weights, capsys, flags, said):
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "a.bin")
    words = ["translate", "a.bin", "--weights", str(random_weights), "--device", "cpu", "--engine", "torch"]
    assert main([*words, *flags]) == 0
    err = capsys.readouterr().err
    assert said in err and bool(err) == bool(said)
    assert ("networks run on cpu by torch" in err) == (flags == ["--verbose"])
    assert not logging.getLogger("lidar2pano").handlers


def test_quiet_hides_no_error(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--quiet", "translate", "missing.bin"]) == 2
    assert "missing.bin" in capsys.readouterr().err
