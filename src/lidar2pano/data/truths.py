"""Frames as records whose parts are all read at once; to be replaced by `data.frames` and then deleted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame, frames
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePanorama:
    """See PanoramaGroundTruth."""

    view: View
    colour: np.ndarray
    valid: np.ndarray
    ids: np.ndarray | None = None
    depth_m: np.ndarray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """See Frame; camera_ids are of COMMON15."""

    name: str
    scan: Scan
    calibration: Calibration | None = None
    picture: np.ndarray | None = None
    camera_ids: np.ndarray | None = None
    point_ids: np.ndarray | None = None
    panorama: TruePanorama | None = None
    pose: np.ndarray | None = None


class Truths(Sequence[Truth]):
    """See FrameList."""

    def __init__(self, kind: str, found: Sequence[Frame], names: tuple[str, ...]) -> None:
        self.kind, self.found, self.names = kind, found, names

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.found)

    @overload
    def __getitem__(self, index: int) -> Truth: ...

    @overload
    def __getitem__(self, index: slice) -> Truths: ...

    def __getitem__(self, index: int | slice) -> Truth | Truths:
        """Read a frame; of a slice nothing is read."""
        if isinstance(index, slice):
            return Truths(self.kind, self.found[index], self.names[index])
        return frame_truth(self.found[index])


def truths(root: Path, split: str, view: View = VIEWS["panorama"]) -> Truths:
    """See `frames`."""
    found = frames(root, split, view)
    kinds: dict[str, str] = {"semantic-kitti": "frames", "simulated": "world"}
    return Truths(kinds.get(found.layout, found.layout), found, found.names)


def frame_truth(frame: Frame) -> Truth:
    """All parts of a frame."""
    around, ids = frame.panorama, frame.camera_labels
    panorama = None
    if around is not None:
        panorama = TruePanorama(
            view=around.view, colour=around.image, valid=around.valid, ids=around.labels, depth_m=around.depth_m
        )
    return Truth(
        name=frame.name,
        scan=frame.scan,
        calibration=frame.calibration,
        picture=frame.image,
        camera_ids=None if ids is None else CITYSCAPES_TO_COMMON15[ids],
        point_ids=frame.point_labels,
        panorama=panorama,
        pose=frame.pose,
    )
