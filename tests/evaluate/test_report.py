"""What evaluate prints and writes: the table, JSON, CSV and the worst frames, from the command line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidar2pano.cli import main
from lidar2pano.data.truths import TruePanorama, Truth
from lidar2pano.evaluate.questions import Seen
from lidar2pano.evaluate.rasters import Carried
from lidar2pano.evaluate.worst import Worst, sheet
from lidar2pano.labels import COMMON15
from lidar2pano.views import View
from random_weights import street, write_data_set, write_weights

VIDEO = {"channels": 16, "widths": [8], "downsamplings": 2, "blocks": [1, 1], "foreground": []}
SIZE = (124, 38)


@pytest.fixture
def data(tmp_path) -> Path:
    return write_data_set(tmp_path / "mini", frames=3, size=SIZE)


def run(data: Path, *words: object) -> int:
    return main(["evaluate", *map(str, words), "--data", str(data), "--device", "cpu"])


def test_everything_that_is_written(data, random_weights, front_weights, tmp_path, capsys):
    film = write_weights(tmp_path / "film", "painter", "vid2vid", VIDEO)
    chain, ceiling = f"{front_weights}+{film}", f"truth+{film}"
    said, figures, worst = tmp_path / "all.json", tmp_path / "all.csv", tmp_path / "worst"
    assert (
        run(data, random_weights, chain, ceiling, "--json", said, "--csv", figures, "--worst", 2, "--out", worst) == 0
    )
    table = capsys.readouterr().out
    heading, _, head, *_ = table.splitlines()
    assert head == f"| class | pixels | {random_weights} | {chain} | {ceiling} |"
    assert f"Told the camera's true classes, not the scan: {ceiling}." in heading
    told = json.loads(said.read_text())
    assert [one["weights"] for one in told["results"]] == [str(random_weights), chain, ceiling]
    assert set(told) >= {"data", "split", "images", "scans", "classes", "heading", "results"}
    ours, front, top = told["results"]
    assert set(ours["score"]) == {"segmenter", "translator", "painter"}
    assert set(ours["score"]["painter"]) == {"camera_ssim", "camera_swd", "split"}
    assert top["score"]["translator"] == {"split": "val"} and top["classes"] == []
    assert set(front["networks"]) == {"segmenter", "translator", "painter"} and set(top["networks"]) == {"painter"}
    check_records(figures, told)
    check_worst(worst, ours)


def check_records(path: Path, told: dict) -> None:
    """CSV says what JSON says."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["system", "sector", "figure", "value", "low", "high", "frames"]
    found = {(row["system"], row["sector"], row["figure"]): row for row in rows}
    assert len(found) == len(rows)
    for one in told["results"]:
        for figure in one["figures"]:
            row = found[one["weights"], figure["sector"], figure["name"]]
            assert row["value"] == ("" if figure["value"] is None else str(figure["value"]))
            assert row["low"] == ("" if figure["low"] is None else str(figure["low"]))
        for stage in one["milliseconds"]:
            assert (one["weights"], "milliseconds", stage) in found
        for row in one["classes"]:
            if row["pixels"]:
                value = float(found[one["weights"], "camera", f"iou {row['class']}"]["value"])
                assert value == pytest.approx(row["iou"])


def check_worst(folder: Path, ours: dict) -> None:
    """The two worst of each system, with pictures."""
    with (folder / "worst.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["rank"] for row in rows] == ["1", "2"] * 3
    mine = [row for row in rows if row["system"] == ours["weights"]]
    assert [(row["frame"], float(row["value"])) for row in mine] == [
        (one["frame"], one["value"]) for one in ours["worst"]
    ]
    assert float(mine[0]["value"]) <= float(mine[1]["value"]) and mine[0]["figure"] == "camera mIoU"
    assert rows[-1]["figure"] == "camera SSIM"  # the ceiling has no classes of its own
    for row in rows:
        with Image.open(folder / row["picture"]) as picture:
            assert picture.size == (2 * SIZE[0], 2 * SIZE[1])


def test_only_some_measures(data, random_weights, capsys):
    assert run(data, random_weights, "--metrics", "points") == 0
    points = capsys.readouterr().out
    assert "points: accuracy" in points and "accuracy |  | " in points
    assert "mIoU of 4" not in points and "SSIM" not in points and " ms |" not in points
    assert run(data, random_weights, "--metrics", "classes,camera") == 0
    classes = capsys.readouterr().out
    assert "mIoU of 4" in classes and "points:" not in classes and "paint, ms" not in classes


def truth(**parts: object) -> Truth:
    return Truth(name="00/000001", scan=street(points=3), **parts)


def test_a_sheet_shows_truth_beside_answer():
    picture, colour = np.full((4, 6, 3), 10, np.uint8), np.full((4, 6, 3), 20, np.uint8)
    ids = np.full((4, 6), COMMON15.id_of("car"), np.uint8)
    found = sheet(truth(picture=picture, camera_ids=ids), Seen(colour=colour), None)
    assert found.shape == (8, 12, 3)
    assert (found[:4, :6] == 10).all() and (found[:4, 6:] == 20).all()
    assert (found[4:, :6] == COMMON15.colours[1]).all() and (found[4:, 6:] == 0).all()  # no classes are answered
    view = View(rows=3, columns=16, up=0.2, down=-0.2, kind="cylinder")
    wide = np.full((3, 16, 3), 30, np.uint8)
    true = TruePanorama(view=view, colour=wide, valid=np.ones((3, 16), bool))
    ours = Carried(wide + 1, np.zeros((3, 16), np.uint8), np.zeros((3, 16), np.float32))
    found = sheet(truth(picture=picture, panorama=true), Seen(colour=colour), ours)
    assert found.shape == (4 + 6 + 6, 16, 3) and (found[:4, 12:] == 0).all()
    assert (found[4:7] == 30).all() and (found[7:10] == 31).all()
    assert sheet(truth(), Seen(), None) is None


def test_the_worst_are_held():
    worst = Worst(2)
    for name, value in (("b", 0.5), ("a", 0.5), ("c", 0.9), ("d", 0.1)):
        judged = ("camera mIoU", value)
        assert worst.wanted(judged) == (name != "c")
        if worst.wanted(judged):
            worst.take(name, judged, None)
    assert [(name, value) for name, _, value in worst.rows()] == [("d", 0.1), ("a", 0.5)]
    assert worst.write(Path("nowhere")) == [None, None]
