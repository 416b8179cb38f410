"""Standard input in place of a file."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest

from lidar2pano.cli import main
from lidar2pano.formats.scan_files import write_bin
from miniature import street


def pipe(monkeypatch, content: bytes, terminal: bool = False) -> None:
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(content), isatty=lambda: terminal))


@pytest.mark.parametrize("name", ["-", "/dev/stdin"])
def test_a_scan_is_piped_in(tmp_path, monkeypatch, capsys, name):
    write_bin(tmp_path / "a.bin", street(0, 3000))
    pipe(monkeypatch, (tmp_path / "a.bin").read_bytes())
    assert main(["inspect", name]) == 0
    assert "3000" in capsys.readouterr().out


def test_a_message_names_no_temporary_file(monkeypatch, capsys):
    pipe(monkeypatch, b"CCB2" + bytes(90))
    assert main(["inspect", "-"]) == 2
    assert "lidar2pano: -: is a BIN of CloudCompare" in capsys.readouterr().err


def test_a_terminal_is_no_scan(monkeypatch, capsys):
    pipe(monkeypatch, b"", terminal=True)
    assert main(["inspect", "-"]) == 2
    assert "standard input is a terminal" in capsys.readouterr().err
