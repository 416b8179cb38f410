"""A segmenter labels all scans of a run once, before its first step, on the run's device."""

from __future__ import annotations

import os
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lidar2pano.data.cache import PredictedLabels
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.progress import shown_by
from lidar2pano.scan import Scan
from lidar2pano.train.task import LabelPoints, load_segmenter, predict_all
from miniature import write_data_set


class Counting(LabelPoints):
    """Labels points by their remission; notes scans and devices."""

    def __init__(self) -> None:
        self.scans: list[str] = []
        self.devices: list[str] = []

    def __call__(self, scan: Scan) -> torch.Tensor:
        self.scans.append(scan.name)
        return torch.from_numpy((scan.remission * 20).astype(np.int64))

    def move(self, device: torch.device) -> None:
        self.devices.append(device.type)


@pytest.fixture
def task(tmp_path):
    root = write_data_set(tmp_path / "set")
    (tmp_path / "weights").write_bytes(b"1")
    predicted = PredictedLabels(Counting(), tmp_path / "weights")
    sets = [SimpleNamespace(frames=frames(root, split), predicted=predicted) for split in ("train", "val")]
    return SimpleNamespace(dataset=sets[0], validation=sets[1], root=root, label_points=predicted.label_points)


def test_every_scan_is_labelled_once_and_on_the_device(task, monkeypatch):
    predict_all(task, torch.device("meta"))
    assert sorted(task.label_points.scans) == [*task.dataset.frames.names, *task.validation.frames.names]
    assert task.label_points.devices == ["meta", "cpu", "meta", "cpu"], "afterwards workers may use it"
    monkeypatch.setattr(Frame, "scan", property(lambda _: pytest.fail("a scan was read again")))
    monkeypatch.setattr(type(task.dataset.frames[0]), "scan", Frame.scan)
    predict_all(task, torch.device("cpu"))
    assert len(task.label_points.scans) == 5


def test_a_scan_that_changed_is_looked_at_again(task):
    predict_all(task, torch.device("cpu"))
    os.utime(task.root / "sequences/00/velodyne/000001.bin", ns=(1, 1))
    predict_all(task, torch.device("cpu"))
    assert len(task.label_points.scans) == 5, "its content is the same: the file on disk is"
    path = task.root / "sequences/00/velodyne/000001.bin"
    path.write_bytes(path.read_bytes()[:-16])
    predict_all(task, torch.device("cpu"))
    assert task.label_points.scans[5:] == ["00/000001"]


def test_processes_share_the_scans_and_say_how_far_they_are(task):
    said = []

    @contextmanager
    def show(total, title):
        said.append((total, title))
        yield lambda: said.append("one")

    with shown_by(show):
        predict_all(task, torch.device("cpu"), rank=1, world=2)
        assert not said and task.label_points.scans == ["00/000001", "01/000001"]
        predict_all(task, torch.device("cpu"), rank=0, world=2)
    assert sorted(task.label_points.scans) == [*task.dataset.frames.names, *task.validation.frames.names]
    assert said[:3] == [(2, "labelling 2 scans on cpu, once: the labels are kept on disk"), "one", "one"]


def test_a_segmenter_without_a_view_is_named(tmp_path):
    settings = {"widths": (4, 4, 4, 4)}
    card = Card(
        network="salsanext", settings=settings, labels="semantic-kitti", normalisation=Normalisation().as_dict()
    )
    save(file := tmp_path / "segmenter.safetensors", build("salsanext", **settings), card)
    with pytest.raises(InputError, match=rf"{file}: its card has no view 'input' that makes sense"):
        load_segmenter(str(file))


def test_without_a_segmenter_nothing_happens():
    predict_all(SimpleNamespace(dataset=FrameList()), torch.device("cpu"))  # type: ignore[arg-type]
