"""From frames to counts: every system is asked about every frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar2pano.data.frames import IGNORE
from lidar2pano.data.truths import Truth
from lidar2pano.errors import InputError
from lidar2pano.evaluate import report
from lidar2pano.evaluate.contenders import Contender, Flows
from lidar2pano.evaluate.figures import Figure, figures, present
from lidar2pano.evaluate.measures import Measures
from lidar2pano.evaluate.questions import Question, System
from lidar2pano.evaluate.streams import camera_flow, follows, panorama_flow
from lidar2pano.evaluate.tallies import Moved, Tally
from lidar2pano.evaluate.worst import Worst


@dataclass(slots=True, kw_only=True)
class Evaluation:
    """What `score` counted.

    images     how many frames had camera labels;  scans: point labels;  pictures: a camera's picture;  panoramas: the
               truth all around.
    reference  the truth itself, of what is not compared but measured: seams, warping error, re-segmentation.
    """

    contenders: Sequence[Contender]
    reference: Tally
    measures: Measures
    data: str
    split: str
    images: int = 0
    scans: int = 0
    pictures: int = 0
    panoramas: int = 0

    def merge(self, other: Evaluation) -> None:
        """Take in another part of the split, as other frames of the same systems; ValueError where it is not that."""
        for mine, theirs in zip(self.contenders, other.contenders, strict=True):
            mine.merge(theirs)
        self.reference.merge(other.reference)
        for name in ("images", "scans", "pictures", "panoramas"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def counted(self, sector: str = "camera") -> list[int]:
        """The classes that the sector's targets have: the mean is over them, whatever is predicted."""
        counts = (found for one in self.contenders for found in one.tally.labelled(sector))
        first = next(counts, None)
        return [] if first is None else present(first)

    def figures(self, tally: Tally) -> list[Figure]:
        """Every figure of a contender's tally, or of the reference."""
        return list(figures(tally, {sector: self.counted(sector) for sector in ("camera", "panorama", "points")}))

    def heading(self) -> str:
        """What is scored and how."""
        return report.heading(self)

    def table(self) -> str:
        """Markdown: the heading, then a column per system."""
        return report.table(self)

    def records(self) -> list[dict[str, Any]]:
        """One row per system and figure, ready for CSV."""
        return report.records(self)

    def as_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; what is undefined is None or left out."""
        return report.as_dict(self)


def score(
    systems: Sequence[System],
    truths: Iterable[Truth],
    *,
    data: str,
    split: str,
    measures: Measures | None = None,
    worst: int = 0,
    after_each: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Ask every system about every frame and count.

    measures  all that data and weights allow, when None;  worst: how many of a system's worst frames are kept.
    Each frame counts for what is known of it. Frames that follow each other in number, in one sequence, are a stream.
    Raises InputError for a frame of which nothing is known, and for files that are missing, damaged or do not fit.
    """
    measures = measures or Measures()
    contenders = [Contender(system=one, tally=Tally(measures), worst=Worst(worst)) for one in systems]
    reference = Tally(measures)
    found = Evaluation(contenders=contenders, reference=reference, measures=measures, data=data, split=split)
    before: Truth | None = None
    for truth in truths:
        _count(found, truth)
        question, flows = ask(truth, measures), _flows(before, truth, measures)
        for one in contenders:
            one.take(truth, question, flows)
        _refer(reference, before, truth, flows)
        before = truth
        after_each()
    return found


def ask(truth: Truth, measures: Measures) -> Question:
    """What systems are asked about a frame: as much as can be compared with the truth."""
    camera = measures.asks("camera") and (truth.camera_ids is not None or truth.picture is not None)
    around = truth.panorama if measures.asks("panorama") else None
    ids = None
    if camera and truth.camera_ids is not None:
        ids = np.where(truth.camera_ids == IGNORE, 0, truth.camera_ids).astype(np.uint8)
    return Question(
        scan=truth.scan,
        calibration=truth.calibration if camera else None,
        origin=None if around is None else around.view.origin,
        ids=ids,
        painted=measures.painted,
        pose=truth.pose,
    )


def _count(found: Evaluation, truth: Truth) -> None:
    """How many frames have what; InputError where one has nothing."""
    known = (truth.camera_ids, truth.point_ids, truth.picture, truth.panorama)
    if all(part is None for part in known):
        raise InputError(f"{truth.name} has neither camera_labels/ nor labels/, and no picture; label it first")
    names = ("images", "scans", "pictures", "panoramas")
    for name, part in zip(names, known, strict=True):
        setattr(found, name, getattr(found, name) + (part is not None))


def _flows(before: Truth | None, now: Truth, measures: Measures) -> Flows:
    if before is None or not follows(before, now):
        return Flows(following=False)
    timed = "time" in measures.kinds
    return Flows(
        following=True,
        camera=camera_flow(before, now) if timed and "camera" in measures.sectors else None,
        panorama=panorama_flow(before, now) if timed and "panorama" in measures.sectors else None,
    )


def _refer(reference: Tally, before: Truth | None, now: Truth, flows: Flows) -> None:
    """Measure the truth itself, where a figure is of a picture alone."""
    sectors = reference.measures.sectors
    if now.picture is not None and "camera" in sectors:
        reference.resegmented(now.picture, now)
        if flows.camera is not None and before is not None and before.picture is not None:
            reference.warped("camera", now.picture, Moved(before=before.picture, flow=flows.camera), now.name)
    around = now.panorama
    if around is None or "panorama" not in sectors:
        return
    rows = around.valid.all(1)
    if around.view.circular and rows.any():
        reference.seam(np.ascontiguousarray(around.colour[rows]), now.name)
    if flows.panorama is not None and before is not None and before.panorama is not None:
        moved = Moved(before=before.panorama.colour, flow=flows.panorama)
        reference.warped("panorama", around.colour, moved, now.name)
