"""Vehicles by name: what is parked, and what drives by."""

from __future__ import annotations

from functools import partial

import numpy as np

from lidar2pano.simulate import cars, large_vehicles, two_wheelers
from lidar2pano.simulate.mesh import Mesh
from lidar2pano.simulate.things import Maker

_MAKERS = {
    "car": cars.car,
    "van": partial(cars.car, body="van"),
    "truck": large_vehicles.truck,
    "trailer": large_vehicles.trailer,
    "bus": large_vehicles.bus,
    "tram": large_vehicles.tram,
    "motorcycle": two_wheelers.motorcycle,
    "bicycle": two_wheelers.bicycle,
    "motorcyclist": two_wheelers.motorcyclist,
    "bicyclist": two_wheelers.bicyclist,
}


def _made(rng: np.random.Generator, _: float, name: str) -> Mesh:
    return _MAKERS[name](rng)


VEHICLES: dict[str, Maker] = {name: partial(_made, name=name) for name in _MAKERS}
"""Makers of vehicles, which have one detail and no gait."""
