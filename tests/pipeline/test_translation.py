"""The one loop: memory along a stream, errors of single scans, sinks, counts for records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.calibration import Calibration
from lidar2pano.drives.reading import Reading, ScanSource
from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.memory import Memory
from lidar2pano.translation import Translator, translate
from miniature import street
from stand_in_pipeline import StandIn


class Counting(StandIn):
    """Notes the number of scans in each memory that it gets, and counts the scan in."""

    def step(self, memory, scan, pose, timer, labels=None, cameras=()):
        self.cards.setdefault("frames", []).append(memory.frames)
        _, panorama = super().step(memory, scan, pose, timer, labels)
        return replace(memory, frames=memory.frames + 1), panorama


def reading(stream: object = None, first: float | None = None, **changes) -> Reading:
    """A reading of a small scan whose first coordinate is `first`."""
    scan = street(0, 50)
    if first is not None:
        scan.xyz[0] = first
    source = ScanSource(path=Path("a.bin"), title="a", stem="a", cloud=PointCloud, stream=stream)
    return replace(Reading(source=source, scan=scan), **changes)


def test_scans_of_a_stream_share_a_memory():
    pipeline = Counting()
    readings = [reading("a"), reading("a"), reading("b"), reading(None), reading(None), reading("b")]
    assert all(one.panorama for one in translate(readings, Translator(lambda: pipeline)))
    assert pipeline.cards["frames"] == [0, 1, 0, 0, 0, 0]


def test_a_bad_scan_has_its_error_and_the_memory_stays():
    pipeline = Counting()
    bad = reading("a", error=InputError("is damaged"), scan=None)
    found = list(translate([reading("a"), bad, reading("a", 2000.0), reading("a")], Translator(lambda: pipeline)))
    assert [str(one.error or "") for one in found] == ["", "is damaged", "scan: no point is in view; turn the scan", ""]
    assert pipeline.cards["frames"] == [0, 1, 1]
    assert found[1].counts() == {"points": None, "dropped": None, "milliseconds": {}}
    assert found[0].counts()["points"] == 50 and "paint" in found[0].counts()["milliseconds"]


def test_a_bug_ends_the_run_unless_it_costs_one_scan():
    scan = street(0, 50)
    scan.xyz[0] = (0, 2000, 0)
    buggy = reading("a", scan=scan)
    with pytest.raises(RuntimeError, match="a bug"):
        list(translate([buggy], Translator(StandIn())))
    bad, good = translate([buggy, reading("a")], Translator(StandIn(), every_fault=True))
    assert isinstance(bad.error, RuntimeError) and good.error is None


def test_the_pipeline_is_made_for_the_first_readable_scan():
    def broken():
        raise InputError("weights are damaged")

    bad = reading(error=InputError("is empty"), scan=None)
    translations = translate([bad, reading()], Translator(broken))
    assert str(next(translations).error) == "is empty"
    with pytest.raises(InputError, match="weights are damaged"):
        next(translations)


def test_labels_and_the_place_of_the_camera_reach_the_pipeline():
    axes = np.eye(4)
    axes[0, 3] = 5
    calibration = Calibration(K=np.eye(3), T_camera_lidar=axes, size=(9, 9))
    plain, labelled, placed = translate(
        [reading(), reading(labels=np.full(50, 3)), reading(calibration=calibration)], Translator(StandIn())
    )
    assert (labelled.panorama.labels == 3).all() and (plain.panorama.labels == 9).all()
    assert (placed.panorama.colour != plain.panorama.colour).any()


def test_sinks_write_and_their_errors_cost_one_scan(tmp_path):
    def write(translation):
        if translation.reading.source.stem == "full":
            raise InputError("full.png: cannot be written")
        return translation.panorama.save(tmp_path, ("rgb",), None, translation.reading.source.stem)

    full = reading()
    full = replace(full, source=replace(full.source, stem="full"))
    first, second, third = translate([reading(), full, reading()], Translator(StandIn()), [write, lambda _: []])
    assert first.outputs == third.outputs == [tmp_path / "a.png"] and "save" in first.counts()["milliseconds"]
    assert second.outputs == [] and "cannot be written" in str(second.error)


def test_a_memory_is_never_handed_on_to_a_scan_by_itself():
    translator = Translator(Counting())
    translator(reading("a"))
    assert translator._memory_of(None) == Memory()
