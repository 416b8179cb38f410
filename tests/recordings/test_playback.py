"""Scans of recordings by their numbers: the same as one after the other; chunks that overlap; poses around a scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.recorded_scans import frames
from miniature import street
from miniature_recordings import FORMATS, START_NS, STEP_NS, odometry, points, write

COUNT = 12
DRIVE = [points(street(number, 300), START_NS + number * STEP_NS) for number in range(COUNT)]
ORDERS = ([3, 4, 5, 9, 0, 0, 11, 1, 7], [11, 10, 2, 3])


@pytest.mark.parametrize("format", FORMATS)
def test_any_order_gives_the_same_scans(tmp_path, format):
    path = write(tmp_path, format, [odometry(START_NS, (0, 0, 0, 0, 0, 0, 1)), *DRIVE])
    wanted = [frame.sha256 for frame in frames(path, ReadOptions())]
    opened = Playback(path)
    for order in ORDERS:
        for number in order:
            frame = opened.frame(number)
            assert frame.number == number and frame.sha256 == wanted[number]
            np.testing.assert_array_equal(frame.cloud().xyz, street(number, 300).xyz)
    with pytest.raises(InputError, match="has no scan 12"):
        opened.frame(12)
    opened.close()


@pytest.mark.parametrize("format", ["bag", "db3", "folder-mcap", "mcap", "mcap-plain"])
@pytest.mark.parametrize("options", [{}, {"every": 5}, {"start_s": 0.25, "end_s": 0.5}, {"start_s": 0.3, "every": 4}])
def test_the_numbers_are_those_of_the_frames(tmp_path, format, options):
    path = write(tmp_path, format, DRIVE)
    opened = Playback(path)
    selection = ReadOptions(**options)
    assert list(opened.numbers(selection)) == [frame.number for frame in frames(path, selection)]
    with pytest.raises(InputError, match="has no scan between"):
        opened.numbers(ReadOptions(start_s=9))
    opened.close()


def test_chunks_that_overlap_in_time_are_merged(tmp_path):
    path = write(tmp_path, "mcap", [*DRIVE[::2], *DRIVE[1::2]])
    for number, frame in enumerate(frames(path, ReadOptions())):
        assert frame.stamp_s == pytest.approx(1.7e9 + 0.1 * number, abs=1e-6)
        np.testing.assert_array_equal(frame.cloud().xyz, street(number, 300).xyz)
    assert [frame.number for frame in frames(path, ReadOptions(start_s=0.5))] == list(range(5, COUNT))


@pytest.mark.parametrize("format", ["bag", "mcap-plain"])
def test_messages_of_one_time_keep_their_order(tmp_path, format):
    same = [one._replace(stamp_ns=START_NS) for one in DRIVE[:5]]
    opened = Playback(write(tmp_path, format, [*same, DRIVE[5]]))
    for number in (4, 1, 5, 0):
        np.testing.assert_array_equal(opened.frame(number).cloud().xyz, street(number, 300).xyz)
    opened.close()


def test_a_capture_is_read_from_its_beginning():
    pytest.importorskip("velodyne_decoder", reason="packet captures are read by the extra 'recordings'")
    path = Path(__file__).resolve().parents[3] / "shared/realdata/formats/sample_velodyne_vlp16_gps.pcap"
    if not path.exists():
        pytest.skip("the real capture is not here")
    wanted = [frame.cloud().xyz for frame in frames(path, ReadOptions())]
    opened = Playback(path)
    assert list(opened.numbers(ReadOptions(every=3))) == [0, 3]
    for number in (2, 1, 3, 0):
        np.testing.assert_array_equal(opened.frame(number).cloud().xyz, wanted[number])
    assert opened.motion(0, "velodyne") is None
    opened.close()
