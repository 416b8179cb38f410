"""Painters of streams of scenes: their contract, and looks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from torch import Tensor, nn

from lidar2pano.errors import InputError, closest
from lidar2pano.scene.record import Scene

QUALITIES = {"fast": 0, "best": 8}  # steps of a latent painter's picture; 0: as many as it has learned to take


class StreamPainter(Protocol):
    """A painter of a stream of scenes."""

    def paint(self, past: Any, scene: Scene, look: str = "") -> tuple[Any, Tensor]:  # noqa: ANN401
        """Paint the panorama of a scan in a stream.

        past  the painter's own record of the previous scan; None at the beginning of a stream.
        look  "A", or "A+B" for the mean of two; "": the painter's own.
        Returns its record for the next scan, None if it needs none, and (1, 3, 2H, 2W) in [-1, 1].
        """
        ...


class LookPainter(nn.Module):
    """A painter of several looks.

    looks  their names;  look: the one painted by default (the first).
    """

    def __init__(self, looks: Sequence[str], look: str = "") -> None:
        super().__init__()
        self.looks, self.look = tuple(looks), look or looks[0]
        self.look_shares(self.look)

    def look_shares(self, look: str) -> list[float]:
        """Return the share of each look in a name, "A" or "A+B" (their mean); InputError for an unknown name."""
        names = [name.strip() for name in (look or self.look).split("+")]
        for name in names:
            if name not in self.looks:
                choices = ", ".join(self.looks)
                raise InputError(f"the painter knows no look {name!r}; it knows {choices}")
        return [names.count(look) / len(names) for look in self.looks]


def check_quality(quality: str) -> None:
    """Raise InputError unless a quality is known."""
    if quality not in QUALITIES:
        raise InputError(f"no quality {quality!r}{closest(quality, QUALITIES)}")
