"""Disks that are full or read-only: one line, a named exit code, and no file that is half written.

A small tmpfs is such a disk where the tests may mount one; elsewhere a limit of the size of files stands for it.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from lidar2pano.cli.app import BROKEN, MISTAKE
from random_weights import street, write_data_set, write_scan

FEW_BYTES = 2000  # fewer than the largest file of any command here
REFUSED = re.compile(r"(cannot be written \(|: )(No space left on device|File too large)")
# What is written on the way without being an output, or differs from run to run.
OTHERS = ("tensorboard", "weights/", "checkpoints/", "state.json", "prepared.jsonl", "manifest/")


def data_set(out: Path) -> None:
    """Scans alone: all else would be written and removed on a disk that has no room for it."""
    whole = write_data_set(out.with_name(f"{out.name}-with-labels"), frames=2, size=(60, 20))
    others = shutil.ignore_patterns("labels", "image_2", "camera_labels")
    shutil.copytree(whole, out, ignore=others, dirs_exist_ok=True)


COMMANDS: dict[str, tuple[str, Callable[[Path], Any] | None]] = {
    "translate": ("translate {here}/drive --weights {here}/small --device cpu --save all --ply --out {}", None),
    "view": ("view {here}/drive/0.bin --weights {here}/small --device cpu --no-open --out {}/view.html", None),
    "bulk": ("bulk {here}/drive --weights {here}/small --device cpu --save all --out {}", None),
    "world": ("world {} --frames 1 --save scans --sensor vlp16 --place country --processes 1", None),
    "prepare": ("prepare {} --lidar {here}/small --device cpu", data_set),
    "train": ("toy-training {}", None),
}


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small").symlink_to(random_weights)
    for number in range(2):
        write_scan(tmp_path / "drive" / f"{number}.bin", street(seed=number))
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def mount(stack: ExitStack, folder: Path, options: str) -> bool:
    """Whether a tmpfs could be mounted on a folder."""
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False
    if done:
        stack.callback(subprocess.run, ["umount", str(folder)], check=True)
    return done


def fill(disk: Path, room_bytes: int) -> None:
    """Leave room for so many bytes on a disk."""
    state = os.statvfs(disk)
    with (disk / "filling").open("wb") as file:
        file.write(bytes(max(0, state.f_bavail * state.f_frsize - room_bytes)))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk(here, run, name):
    words, prepare = COMMANDS[name]
    for folder in (whole := here / "whole", here / "disk"):
        folder.mkdir()
    if prepare:
        prepare(whole)
    began = files(whole)
    code, _, said = run([word.format(whole, here=here) for word in words.split()])
    assert code == 0, said
    expected = files(whole)
    grown = sum(len(data) for data in expected.values()) - sum(len(data) for data in began.values())
    with ExitStack() as stack:
        disk = here / "disk"
        limited = not mount(stack, disk, "size=8m")
        if prepare:
            prepare(disk)
        if not limited:
            fill(disk, grown // 3)
        code, _, said = run(
            [word.format(disk, here=here) for word in words.split()], None, 0, FEW_BYTES if limited else None
        )
        (disk / "filling").unlink(missing_ok=True)
        left = files(disk)
    assert code in (MISTAKE, BROKEN), said
    complaints = [line for line in said.splitlines() if "licensed" not in line]
    assert all(line.startswith("lidar2pano: ") and REFUSED.search(line) for line in complaints), said
    assert 1 <= len(complaints) <= 2, "one for each scan"
    assert not [path for path in left if "part" in path or path.startswith(".") or "/." in path]
    assert {
        path: data for path, data in left.items() if not any(one in path for one in OTHERS)
    }.items() <= expected.items()


@pytest.mark.parametrize("name", ["translate", "bulk", "world", "train"])
def test_a_read_only_disk(here, run, name):
    with ExitStack() as stack:
        if not mount(stack, here / "disk", "ro,size=1m"):
            pytest.skip("no disk can be mounted here")
        code, _, said = run([word.format(here / "disk" / "out", here=here) for word in COMMANDS[name][0].split()])
        assert code == MISTAKE and said.count("\n") == 1 and "Read-only file system" in said, said
