"""Planner: a town's list of things while it grows; nothing stands on a road or in another thing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar2pano.simulate.draws import stream
from lidar2pano.simulate.places import QUARTERS, Quarter
from lidar2pano.simulate.roads import Road
from lidar2pano.simulate.things import Occupied, Piece, Thing
from lidar2pano.simulate.town import Stretch, Town


@dataclass(slots=True, eq=False)
class Planner:
    """Things so far, and the footprints that are taken."""

    town: Town
    things: list[Thing] = field(default_factory=list[Thing])
    occupied: Occupied = field(default_factory=Occupied)

    def rng(self, *names: str | int) -> np.random.Generator:
        """A stream of this town's."""
        return stream(self.town.seed, *names)

    def stretches(self) -> list[tuple[int, Road, Stretch, Quarter]]:
        """Every stretch of every road."""
        return [
            (index, self.town.roads[index], stretch, QUARTERS[stretch.quarter])
            for index, row in enumerate(self.town.stretches)
            for stretch in row
        ]

    def stand(self, piece: Piece, xy: np.ndarray, yaw: float) -> None:
        """Add a thing at a place (2,)."""
        z = float(self.town.height(xy, raised=piece.raised))
        self.things.append(
            Thing(
                make=piece.make,
                name=piece.name,
                number=len(self.things),
                at=(float(xy[0]), float(xy[1]), z),
                yaw=yaw,
                radius=piece.radius,
                normal=tuple(self.town.terrain.normal(xy).tolist()) if piece.square else None,
                counted=piece.counted,
            )
        )

    def try_stand(self, piece: Piece, xy: np.ndarray, yaw: float) -> bool:
        """Add a thing where its circle is free, and take the circle."""
        circle = (float(xy[0]), float(xy[1]), piece.radius)
        if not self.occupied.free(*circle):
            return False
        self.occupied.take(*circle)
        self.stand(piece, xy, yaw)
        return True
