"""Planner: a town's list of things while it grows; nothing stands on a road or in another thing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar2pano.simulate.draws import stream
from lidar2pano.simulate.places import QUARTERS, Quarter
from lidar2pano.simulate.roads import Road
from lidar2pano.simulate.things import Maker, Occupied, Thing
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

    def stand(  # noqa: PLR0913 what stands where, and how
        self,
        make: Maker,
        name: str,
        xy: np.ndarray,
        yaw: float,
        radius: float,
        *,
        raised: bool = True,
        square: bool = False,
        counted: bool = False,
    ) -> None:
        """Add a thing; `raised`: on the pavement's level; `square`: square to the ground."""
        z = float(self.town.height(xy, raised=raised))
        normal = tuple(self.town.terrain.normal(xy).tolist()) if square else None
        at = (float(xy[0]), float(xy[1]), z)
        number = len(self.things)
        self.things.append(
            Thing(make=make, name=name, number=number, at=at, yaw=yaw, radius=radius, normal=normal, counted=counted)
        )

    def try_stand(  # noqa: PLR0913 as `stand`
        self,
        make: Maker,
        name: str,
        xy: np.ndarray,
        yaw: float,
        radius: float,
        *,
        raised: bool = True,
        square: bool = False,
        counted: bool = False,
    ) -> bool:
        """Add a thing where its circle is free, and take the circle."""
        if not self.occupied.free(float(xy[0]), float(xy[1]), radius):
            return False
        self.occupied.take(float(xy[0]), float(xy[1]), radius)
        self.stand(make, name, xy, yaw, radius, raised=raised, square=square, counted=counted)
        return True
