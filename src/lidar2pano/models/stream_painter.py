"""Painters of a stream of scenes, and the qualities of their pictures."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from lidar2pano.errors import InputError, closest
from lidar2pano.scene.record import Scene

QUALITIES = {"fast": 0, "best": 4}  # steps of a latent painter's picture; 0: as many as its settings say
SEEDS = range(1 << 63)  # of a latent painter's pictures


class StreamPainter(Protocol):
    """A painter of a stream of scenes."""

    def paint(self, past: Any, scene: Scene, look: str = "") -> tuple[Any, Tensor]:  # noqa: ANN401
        """Paint the panorama of a scan in a stream.

        past  the painter's own record of the previous scan; None at the beginning of a stream.
        look  "A", or "A+B" for the mean of two; "": the painter's own.
        Returns its record for the next scan, None if it needs none, and (1, 3, 2H, 2W) in [-1, 1].
        """
        ...


def check_variant(quality: str, seed: int) -> None:
    """Raise InputError unless a quality is known, and a seed one of SEEDS."""
    if quality not in QUALITIES:
        raise InputError(f"no quality {quality!r}{closest(quality, QUALITIES)}")
    if seed not in SEEDS:
        raise InputError(f"seed {seed}: is not between 0 and {SEEDS[-1]}; name another")
