"""The scan that ships with the package: a frame of the street world, and such as KITTI's sensor sees a street."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lidar2pano.demo import street
from lidar2pano.formats.scan_files import read_bin, read_label
from lidar2pano.geometry.projection import project
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS

SCRIPT = Path(__file__).resolve().parents[2] / "runs" / "demo_scan.py"
# Share of the points in per cent and their mean remission, generously around what scans of data/kitti-mini have.
LIKE_KITTI = {
    "car": ((2, 18), (0.03, 0.32)),
    "road": ((15, 36), (0.15, 0.32)),
    "sidewalk": ((5, 24), (0.2, 0.4)),
    "building": ((6, 26), (0.2, 0.45)),
    "vegetation": ((8, 32), (0.2, 0.42)),
    "terrain": ((4, 28), (0.2, 0.42)),
    "pole": ((0.1, 1.6), (0.1, 0.4)),
}


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    """The script's functions."""
    if not SCRIPT.is_file():
        pytest.skip("the script is in the repository, not in the source archive")
    pytest.importorskip("embreex", reason="the street world needs embreex")
    return runpy.run_path(str(SCRIPT))


def make(script: dict[str, Any], out: Path, *options: str) -> Scan:
    """Run the script, as its reader would."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(SCRIPT), str(out), *options])
        script["main"]()
    return read_bin(out)


@pytest.fixture(scope="module")
def made(script, tmp_path_factory) -> tuple[Path, Scan, np.ndarray]:
    """The shipped scan made again: its file, its points, their classes."""
    out = tmp_path_factory.mktemp("demo") / "again.bin"
    scan = make(script, out, "--labels")
    return out, scan, read_label(out.with_suffix(".label"), len(scan))


@pytest.fixture(scope="module")
def shipped() -> Scan:
    return read_bin(street())


def beams(scan: Scan) -> np.ndarray:
    """Number of the beam of each point: a turn begins straight ahead and goes to the left."""
    azimuth = np.degrees(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])) % 360
    return np.concatenate([[0], np.cumsum(np.diff(azimuth) < -180)])


def test_script_makes_the_shipped_scan(made, shipped):
    """The same street; on another kind of processor noise may fall differently, so not byte for byte."""
    again, there = (project(scan, VIEWS["hdl64e"]) for scan in (made[1], shipped))
    assert (again.valid == there.valid).float().mean() > 0.93
    both = again.valid & there.valid
    assert ((again.channels[0] - there.channels[0]).abs()[both] < 0.15).float().mean() > 0.9


def test_another_seed_is_another_street(script, made, tmp_path, monkeypatch):
    """The writer is a stand-in: tests/simulate/test_generation.py has streets of other seeds."""
    asked = []

    class Writer:
        def __init__(self, folder, settings, sequence):
            asked.append((folder, settings.seed, settings.place, sequence))

        def scan(self, frame):
            return SimpleNamespace(points=made[1].xyz[: 10 + frame, [0, 1, 2, 2]])

    monkeypatch.setitem(script["main"].__globals__, "SequenceWriter", Writer)
    assert len(make(script, tmp_path / "other.bin", "--seed", "14")) == 10
    assert not (tmp_path / "other.label").exists()  # only when asked
    assert asked == [(tmp_path, 14, "residential", 0)]


def test_size_and_rounding(shipped):
    assert street().stat().st_size <= 2_000_000
    assert 100_000 < len(shipped) <= 125_000  # KITTI's scans have about 120 000
    for values, step in ((shipped.xyz, 1e-3), (shipped.remission, 1e-2)):
        assert np.array_equal(np.round(np.round(values.astype(np.float64) / step) * step, 6).astype(np.float32), values)


def test_sensor(shipped):
    distance = np.linalg.norm(shipped.xyz.astype(np.float64), axis=1)
    assert distance.max() < 120
    assert distance.min() > 0.9
    assert shipped.remission.min() >= 0
    assert shipped.remission.max() <= 0.99
    counts = np.bincount(beams(shipped))
    assert len(counts) == 64
    assert 700 < counts[-1] < 1400  # the car's own roof hides a third


def test_road_lies_under_the_car(made):
    _, scan, label = made
    near = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 8
    road = scan.xyz[(label == SEMANTIC_KITTI.id_of("road")) & near, 2]
    assert np.median(road) == pytest.approx(-1.73, abs=0.06)
    walk = scan.xyz[(label == SEMANTIC_KITTI.id_of("sidewalk")) & near, 2]
    assert 0.03 < np.median(walk) - np.median(road) < 0.25  # the kerb, on a road that is not flat


def test_classes_and_remission_are_like_kitti(made):
    _, scan, label = made
    found = {}
    for name in LIKE_KITTI:
        mask = label == SEMANTIC_KITTI.id_of(name)
        found[name] = (100 * mask.mean(), scan.remission[mask].mean())
    wrong = {
        name: found[name]
        for name, bounds in LIKE_KITTI.items()
        if not all(low <= value <= high for value, (low, high) in zip(found[name], bounds, strict=True))
    }
    assert not wrong
    assert (label == 0).mean() < 0.02
