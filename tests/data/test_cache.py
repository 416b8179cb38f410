"""What data sets keep: as much in memory as the limit allows, and predictions on disk once for all processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lidar2pano.data.cache import LruCache, PredictedLabels, nbytes
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.scan import Scan
from miniature import street, write_data_set


def test_the_values_used_last_are_held_within_the_limit():
    cache, read = LruCache(limit=100), []

    def get(key: int) -> np.ndarray:
        return cache.get(key, lambda: read.append(key) or np.full(40, key, np.uint8))

    for key in (0, 1, 0, 2, 0, 1):
        assert (get(key) == key).all() and cache.held_bytes <= 100
    assert read == [0, 1, 2, 1], "1 was used longest ago when 2 came"
    assert cache.get("large", lambda: np.zeros(1000)) is cache.get("large", lambda: np.zeros(1)), "at least one is held"
    assert cache.held_bytes == 8000


def test_bytes_of_parts_count():
    scan = street(0, points=10)
    assert nbytes(scan) == 10 * (12 + 4 + 8)
    assert nbytes((scan, torch.zeros(3), "name", None)) == 240 + 12


class Segmenter:
    """Labels every point by its remission, and counts its scans."""

    def __init__(self) -> None:
        self.scans = 0

    def __call__(self, scan: Scan) -> torch.Tensor:
        self.scans += 1
        return torch.from_numpy((scan.remission * 20).astype(np.int64))


@pytest.fixture
def user_cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def root(tmp_path) -> Path:
    return write_data_set(tmp_path / "set")


def weights(root: Path, content: bytes) -> Path:
    path = root / f"{content.decode()}.safetensors"
    path.write_bytes(content)
    return path


@pytest.mark.usefixtures("user_cache")
def test_predictions_are_made_once_per_scan_and_weights(root):
    frame, segmenter = frames(root, "train")[0], Segmenter()
    one = PredictedLabels(segmenter, weights(root, b"one")).of(frame)
    assert one.dtype == np.int64 and np.array_equal(one, (frame.scan.remission * 20).astype(int))
    again = PredictedLabels(segmenter, weights(root, b"one")).of(frames(root, "train")[0])
    assert np.array_equal(one, again) and segmenter.scans == 1, "another process reads the file"
    PredictedLabels(segmenter, weights(root, b"two")).of(frame)
    PredictedLabels(segmenter, weights(root, b"one")).of(frames(root, "train")[1])
    assert segmenter.scans == 3, "other weights, another scan"
    assert len(list((root / ".lidar2pano").rglob("*.zlib"))) == 3
    assert not list((root / ".lidar2pano").rglob(".*.zlib*")), "nothing half-written stays"


@pytest.mark.usefixtures("user_cache")
def test_a_damaged_prediction_is_made_again(root):
    frame, segmenter = frames(root, "train")[0], Segmenter()
    labels = PredictedLabels(segmenter, weights(root, b"one"))
    expected = labels.of(frame)
    (file,) = (root / ".lidar2pano").rglob("*.zlib")
    for content in (b"no", file.read_bytes()[:-9]):
        file.write_bytes(content)
        assert np.array_equal(labels.of(frame), expected)
    assert segmenter.scans == 3


def test_predictions_of_a_read_only_data_set_go_to_the_users_cache(root, user_cache):
    segmenter = Segmenter()
    labels = PredictedLabels(segmenter, weights(root, b"one"))
    (root / ".lidar2pano").write_bytes(b"")  # a file: no folder can be made there, not even by root
    for _ in range(2):
        labels.of(frames(root, "train")[0])
    assert segmenter.scans == 1 and len(list(user_cache.rglob("*.zlib"))) == 1
    next(user_cache.rglob("*.zlib")).unlink()
    labels.of(Frame("a", scan=street(7)))
    assert segmenter.scans == 2 and len(list(user_cache.rglob("*.zlib"))) == 1
