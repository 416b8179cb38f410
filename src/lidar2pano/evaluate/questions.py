"""What a system is asked about a frame, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Question:
    """What a system is asked about a frame. The scan alone, and from where to look: no truth, except for the ceiling.

    calibration  the camera in whose image, at its size, answers are wanted; None: of the camera nothing is asked.
    origin       the point in the scan's frame, metres, around which a panorama is wanted; None: none is.
    ids          (h, w) uint8 ids of COMMON15, 0 where nobody knows: the camera's true classes, for the ceiling alone.
    painted      whether colours are wanted.
    pose         (4, 4) float64: the scan's coordinates -> coordinates that stand still, metres; None where not known.
    """

    scan: Scan
    calibration: Calibration | None = None
    origin: tuple[float, float, float] | None = None
    ids: np.ndarray | None = None
    painted: bool = True
    pose: np.ndarray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """A system's answer; None where it has none.

    labels        (N,) integer ids of SEMANTIC_KITTI of the scan's points.
    ids           (h, w) integer ids of COMMON15 in the camera's image.
    colour        (h, w, 3) uint8 RGB, the camera's image.
    depth_m       (h, w) float32 metres along the ray in the camera's image; 0 = none.
    panorama      the picture all around;  painted: whether its colours are an answer, not only classes and depths.
    milliseconds  time per stage of the camera's image, or where none was asked for of the panorama.
    """

    labels: np.ndarray | None = None
    ids: np.ndarray | None = None
    colour: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    panorama: Panorama | None = None
    painted: bool = True
    milliseconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """What a system is made of.

    name      as the user said it;  files: weight files by role;  networks: per role what its card says.
    """

    name: str
    files: Mapping[str, Path] = field(default_factory=dict)
    networks: Mapping[str, dict[str, Any]] = field(default_factory=dict)


class System(Protocol):
    """What turns a scan into `Seen`."""

    @property
    def origin(self) -> Origin:
        """What it is made of."""
        ...

    @property
    def told(self) -> bool:
        """Whether it has to be told the camera's true classes: a ceiling, and no answer from the scan."""
        ...

    def see(self, question: Question, past: Any = None) -> tuple[Any, Seen]:  # noqa: ANN401
        """Answer; `past` is what it returned with the frame before, None at the beginning of a stream.

        Returns what it wants back with the next frame, and the answer. Raises InputError for a scan that it can make
        nothing of.
        """
        ...
