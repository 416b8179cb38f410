"""Outputs of evaluate: the table, JSON, CSV and the worst frames, from the command line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidar2pano.cli import main
from lidar2pano.data.frames import Frame, PanoramaGroundTruth
from lidar2pano.evaluate.ground_truth import Resampled
from lidar2pano.evaluate.panorama_system import Prediction
from lidar2pano.evaluate.pictures import CAPTION_ROWS, WorstFrame, WorstFrames, sheet
from lidar2pano.labels import CITYSCAPES, COMMON15
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
    video = write_weights(tmp_path / "video", "painter", "vid2vid", VIDEO)
    chain, oracle = f"{front_weights}+{video}", f"oracle+{video}"
    as_json, as_csv, worst = tmp_path / "all.json", tmp_path / "all.csv", tmp_path / "worst"
    assert (
        run(data, random_weights, chain, oracle, "--json", as_json, "--csv", as_csv, "--worst", 2, "--out", worst) == 0
    )
    table = capsys.readouterr().out
    heading, _, head, *_ = table.splitlines()
    assert head == f"| class | pixels | {random_weights} | {chain} | {oracle} |"
    assert f"Input is the camera's ground-truth labels, not the scan: {oracle}." in heading
    written = json.loads(as_json.read_text())
    assert [one["weights"] for one in written["results"]] == [str(random_weights), chain, oracle]
    assert set(written) >= {"data", "split", "images", "scans", "classes", "heading", "results"}
    ours, front, top = written["results"]
    assert set(ours["score"]) == {"segmenter", "translator", "painter"}
    assert set(ours["score"]["painter"]) == {"camera_ssim", "camera_swd", "split"}
    assert top["score"]["translator"] == {"split": "val"} and top["classes"] == []
    assert set(front["networks"]) == {"segmenter", "translator", "painter"} and set(top["networks"]) == {"painter"}
    check_records(as_csv, written)
    check_worst(worst, ours)


def test_scores_are_kept_where_no_page_of_pairs_can_be(data, random_weights, front_weights, tmp_path, capsys):
    as_json, as_csv, pairs = tmp_path / "all.json", tmp_path / "all.csv", tmp_path / "pairs"
    written = ("--json", as_json, "--csv", as_csv, "--pairs", pairs)
    assert run(data, random_weights, front_weights, "--metrics", "points", *written) == 2
    captured = capsys.readouterr()
    assert "--pairs: no frame has a photograph and both systems' pictures" in captured.err
    assert "points: mIoU" in captured.out
    check_records(as_csv, json.loads(as_json.read_text()))


def check_records(path: Path, written: dict) -> None:
    """CSV has the values of JSON."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["system", "sector", "metric", "value", "low", "high", "frames"]
    found = {(row["system"], row["sector"], row["metric"]): row for row in rows}
    assert len(found) == len(rows)
    for one in written["results"]:
        for value in one["values"]:
            row = found[one["weights"], value["sector"], value["name"]]
            assert row["value"] == ("" if value["value"] is None else str(value["value"]))
            assert row["low"] == ("" if value["low"] is None else str(value["low"]))
        for stage in one["milliseconds"]:
            assert (one["weights"], "milliseconds", stage) in found
        for row in one["classes"]:
            if row["pixels"]:
                value = float(found[one["weights"], "camera", f"iou {row['class']}"]["value"])
                assert value == pytest.approx(row["iou"])


def check_worst(folder: Path, ours: dict) -> None:
    """The two worst of each system, with images."""
    with (folder / "worst.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["rank"] for row in rows] == ["1", "2"] * 3
    own = [row for row in rows if row["system"] == ours["weights"]]
    assert [(row["frame"], float(row["value"])) for row in own] == [
        (one["frame"], one["value"]) for one in ours["worst"]
    ]
    assert float(own[0]["value"]) <= float(own[1]["value"]) and own[0]["metric"] == "camera mIoU"
    assert rows[-1]["metric"] == "camera SSIM"  # the oracle predicts no classes
    for row in rows:
        with Image.open(folder / row["image"]) as image:
            assert image.size == (2 * SIZE[0], 2 * (SIZE[1] + CAPTION_ROWS))


def test_only_some_metrics(data, random_weights, capsys):
    assert run(data, random_weights, "--metrics", "points") == 0
    points = capsys.readouterr().out
    assert "points: accuracy" in points and "accuracy |  | " in points
    assert "mIoU of 4" not in points and "SSIM" not in points and " ms |" not in points
    assert run(data, random_weights, "--metrics", "classes,camera") == 0
    classes = capsys.readouterr().out
    assert "mIoU of 4" in classes and "points:" not in classes and "paint, ms" not in classes


def frame_of(**parts: object) -> Frame:
    return Frame("00/000001", scan=street(points=3), **parts)


def test_a_sheet_shows_ground_truth_beside_prediction():
    true, image = np.full((4, 6, 3), 10, np.uint8), np.full((4, 6, 3), 20, np.uint8)
    labels = np.full((4, 6), CITYSCAPES.id_of("car"), np.uint8)
    found = sheet(frame_of(image=true, camera_labels=labels), Prediction(image=image), None)
    gap = CAPTION_ROWS
    assert found.shape == (2 * (gap + 4), 12, 3) and found[:gap, :6].max() > 200, "a caption"
    assert (found[gap : gap + 4, :6] == 10).all() and (found[gap : gap + 4, 6:] == 20).all()
    assert (found[2 * gap + 4 :, :6] == COMMON15.colours[1]).all() and (found[gap + 4 :, 6:] == 0).all()
    view = View(rows=3, columns=16, up=0.2, down=-0.2, kind="cylinder")
    wide = np.full((3, 16, 3), 30, np.uint8)
    around = PanoramaGroundTruth(view=view, image=wide, valid=np.ones((3, 16), bool))
    ours = Resampled(wide + 1, np.zeros((3, 16), np.uint8), np.zeros((3, 16), np.float32))
    found = sheet(frame_of(image=true, panorama=around), Prediction(), ours)
    assert found.shape == ((gap + 4) + 3 * (gap + 3), 16, 3), "the image, panoramas, predicted classes"
    assert (found[gap : gap + 4, :6] == 10).all() and (found[gap : gap + 4, 6:] == 0).all()
    assert (found[2 * gap + 4 :][:3] == 30).all() and (found[3 * gap + 7 :][:3] == 31).all()
    found = sheet(frame_of(panorama=around), Prediction(painted=False), ours)
    assert found.shape == (2 * (gap + 3), 16, 3), "colours that were not predicted are not shown"


def test_a_sheet_has_no_place_for_what_is_not_predicted():
    true = np.full((4, 6, 3), 10, np.uint8)
    assert sheet(frame_of(image=true), Prediction(point_labels=np.zeros(3, int)), None).shape[1] == 6
    assert sheet(frame_of(), Prediction(), None) is None


def test_the_worst_are_held():
    worst = WorstFrames(2)
    for name, value in (("b", 0.5), ("a", 0.5), ("c", 0.9), ("d", 0.1)):
        assert worst.wanted(value) == (name != "c")
        if worst.wanted(value):
            worst.take(WorstFrame(name, "camera mIoU", value, None))
    assert [(one.name, one.value) for one in worst.held] == [("d", 0.1), ("a", 0.5)]


def test_labels_that_a_teacher_wrote_are_flagged(data, random_weights, capsys):
    folder = data / "sequences" / "00"
    labels = sorted((folder / "labels").glob("*.label"))
    lines = []
    for number, path in enumerate(labels):
        stamp = {"sha256": "", "size": path.stat().st_size, "changed_ns": path.stat().st_mtime_ns + (number == 1)}
        lines.append(
            json.dumps({"file": f"labels/{path.name}", "made_by": "0123456789", "source": stamp, "stamp": stamp})
        )
    (folder / "prepared.jsonl").write_text("\n".join(["torn {", *lines]))
    assert run(data, random_weights, "--metrics", "points") == 0
    said = f"Pseudo-labels of networks, not ground truth: point labels of {len(labels) - 1} frames by 01234567."
    assert len(labels) > 1 and said in capsys.readouterr().out
