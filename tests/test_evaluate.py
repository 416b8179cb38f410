"""What evaluate counts, by hand, with sights that answer what they are told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

from lidar2pano.data.sequences import frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate import Contender, contender, score
from lidar2pano.evaluate.sights import Around
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.images import Normalisation
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.pipeline import Stopwatch
from random_weights import CALIB, FRONT_VIEW, street, write_scan

ROAD, CAR, SKY = (COMMON15.id_of(name) for name in ("road", "car", "sky"))
ROAD_THERE, CAR_THERE, SKY_THERE, UNSURE = 0, 13, 10, 255  # Cityscapes' ids


class Told:
    """A sight, and its own segmenter, that gives fixed answers."""

    device = torch.device("cpu")

    def __init__(self, ids, labels):
        self.ids, self.labels, self.sizes = torch.as_tensor(ids), torch.as_tensor(labels), []

    @property
    def segmenter(self):
        return self

    def points(self, scan, device):
        return self.labels

    def see(self, scan, calibration, watch):
        self.sizes.append(calibration.size)
        with watch("thinking"):
            return self.ids, self.labels


def contestant(ids, labels) -> Contender:
    return Contender(
        name="told",
        sight=Told(ids, labels),
        networks={"translator": {"recipe": "titan-pano-mini", "steps": 7, "hours": 0.5, "commit": "abc"}},
    )


@pytest.fixture
def data(tmp_path):
    """One frame: an image of 6 x 2 pixels, a scan of 4 points."""
    sequence = tmp_path / "sequences" / "00"
    for folder in ("camera_labels", "labels"):
        (sequence / folder).mkdir(parents=True)
    write_scan(sequence / "velodyne" / "000000.bin", street(points=4))
    raw = SEMANTIC_KITTI.to_raw(np.array([0, 1, 9, 9]))  # unlabeled, car, road, road
    raw.astype("<u4").tofile(sequence / "labels" / "000000.label")
    target = [[ROAD_THERE] * 4 + [CAR_THERE] * 2, [SKY_THERE, UNSURE] + [CAR_THERE] * 4]
    Image.fromarray(np.array(target, np.uint8)).save(sequence / "camera_labels" / "000000.png")
    (sequence / "calib.txt").write_text(CALIB)
    (tmp_path / "splits.json").write_text(json.dumps({"val": ["00/000000"]}))
    return tmp_path


def scored(data, *contenders):
    return score(contenders, frames(data, "val"), data="mini", split="val")


def test_counted_by_hand(data):
    ids = [[ROAD, ROAD, SKY, 0, CAR, ROAD], [ROAD, ROAD] + [CAR] * 4]
    told = contestant(ids, [9, 1, 9, 1])
    evaluation = scored(data, told)
    iou = told.camera.iou()
    assert iou[ROAD] == pytest.approx(2 / 5)  # 2 hits, 4 in the target, 1 more claimed; the last row's do not count
    assert iou[CAR] == pytest.approx(5 / 6)
    assert evaluation.as_dict()["results"][0]["score"] == {
        "segmenter": {"point_miou": pytest.approx(0.5), "point_accuracy": pytest.approx(2 / 3), "split": "val"},
        "translator": {
            "camera_miou": pytest.approx((2 / 5 + 5 / 6) / 2),
            "camera_accuracy": pytest.approx(7 / 10),
            "split": "val",
        },
    }
    assert told.sight.sizes == [(6, 2)]
    assert "| road | 40.0% | 0.400 |" in evaluation.table()
    assert "| translator: recipe |  | titan-pano-mini, 7 steps, 0.5 h |" in evaluation.table()


def test_answers_of_absent_classes_do_not_change_what_is_averaged(data):
    bus = COMMON15.id_of("other-vehicle")
    plain, odd = contestant([[ROAD] * 6] * 2, [1] * 4), contestant([[bus] + [ROAD] * 5] * 2, [1] * 4)
    evaluation = scored(data, plain, odd)
    assert evaluation.counted() == [CAR, ROAD]
    mious = [one["score"]["translator"]["camera_miou"] for one in evaluation.as_dict()["results"]]
    assert mious == [pytest.approx(4 / 10 / 2), pytest.approx(3 / 10 / 2)]
    assert "the 2 of the paper's 14 classes" in evaluation.heading()


def test_frames_with_one_kind_of_label(data):
    sequence = data / "sequences" / "00"
    (sequence / "camera_labels" / "000000.png").rename(data / "kept.png")
    points_only = scored(data, told := contestant([[ROAD] * 6] * 2, [9, 1, 9, 9]))
    assert (points_only.images, points_only.scans) == (0, 1)
    assert told.points.accuracy() == 1 and told.sight.sizes == []
    assert "mIoU of 2 SemanticKITTI" in points_only.table() and "| road" not in points_only.table()
    json.dumps(points_only.as_dict(), allow_nan=False)
    (data / "kept.png").rename(sequence / "camera_labels" / "000000.png")
    (sequence / "labels" / "000000.label").unlink()
    camera_only = scored(data, contestant([[ROAD] * 6] * 2, [9, 1, 9, 9]))
    assert (camera_only.images, camera_only.scans) == (1, 0)
    assert "SemanticKITTI" not in camera_only.table()
    (sequence / "camera_labels" / "000000.png").unlink()
    with pytest.raises(InputError, match="000000 has neither camera_labels/ nor labels/"):
        scored(data, contestant([[ROAD] * 6] * 2, [9] * 4))


def test_the_first_frame_warms_up():
    told = contestant([[0]], [0])
    told.milliseconds = {"translate": [100.0, 2.0, 4.0], "camera": [7.0]}
    assert told.mean_milliseconds() == {"translate": 3.0, "camera": 7.0}


class Sides(nn.Module):
    """A translator: `left` in the left half of its picture, `right` in the right half; it keeps what it was shown."""

    def __init__(self, left: int, right: int, size: tuple[int, int] | None = None) -> None:
        super().__init__()
        self.left, self.right, self.size = left, right, size

    def forward(self, image, condition):
        self.shown = image, condition
        height, width = self.size or image.shape[2:]
        logits = torch.zeros(1, 15 if self.size else 16, height, width)
        logits[:, self.left, :, : width // 2], logits[:, self.right, :, width // 2 :] = 1, 1
        return logits if self.size else (logits, torch.ones(1, height, width))


def test_a_panorama_is_looked_up_from_the_camera(random_weights, data):
    (frame,) = frames(data, "val")
    pipeline = contender(random_weights, "cpu").sight.pipeline
    sight = Around(pipeline=replace(pipeline, translator=(sides := Sides(CAR, ROAD))))
    watch, calibration = Stopwatch(sight.device), frame.calibration((1241, 376))
    ids, labels = sight.see(street(), calibration, watch)
    assert torch.equal(sides.shown[0][0], project(street(), at_camera(pipeline.view, calibration)).channels)
    assert ids.shape == (376, 1241) and labels.shape == (len(street()),)
    assert (ids[:5, 590:620] == 0).all()  # ahead, the panorama reaches up to tan 0.24: row 180 - 0.24 * 718.9
    assert (ids[16:, :600] == CAR).all() and (ids[16:, 615:] == ROAD).all()  # ahead is column 607
    assert list(watch.milliseconds) == ["project", "segment", "clean_up", "translate", "camera"]


def test_the_front_is_resized_to_the_cameras_image(front_weights, data):
    (frame,) = frames(data, "val")
    plain = contender(front_weights, "cpu").sight
    sides = Sides(CAR, ROAD, size=(2, 4))
    watch = Stopwatch(plain.device)
    ids, labels = replace(plain, translator=sides).see(street(), frame.calibration((320, 96)), watch)
    assert ids.shape == (96, 320) and labels.shape == (len(street()),)
    assert (ids[:, :159] == CAR).all() and (ids[:, 161:] == ROAD).all()
    assert list(watch.milliseconds) == ["project", "segment", "clean_up", "translate", "camera"]
    image, condition = sides.shown
    front = project(street(), FRONT_VIEW)
    assert torch.equal(image[0], Normalisation()(front))
    assert torch.equal(condition[0].argmax(0), front.spread(labels))
    assert plain.see(street(), frame.calibration((320, 96)), watch)[0].max() < 15
