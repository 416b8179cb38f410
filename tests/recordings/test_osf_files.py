"""OSF is read without the vendor's library.

`dual_returns.osf` and `two_sensors.osf` are two turns of 8 beams x 512 columns each, written by ouster-sdk 1.0.1 (its
PNG and its ZPNG encoder); XYZ and RANGE are the formulas they were filled with, and the points its XYZLut gave.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.recorded_scans import describe, frames

HERE = Path(__file__).parent
DUAL, TWO = HERE / "dual_returns.osf", HERE / "two_sensors.osf"
BEAMS, COLUMNS, LOST = 8, 512, 20
UINT16, UINT32 = 2, 3  # of CHAN_FIELD_TYPE
XYZLUT = {  # (sensor, turn) -> the places of beam 0, column 1 and of beam 5, column 100, by ouster-sdk
    (0, 0): ([-3.85620531, 0.24875218, 1.06736684], [-1.50946886, 4.46187878, -0.49276258]),
    (0, 1): ([-4.82011438, 0.31113817, 1.32618588], [-1.82786055, 5.40320268, -0.60472705]),
    (1, 0): ([-8.67575065, 0.56068216, 2.36146207], [-3.10142729, 9.16849829, -1.05258496]),
    (1, 1): ([-9.63965972, 0.62306816, 2.62028111], [-3.41981898, 10.1098222, -1.16454943]),
}


def range_mm(turn: int, sensor: int = 0) -> np.ndarray:
    beam, column = np.mgrid[:BEAMS, :COLUMNS]
    return np.where(column % 64 == 0, 0, 4000 + column // 8 * 20 + 100 * beam + 1000 * turn + 5000 * sensor)


def clouds(path: Path, topic: str = "") -> list:
    return [frame.cloud() for frame in frames(path, ReadOptions(topic=topic))]


@pytest.mark.parametrize(
    ("path", "topic", "sensor"), [(DUAL, "", 0), (TWO, "122000000001", 0), (TWO, "122000000002", 1)]
)
def test_points_are_those_of_the_vendors_library(path, topic, sensor):
    turns = clouds(path, topic)
    assert len(turns) == 2
    kept = [column for column in range(COLUMNS) if column != LOST]
    for turn, cloud in enumerate(turns):
        first = cloud.xyz[: BEAMS * len(kept)].reshape(BEAMS, len(kept), 3)
        np.testing.assert_allclose(first[0, 1], XYZLUT[sensor, turn][0], atol=1e-5)
        np.testing.assert_allclose(first[5, kept.index(100)], XYZLUT[sensor, turn][1], atol=1e-5)
        held = range_mm(turn, sensor)[:, kept] > 0
        assert (first.any(-1) == held).all()
        np.testing.assert_allclose(
            np.linalg.norm(first, axis=-1)[held], range_mm(turn, sensor)[:, kept][held] / 1e3, atol=0.04
        )
        assert cloud.intensity is not None and cloud.ring is not None and cloud.time_s is not None
        assert (cloud.intensity[: held.size].reshape(held.shape) == 10 * np.arange(BEAMS)[:, None] + turn).all()
        assert cloud.time_s[: len(kept)] == pytest.approx(np.array(kept) * 1e-4)
        assert cloud.stamp_s == pytest.approx(1000 + 0.1 * turn)


def test_near_infrared_light_is_not_the_signal(tmp_path):
    """Both are 5 in the file, of the second return the signal is 0: numbers 3 and 4 make it the first one's."""
    ranges = bytes([1, UINT32, 2, UINT32])
    data, path = DUAL.read_bytes(), tmp_path / "a.osf"
    assert data.count(signals := ranges + bytes([3, UINT16, 4, UINT16])) == 2, "one for each turn"
    path.write_bytes(data.replace(signals, ranges + bytes([4, UINT16, 3, UINT16])))
    for cloud in (*clouds(DUAL), *clouds(path)):
        assert (cloud.near_infrared == 5).all()


def test_second_returns_follow():
    cloud = clouds(DUAL)[0]
    column = np.arange(COLUMNS)
    further = np.tile((column // 4 % 3 == 1) & (column != LOST), BEAMS).sum()
    assert len(cloud.xyz) == BEAMS * (COLUMNS - 1) + further
    assert (cloud.intensity[-further:] == 77).all()
    assert np.linalg.norm(cloud.xyz[-further:], axis=1).min() > 0.7


def test_what_a_file_holds_is_listed(capsys):
    found = describe(TWO)
    assert found is not None and found.format == "OSF"
    assert [(topic.name, topic.count) for topic in found.topics] == [("122000000001", 2), ("122000000002", 2)]
    with pytest.raises(InputError, match="holds points on 122000000001, 122000000002; choose one with --topic$"):
        clouds(TWO)
    assert main(["inspect", str(DUAL)]) == 0
    assert "122000000001" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("start", "replacement", "says"),
    [
        (31, b"\1", "was not closed by its recorder; write it again with `ouster-cli source FILE save COPY.osf`"),
        (928, b"\xff\xff\xff\x7f", "is damaged or cut short (a part of 2147483647 bytes)"),
        (21284, b"\xff\xff\xff\x00", "is damaged or cut short (a part has"),
        (21284 + 4, b"\xff\xff\xff\x7f", "is damaged or cut short"),
    ],
)
def test_damage_is_one_line(tmp_path, start, replacement, says):
    data = bytearray(DUAL.read_bytes())
    data[start : start + len(replacement)] = replacement
    path = tmp_path / "a.osf"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        clouds(path)
    assert says in str(caught.value) and str(caught.value).startswith(str(path))


def test_a_file_that_is_cut_is_refused(tmp_path):
    path = tmp_path / "a.osf"
    shutil.copy(DUAL, path)
    with path.open("r+b") as file:
        file.truncate(9000)
    with pytest.raises(InputError, match="cut short"):
        clouds(path)
