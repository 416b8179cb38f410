"""From frames to counts, and from counts to tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.panoramas import CAMERA_TO_COMMON15
from lidar2pano.data.sequences import Frame
from lidar2pano.errors import InputError
from lidar2pano.evaluate.contenders import UNSCORED, Contender
from lidar2pano.labels import COMMON15
from lidar2pano.metrics.confusion import Confusion


def score(
    contenders: Sequence[Contender],
    frames: Iterable[Frame],
    *,
    data: str,
    split: str,
    after_each: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Let every contender foretell every frame and count.

    Frames without camera labels count for the points only, frames without point labels for the camera only. Raises
    InputError for a frame that has neither, and for files that are missing, damaged or do not fit together.
    """
    images = scans = 0
    for frame in frames:
        scan = replace(frame.scan(), name=frame.name)
        camera, calibration = _camera(frame)
        points = _points(frame, len(scan))
        if camera is None and points is None:
            raise InputError(f"{frame.folder}: {frame.stem} has neither camera_labels/ nor labels/; label it first")
        images, scans = images + (camera is not None), scans + (points is not None)
        for one in contenders:
            one.take(scan, calibration, camera, points)
        after_each()
    return Evaluation(contenders=contenders, data=data, split=split, images=images, scans=scans)


def _camera(frame: Frame) -> tuple[Tensor | None, Calibration | None]:
    if not (frame.folder / "camera_labels" / f"{frame.stem}.png").is_file():
        return None, None
    ids = frame.camera_labels()
    return torch.from_numpy(CAMERA_TO_COMMON15[ids]).long(), frame.calibration((ids.shape[1], ids.shape[0]))


def _points(frame: Frame, number: int) -> Tensor | None:
    there = (frame.folder / "labels" / f"{frame.stem}.label").is_file()
    return torch.from_numpy(frame.labels(number)) if there else None


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What `score` counted: `images` with camera labels and `scans` with point labels of a split."""

    contenders: Sequence[Contender]
    data: str
    split: str
    images: int
    scans: int

    def counted(self) -> list[int]:
        """Those of the 14 classes that the targets have: the mean is over them, whatever is predicted."""
        return _present(self.contenders[0].camera)

    def heading(self) -> str:
        """What is scored and how."""
        there = self.counted()
        names = [name for c, name in enumerate(COMMON15.classes) if c not in (*there, *UNSCORED)]
        absent = f" (absent: {', '.join(names)})" if names else ""
        return (
            f"`{self.split}` of {self.data}: {self.images} camera images, all of each at its own size, from the scan"
            f" alone; {self.scans} scans with point labels. Pixels whose target is unlabeled, sky or unsure are not"
            f" scored; answers of unlabeled or sky count as wrong. mIoU: mean over the {len(there)} of the paper's 14"
            f" classes that occur{absent}."
        )

    def table(self) -> str:
        """Markdown: the heading, then a column per contender."""
        head = ["class", "pixels", *(one.name for one in self.contenders)]
        rows = [head, ["---", *["---:"] * (len(head) - 1)]]
        if self.images:
            rows += self._camera_rows()
        if self.scans:
            there = _present(self.contenders[0].points)
            mious = (one.points.miou(over=there) for one in self.contenders)
            rows.append([f"points: mIoU of {len(there)} SemanticKITTI classes", "", *map(_share, mious)])
            rows.append(["points: accuracy", "", *(_share(one.points.accuracy()) for one in self.contenders)])
        times = [one.mean_milliseconds() for one in self.contenders]
        for stage in dict.fromkeys(stage for one in times for stage in one):
            cells = [f"{one[stage]:.0f}" if stage in one else "-" for one in times]
            rows.append([f"{stage.replace('_', ' ')}, ms", "", *cells])
        rows += self._origin_rows()
        return "\n".join([self.heading(), "", *(f"| {' | '.join(row)} |" for row in rows)])

    def _origin_rows(self) -> list[list[str]]:
        """Where each contender's networks come from, by their cards."""
        rows = []
        for role in dict.fromkeys(role for one in self.contenders for role in one.networks):
            cards = [one.networks.get(role, {}) for one in self.contenders]
            made = [
                f"{card.get('recipe') or '?'}, {card.get('steps', 0)} steps, {card.get('hours', 0)} h" for card in cards
            ]
            rows.append([f"{role}: recipe", "", *made])
            rows.append([f"{role}: commit", "", *(card.get("commit", "")[:12] or "?" for card in cards)])
        return rows

    def _camera_rows(self) -> list[list[str]]:
        there = self.counted()
        named = self.contenders[0].camera.counts.sum(1)
        rows = []
        for c in there:
            share = f"{named[c] / named.sum():.1%}"
            rows.append([COMMON15.classes[c], share, *(_share(float(one.camera.iou()[c])) for one in self.contenders)])
        mious = (one.camera.miou(over=there) for one in self.contenders)
        rows.append([f"**mIoU of {len(there)}**", "", *(f"**{_share(miou)}**" for miou in mious)])
        rows.append(["accuracy", "", *(_share(one.camera.accuracy()) for one in self.contenders)])
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; what is undefined is None."""
        return {
            "data": self.data,
            "split": self.split,
            "images": self.images,
            "scans": self.scans,
            "classes": [COMMON15.classes[c] for c in self.counted()],
            "heading": self.heading(),
            "results": [self._result(one) for one in self.contenders],
        }

    def _result(self, one: Contender) -> dict[str, Any]:
        scores = {
            "segmenter": {
                "point_miou": one.points.miou(over=_present(one.points)),
                "point_accuracy": one.points.accuracy(),
            },
            "translator": {
                "camera_miou": one.camera.miou(over=self.counted()),
                "camera_accuracy": one.camera.accuracy(),
            },
        }
        return {
            "weights": one.name,
            "networks": one.networks,
            "score": {role: _finite(part) | {"split": self.split} for role, part in scores.items()},
            "classes": one.camera.table(),
            "point_classes": one.points.table(),
            "milliseconds": {stage: round(value, 2) for stage, value in one.mean_milliseconds().items()},
        }


def _present(confusion: Confusion) -> list[int]:
    """Classes that some scored target has."""
    return confusion.counts.sum(1).nonzero()[:, 0].tolist()


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _finite(values: dict[str, float]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if math.isfinite(value)}
