"""Every program in examples/ runs on the scan that ships with the package and writes what it says."""

from __future__ import annotations

import ast
import json
import runpy
import shutil
import sys
import tomllib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

import house_rules
import lidar2pano
from lidar2pano import demo

EXAMPLES = house_rules.ROOT / "examples"


def example(name: str) -> dict[str, Any]:
    """The names that an example defines; it is not run."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_every_example_is_listed_and_tested():
    names = {path.name for path in EXAMPLES.glob("*.py")}
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert names == {"panorama_from_numpy.py", "colour_points.py", "drive_to_video.py"}
    further = {"panorama.ipynb", "space/app.py", "ros/lidar2pano_ros/node.py"}
    assert all((EXAMPLES / name).is_file() for name in further)
    assert [name for name in names | further if f"({name})" not in listed] == []


def test_the_notebook_runs_from_above_to_below(tmp_path, random_weights, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES / "panorama.ipynb").read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4 and len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell.get("outputs") for cell in notebook["cells"]), "clear its outputs"
    install, *cells = cells
    assert install.startswith("%pip install")
    names: dict[str, Any] = {}
    shown = []
    for cell in cells:
        tree = ast.parse(cell.replace('"world"', repr(str(random_weights))))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "<cell>", "exec"), names)
        shown.append(last and eval(compile(ast.Expression(last.value), "<cell>", "eval"), names))
    assert any(getattr(value, "_repr_png_", None) and value._repr_png_() for value in shown)
    assert capsys.readouterr().out.count("%") == 2
    assert sorted(path.name for path in (tmp_path / "panoramas").iterdir()) == [
        f"street{ending}" for ending in (".depth.png", ".label", ".png", ".segments.png")
    ]


def test_the_notebooks_link_leads_to_this_repository():
    urls = tomllib.loads((house_rules.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    text = (EXAMPLES / "panorama.ipynb").read_text(encoding="utf-8")
    repository = urls["Homepage"].removeprefix("https://github.com/")
    assert f"https://colab.research.google.com/github/{repository}/blob/main/examples/panorama.ipynb" in text
    assert f"git+{urls['Homepage']}" in text and "http" in text
    assert f"git+{urls['Homepage']}" in (EXAMPLES / "space" / "requirements.txt").read_text(encoding="utf-8")


@pytest.fixture
def space(random_weights):
    """The names of the Space's program, on random weights."""
    names = runpy.run_path(str(EXAMPLES / "space" / "app.py"))
    names["paint"].__globals__["WEIGHTS"] = str(random_weights)
    return names


def test_the_space_paints_its_own_scan_and_others(space, tmp_path):
    colour, classes, line = space["paint"](None)
    assert colour.size == classes.size and line.startswith("Panorama('street'")
    shutil.copy(demo.street(), tmp_path / "mine.bin")
    assert space["paint"](str(tmp_path / "mine.bin"))[2].startswith("Panorama('mine'")


def test_the_spaces_page_says_a_mistake_in_one_line(space, tmp_path, monkeypatch):
    class Error(Exception):
        pass

    def part(**options):
        return options

    gradio = SimpleNamespace(Interface=part, File=part, Image=part, Textbox=part, Error=Error)
    monkeypatch.setitem(sys.modules, "gradio", gradio)
    answer = space["page"]()["fn"]
    assert answer(None)[2].startswith("Panorama('street'")
    (tmp_path / "rubbish.bin").write_bytes(b"rubbish")
    with pytest.raises(Error, match=r"^rubbish.bin: ") as caught:
        answer(str(tmp_path / "rubbish.bin"))
    assert "\n" not in str(caught.value)


def test_the_spaces_page_is_made_by_gradio(space):
    gradio = pytest.importorskip("gradio", reason="Gradio is no dependency: pip install gradio")
    assert isinstance(space["page"](), gradio.Interface)


def test_the_spaces_header_names_its_program():
    text = (EXAMPLES / "space" / "README.md").read_text(encoding="utf-8")
    header = yaml.safe_load(text.split("---\n")[1])
    assert header["sdk"] == "gradio" and header["license"] == "apache-2.0"
    assert (EXAMPLES / "space" / header["app_file"]).is_file() and len(header["short_description"]) <= 60


@pytest.mark.parametrize("given", [True, False])
def test_panorama_from_numpy(tmp_path, random_weights, capsys, given):
    points = tmp_path / "mine.npy"
    np.save(points, np.fromfile(demo.street(), dtype="<f4").reshape(-1, 4)[::3])
    stem = "mine" if given else "demo"
    files = example("panorama_from_numpy")["main"](str(points) if given else "", str(tmp_path), str(random_weights))
    assert [file.name for file in files] == [f"{stem}.png", f"{stem}.segments.png", f"{stem}.depth.png"]
    assert "% of the pixels" in capsys.readouterr().out


def test_colour_points(tmp_path, random_weights):
    out = example("colour_points")["main"]("", str(tmp_path / "points.ply"), str(random_weights))
    header, _, body = out.read_bytes().partition(b"end_header\n")
    scan = lidar2pano.read(demo.street())
    assert f"element vertex {len(scan)}\n".encode() in header
    types = {"xyz": "3<f4", "rgb": "3u1", "remission": "<f4", "label": "<u2", "valid": "u1"}
    vertices = np.frombuffer(body, dtype=list(types.items()))
    assert np.array_equal(vertices["xyz"], scan.xyz)
    coloured = (vertices["rgb"] != 128).any(axis=1)
    assert np.array_equal(coloured, vertices["valid"] == 1)


def test_drive_to_video(tmp_path):
    """By networks that have learned: random ones paint the noise, which is the same for both scans."""
    drive = tmp_path / "drive"
    drive.mkdir()
    for number in range(2):
        shutil.copy(demo.street(), drive / f"{number:06d}.bin")
    scan = np.fromfile(drive / "000001.bin", dtype="<f4").reshape(-1, 4)
    scan[:, :2] *= -1  # turned around
    scan.tofile(drive / "000001.bin")
    out = example("drive_to_video")["main"](str(drive), str(tmp_path / "drive.webp"), "world")
    with Image.open(out) as video:
        assert video.n_frames == 2
        assert video.width == 1536
