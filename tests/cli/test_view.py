"""lidar2pano view, and what translate and demo write to look at."""

from __future__ import annotations

import json
import os
import sys
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidar2pano.cli import main
from lidar2pano.cli.batch import open_page
from random_weights import street, write_scan
from small_panoramas import small_panorama


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """Addresses that were opened in a browser, of which there seems to be one."""
    found: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda address: found.append(address) or True)
    return found


@pytest.fixture
def run(random_weights, capsys):
    """A function that runs a command with the small family: (exit code, stdout, stderr's lines but for the licence)."""

    def run(command: str, *arguments: object) -> tuple[int, str, list[str]]:
        code = main([command, *map(str, arguments), "--weights", str(random_weights), "--device", "cpu"])
        out, err = capsys.readouterr()
        return code, out, [line for line in err.splitlines() if "licensed" not in line]

    return run


def index_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8").partition('<script type="application/json" id="index">')[2]
    return json.loads(text.partition("</script>")[0])


def test_saved_panoramas_become_a_page(here, run, opened):
    for seed, name in enumerate("ab"):
        small_panorama(seed).save("saved", ("rgb", "segments", "labels", "depth"), stem=name)
    assert run("view", "saved") == (0, "view.html\n", [])
    assert opened == [(here / "view.html").as_uri()]
    frames = index_of(here / "view.html")["frames"]
    assert [(frame["name"], list(frame["layers"])) for frame in frames] == [
        ("a", ["colour", "classes", "depth"]),
        ("b", ["colour", "classes", "depth"]),
    ]
    assert f"<title>{here.name}/saved</title>" in (here / "view.html").read_text(encoding="utf-8")


def test_a_panorama_may_be_of_any_year(here, run, opened):
    small_panorama(0).save("saved", ("rgb",), stem="a")
    os.utime("saved/a.png", (1e12, 1e12))
    assert run("view", "saved") == (0, "view.html\n", [])


def test_scans_are_translated_into_a_page(here, run, opened):
    for name in ("1", "2"):
        write_scan(here / "drive" / f"{name}.bin")
    code, out, err = run("view", "drive", "--out", "new/page.html", "--no-open")
    assert (code, err, opened) == (0, [], [])
    assert out.endswith("new/page.html\n") and "drive/1.bin: 4000 points" in out
    frames = index_of(here / "new" / "page.html")["frames"]
    assert [frame["name"] for frame in frames] == ["1", "2"]
    assert all(frame["points"][1:3] == [4000, 4000] for frame in frames)
    assert sorted(path.name for path in here.iterdir()) == ["drive", "new"], "no other file"
    assert [path.name for path in (here / "new").iterdir()] == ["page.html"]


def test_scans_of_a_page_are_chosen_as_translate_chooses_them(here, run, opened):
    for name in "123":
        write_scan(here / "drive" / f"{name}.bin")
    assert run("view", "drive", "--every", "2", "--engine", "torch", "--no-open")[0] == 0
    frames = index_of(here / "view.html")["frames"]
    assert [frame["name"] for frame in frames] == ["1", "3"]
    assert all(list(frame["layers"]) == ["colour", "classes", "depth", "confidence"] for frame in frames)
    for option, value in (("--engine", "steam"), ("--look", "moon")):
        code, _, err = run("view", "drive/1.bin", option, value, "--no-open", "--out", "other.html")
        assert code == 2 and len(err) == 1 and value in err[0]
    assert not (here / "other.html").exists()


def test_a_bad_scan_does_not_stop_the_page(here, run, opened):
    write_scan(here / "in" / "a.bin")
    (here / "in" / "b.bin").write_bytes(b"12345")
    code, _, err = run("view", "in")
    assert code == 2 and len(err) == 1 and "in/b.bin" in err[0]
    assert [frame["name"] for frame in index_of(here / "view.html")["frames"]] == ["a"]
    assert opened == []


def test_mistakes_are_one_line_and_leave_nothing(here, run, opened):
    write_scan(here / "a.bin")
    small_panorama().save(".", stem="p")
    Image.fromarray(np.zeros((30, 90, 3), dtype=np.uint8)).save("photo.png")
    before = sorted(here.iterdir())
    for arguments, message in [
        (("missing",), "missing: does not exist"),
        (("missing.png",), "missing.png: is missing"),
        (("photo.png",), "photo.png: 90x30 pixels are no panorama"),
        (("p.png", "a.bin"), "a.bin: is no panorama, others are"),
        (("p.png", "--out", "."), ".: is a folder; name a file for --out"),
        (("p.png", "--out", "a.bin/view.html"), "is not a folder"),
    ]:
        code, out, err = run("view", *arguments)
        assert (code, out, len(err)) == (2, "", 1) and message in err[0]
    assert sorted(here.iterdir()) == before and opened == []


def test_translate_writes_everything_to_look_at(here, run, opened):
    for module in ("av", "rerun"):
        pytest.importorskip(module, reason="an extra")
    write_scan(here / "a.bin")
    code, out, err = run("translate", "a.bin", "--view", "--ply", "--video", "v/a.mp4", "--rerun", "a.rrd")
    assert (code, err) == (0, [])
    assert out.splitlines()[1:] == ["  panoramas/a.png", "  panoramas/a.ply", "panoramas/view.html", "v/a.mp4", "a.rrd"]
    assert opened == [(here / "panoramas" / "view.html").as_uri()]
    assert f"element vertex {len(street())}\n".encode() in (here / "panoramas" / "a.ply").read_bytes()[:200]
    assert all(Path(name).stat().st_size > 1000 for name in ("v/a.mp4", "a.rrd"))


REPLACED = "was there and is replaced, as are others of equal names; to keep them name another"


def test_replaced_files_about_all_scans_are_said_once(here, run, opened):
    for module in ("av", "rerun"):
        pytest.importorskip(module, reason="an extra")
    write_scan(here / "a.bin")
    for name in ("a.mp4", "a.rrd", "one/view.html"):
        (here / name).parent.mkdir(exist_ok=True)
        (here / name).write_text("of another command")
    assert run("translate", "a.bin", "--view", "--out", "one")[2] == [f"lidar2pano: one/view.html: {REPLACED} --out"]
    for options, said in (
        (("--video", "a.mp4", "--rerun", "b.rrd"), "a.mp4: {} --video"),
        (("--rerun", "a.rrd", "--video", "b.mp4"), "a.rrd: {} --rerun"),
    ):
        out = options[0].strip("-")
        assert run("translate", "a.bin", *options, "--out", out)[2] == [f"lidar2pano: {said.format(REPLACED)}"]
    (here / "bad.bin").write_bytes(b"12345")
    code, _, err = run("translate", "bad.bin", "--video", "a.mp4", "--out", "two")
    assert code == 2 and len(err) == 1 and "replaced" not in err[0], "nothing is written"


def test_a_replaced_page_is_said(here, run, opened):
    small_panorama(0).save("saved", ("rgb",), stem="a")
    assert run("view", "saved")[2] == []
    assert run("view", "saved") == (0, "view.html\n", [f"lidar2pano: view.html: {REPLACED} --out"])
    write_scan(here / "a.bin")
    assert run("view", "a.bin")[2] == [f"lidar2pano: view.html: {REPLACED} --out"]


def test_json_stays_one_line_per_scan(here, run, opened):
    write_scan(here / "a.bin")
    _, out, _ = run("translate", "a.bin", "--view", "--ply", "--json")
    (line,) = out.splitlines()
    assert json.loads(line)["outputs"] == ["panoramas/a.png", "panoramas/a.ply"]


@pytest.mark.parametrize(("option", "module", "ending"), [("--video", "av", ".mp4"), ("--rerun", "rerun", ".rrd")])
def test_mistakes_are_found_before_the_work(here, run, monkeypatch, option, module, ending):
    write_scan(here / "a.bin")
    code, _, err = run("translate", "a.bin", option, ".")
    assert code == 2 and err == [f"lidar2pano: .: is a folder; name a file for {option}"]
    monkeypatch.setitem(sys.modules, module, None)
    code, out, err = run("translate", "a.bin", option, f"a{ending}")
    assert (code, out) == (2, "") and err == [
        f"lidar2pano: {option} needs the extra 'recordings': pip install 'lidar2pano[recordings]'"
    ]
    assert [path.name for path in here.iterdir()] == ["a.bin"]


def test_the_demo_names_the_command(here, run):
    code, out, _ = run("demo", "--out", "my panoramas")
    assert code == 0 and out.splitlines()[-1] == "look around in it: lidar2pano view 'my panoramas'"


def test_without_a_screen_no_browser_is_started(here, opened, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    open_page(here / "a.html", 0)
    assert opened == [] and "DISPLAY" not in os.environ
    monkeypatch.setattr(sys, "platform", "darwin")
    open_page(here / "a.html", 2)
    open_page(None, 0)
    open_page(here / "a.html", 0)
    assert opened == [(here / "a.html").as_uri()]
