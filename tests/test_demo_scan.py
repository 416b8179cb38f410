"""The scan that ships with the package: made by its script to the byte, and such as KITTI's sensor sees a street."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.demo import street
from lidar2pano.formats.kitti import read_bin, read_label
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

SCRIPT = Path(__file__).resolve().parent.parent / "runs" / "demo_scan.py"
# Share of the points in per cent, and their mean remission. The means over 40 scans of data/kitti-mini (2011-09-26 to
# 2011-10-03) and over 3 of its sequence 00 lie within, where these have the class; one street may have more cars.
LIKE_KITTI = {
    "car": ((3, 15), (0.05, 0.2)),
    "bicycle": ((0.05, 1), (0.1, 0.4)),
    "person": ((0.1, 1.5), (0.15, 0.4)),
    "bicyclist": ((0.05, 1), (0.15, 0.4)),
    "road": ((18, 32), (0.16, 0.27)),
    "parking": ((1, 9), (0.2, 0.35)),
    "sidewalk": ((8, 24), (0.22, 0.34)),
    "other-ground": ((0.1, 4), (0.2, 0.35)),
    "building": ((9, 20), (0.22, 0.45)),
    "fence": ((0.3, 7), (0.2, 0.35)),
    "vegetation": ((17, 30), (0.25, 0.36)),
    "trunk": ((0.3, 2.5), (0.18, 0.35)),
    "terrain": ((1.5, 10), (0.25, 0.36)),
    "pole": ((0.3, 1.5), (0.12, 0.28)),
    "traffic-sign": ((0.05, 0.6), (0.2, 0.5)),
}


def make(out: Path, *options: str) -> Scan:
    """Run the script, as its reader would."""
    if not SCRIPT.is_file():
        pytest.skip("the script is in the repository, not in the source archive")
    subprocess.run([sys.executable, str(SCRIPT), str(out), *options], check=True, timeout=300, capture_output=True)
    return read_bin(out)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Scan, np.ndarray]:
    """The shipped scan made again: its file, its points, their classes."""
    out = tmp_path_factory.mktemp("demo") / "again.bin"
    scan = make(out, "--labels")
    return out, scan, read_label(out.with_suffix(".label"), len(scan))


@pytest.fixture(scope="module")
def shipped() -> Scan:
    return read_bin(street())


def beams(scan: Scan) -> np.ndarray:
    """Number of the beam of each point: a turn begins straight ahead and goes to the left."""
    azimuth = np.degrees(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])) % 360
    return np.concatenate([[0], np.cumsum(np.diff(azimuth) < -180)])


def test_script_makes_the_shipped_bytes(made):
    assert made[0].read_bytes() == street().read_bytes()


def test_another_seed_is_another_street(made, tmp_path):
    other = make(tmp_path / "other.bin", "--seed", "14")
    assert not (tmp_path / "other.label").exists()  # only when asked
    assert 100_000 < len(other) < 131_072
    same = min(len(other), len(made[1]))
    assert (other.xyz[:same] == made[1].xyz[:same]).all(axis=1).mean() < 0.01


def test_size_and_rounding(shipped):
    assert street().stat().st_size <= 2_000_000
    assert 105_000 < len(shipped) <= 125_000  # KITTI's scans have about 120 000
    for values, step in ((shipped.xyz, 1e-3), (shipped.remission, 1e-2)):
        assert np.array_equal(np.round(np.round(values.astype(np.float64) / step) * step, 6).astype(np.float32), values)


def test_sensor(shipped):
    distance = np.linalg.norm(shipped.xyz.astype(np.float64), axis=1)
    assert distance.max() < 80
    assert distance.min() > 1.5  # nothing of the car itself
    assert shipped.remission.min() >= 0
    assert shipped.remission.max() <= 0.99
    beam = beams(shipped)
    counts = np.bincount(beam)
    assert len(counts) == 64
    assert counts[:40].min() > 1600  # some sky, some glass
    assert 900 < counts[-1] < 1300  # the car's own roof hides a third
    far = distance > 12
    elevation = np.degrees(np.arctan2(shipped.xyz[:, 2], np.hypot(shipped.xyz[:, 0], shipped.xyz[:, 1])))
    middle = np.array([np.median(elevation[far & (beam == k)]) for k in range(24)])
    np.testing.assert_allclose(np.diff(middle), -1 / 3, atol=0.3)  # a third of a degree apart, seen from the origin
    assert middle[0] == pytest.approx(2.0, abs=0.9)


def test_road_lies_under_the_car(made):
    _, scan, label = made
    near = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 8
    road = scan.xyz[(label == SEMANTIC_KITTI.id_of("road")) & near, 2]
    assert np.median(road) == pytest.approx(-1.73, abs=0.04)
    assert np.percentile(np.abs(road + 1.73), 99) < 0.15
    walk = scan.xyz[(label == SEMANTIC_KITTI.id_of("sidewalk")) & near, 2]
    assert 0.03 < np.median(walk) - np.median(road) < 0.15  # kerb of 12 cm, less the camber


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


def test_beams_keep_as_many_points_as_kitti_s(shipped, kitti_mini):
    """Summed over groups of four beams, 15 per cent at most between our street and the three scans of sequence 00."""
    ours = np.bincount(beams(shipped), minlength=64).reshape(16, 4).sum(axis=1)
    real = [beams(read_bin(kitti_mini / "sequences" / "00" / "velodyne" / f"00000{k}.bin")) for k in range(3)]
    theirs = (
        np.mean([np.bincount(np.minimum(beam, 63), minlength=64) for beam in real], axis=0).reshape(16, 4).sum(axis=1)
    )
    np.testing.assert_allclose(ours, theirs, rtol=0.15)
