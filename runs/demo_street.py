"""The street of the demonstration scan: its ground, and what stands where. A pure function of the seed.

Street frame, metres: u along the street, w to the left of its middle, z up from its crown; the sensor stands at u = 0.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import partial

import demo_objects as make
import numpy as np
from demo_objects import Matter, Solid, placed, vehicle
from demo_plots import BACK, bush, lot, tree

LANE, KERB = 3.5, 5.7  # from the middle: edge of the carriageway, kerb behind the bays
SIDE = 3.0  # half the side street's width
BEND = 4.5  # radius of the kerb at the junction
END = 82.0  # nothing is built beyond
CLEAR = 8.5  # clear of bays on both sides of the junction
# What the ground is called and made of; the last one is paint on the road.
SURFACES = (
    ("road", make.ASPHALT),
    ("parking", make.PAVING),
    ("sidewalk", make.SLABS),
    ("terrain", make.GRASS),
    ("other-ground", make.PAVING),
    ("road", make.LINE),
)
ROAD, PARKING, WALK, LAWN, DRIVE, PAINT = range(6)


def stream(seed: int, *name: str | int) -> np.random.Generator:
    """A generator of its own for each named thing, so that a new tree never moves an old car."""
    return np.random.default_rng([seed, *(zlib.crc32(str(part).encode()) for part in name)])


@dataclass(frozen=True, slots=True)
class Ground:
    """Height and surface of every place; `bays` and `drives` are borders u (2K,) of intervals, left and right."""

    junction: float  # u of the side street's middle
    side: int  # +1: it goes off to the left
    bays: tuple[np.ndarray, np.ndarray]
    drives: tuple[np.ndarray, np.ndarray]
    wave: np.ndarray  # (4,) phases of the undulation

    def surface(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Index into SURFACES, paint excepted, of places u, w of one shape."""
        far, along = np.abs(w), np.abs(u - self.junction)
        branch = w * self.side > 0
        d1, d2 = far - LANE, np.where(branch, along - SIDE, 99.0)
        street = (d1 < 0) | (d2 < 0)
        near = branch & (d1 < BEND) & (d2 < BEND)
        street |= near & ((BEND - d1) ** 2 + (BEND - d2) ** 2 > BEND**2)
        left = w > 0
        in_bay = np.where(left, np.searchsorted(self.bays[0], u), np.searchsorted(self.bays[1], u)) % 2 == 1
        in_drive = np.where(left, np.searchsorted(self.drives[0], u), np.searchsorted(self.drives[1], u)) % 2 == 1
        strip = far < KERB
        corner = along < CLEAR
        out = np.where(in_drive & (far < 20), DRIVE, LAWN)
        out = np.where((far < BACK) | (d2 < 2.2), WALK, out)
        out = np.where(strip & ~corner, np.where(in_bay, PARKING, np.where(far < KERB - 0.25, LAWN, WALK)), out)
        return np.where(street, ROAD, out)

    def height(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Z of places u, w: a cambered road, kerbs of 12 cm, gardens that rise a little."""
        far, a = np.abs(w), self.wave
        z = 0.05 * np.sin(u / 21 + a[0]) + 0.03 * np.sin(w / 17 + a[1]) - 0.02 * np.minimum(far, KERB)
        surface = self.surface(u, w)
        rise = 0.12 + 0.02 * np.clip(far - BACK, 0, 15)
        rough = 0.035 * np.sin(u * 2.9 + a[2] + 2 * np.sin(w * 1.9)) * np.sin(w * 3.7 + a[3] + np.sin(u * 2.3))
        raised = rise + np.where(surface == LAWN, rough, 0.0)
        return z + np.where(surface <= PARKING, 0.0, raised)

    def painted(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Where the road carries paint: the middle line, the edges of the bays, a crossing, the line to stop at."""
        before = u - (self.junction - 9.5)
        crossing = (np.abs(before) < 1.6) & (w % 1.0 < 0.5) & (np.abs(w) < LANE - 0.2)
        middle = (np.abs(w) < 0.07) & (u % 9.0 < 4.0) & (np.abs(u - self.junction) > 12)
        edge = (np.abs(np.abs(w) - LANE + 0.06) < 0.06) & (np.abs(u - self.junction) > CLEAR)
        halt = (np.abs(w * self.side - LANE - 0.6) < 0.2) & (np.abs(u - self.junction) < SIDE - 0.3)
        return crossing | middle | edge | halt


def _intervals(rng: np.random.Generator, lengths: tuple, gaps: tuple) -> np.ndarray:
    """Borders u of stretches of these lengths with these gaps between them, from one end to the other."""
    borders, u = [], -END + rng.uniform(0, 8)
    while u < END:
        borders += [u, u + rng.uniform(*lengths)]
        u = borders[-1] + rng.uniform(*gaps)
    return np.array(borders)


def ground(seed: int) -> Ground:
    """The ground of a seed's street."""
    rng = stream(seed, "ground")
    bays = tuple(_intervals(stream(seed, "bays", side), (11.0, 23.0), (3.0, 6.0)) for side in (1, -1))
    drives = tuple(_intervals(stream(seed, "drives", side), (2.8, 3.6), (11.0, 26.0)) for side in (1, -1))
    return Ground(rng.uniform(12, 16), int(rng.choice([-1, 1])), bays, drives, rng.uniform(0, 6, 4))


def _paint(rng: np.random.Generator) -> Matter:
    return make.PAINTS[rng.choice(len(make.PAINTS), p=(0.28, 0.2, 0.2, 0.18, 0.14))]


def _stand(floor: Ground, solids: list[Solid], u: float, w: float, yaw: float = 0.0) -> list[Solid]:
    """Put solids on the ground at u, w."""
    return placed(solids, u, w, float(floor.height(np.array([u]), np.array([w]))[0]), yaw)


def parked(seed: int, floor: Ground) -> list[Solid]:
    """Cars in two of three places of the bays."""
    out = []
    kinds = sorted(make.VEHICLES)
    for s, side in enumerate((1, -1)):
        for bay, (first, last) in enumerate(floor.bays[s].reshape(-1, 2)):
            rng = stream(seed, "parked", side, bay)
            for u in np.arange(first + 2.8, last - 2.4, 5.8):
                paint, kind = _paint(rng), kinds[rng.choice(4, p=(0.3, 0.34, 0.26, 0.1))]
                du, dw, yaw, here = rng.normal(0, 0.25), rng.normal(0, 0.1), rng.normal(0, 0.02), rng.random() < 0.65
                if here and abs(u - floor.junction) > CLEAR + 2.5:
                    way = 0.0 if side < 0 or rng.random() < 0.2 else np.pi
                    out += _stand(floor, vehicle(kind, paint), u + du, side * (LANE + 1.1 + dw), way + yaw)
    return out


def moving(seed: int, floor: Ground) -> list[Solid]:
    """Traffic on the road and people: cars ahead and behind, a van, a cyclist, two pedestrians."""
    rng = stream(seed, "moving")
    out = []
    traffic = (
        (rng.uniform(11, 15), 1.7, "hatchback"),
        (rng.uniform(29, 34), 1.6, "van"),
        (rng.uniform(44, 52), -1.6, "saloon"),
        (-rng.uniform(12, 16), -1.6, "estate"),
        (-rng.uniform(24, 30), 1.6, "saloon"),
    )
    for u, w, kind in traffic:
        out += _stand(floor, vehicle(kind, _paint(rng)), u, w, np.pi * (w > 0))
    out += _stand(floor, make.cyclist(), rng.uniform(7, 10), -2.6, rng.normal(0, 0.05))
    out += _stand(floor, make.person(0.3, 0.3), rng.uniform(4, 8), 6.5, 0.1)
    out += _stand(floor, make.person(0.45, 0.22), -rng.uniform(5, 9), -6.6, np.pi)
    side = floor.side
    out += _stand(
        floor,
        vehicle("hatchback", make.PAINTS[2]),
        floor.junction + 1.3 * side,
        side * rng.uniform(9, 14),
        -side * np.pi / 2,
    )
    return out


def furniture(seed: int, floor: Ground) -> list[Solid]:
    """Street trees between the bays, lamp posts, signs, bins, bicycles."""
    out = []
    for s, side in enumerate((1, -1)):
        borders = floor.bays[s]
        for k, (last, first) in enumerate(borders[1:-1].reshape(-1, 2)):
            rng, u = stream(seed, "verge", side, k), (last + first) / 2
            if abs(u - floor.junction) < CLEAR:
                continue
            out += _stand(floor, tree(rng, rng.uniform(5.5, 9)), u, side * 4.3)
            for b in range(rng.integers(0, 3)):
                own = stream(seed, "verge", side, k, b)
                where = own.uniform(last + 0.6, first - 0.6), side * own.uniform(4, 4.9)
                out += _stand(floor, bush(own, own.uniform(0.35, 0.6)), *where)
        rng = stream(seed, "posts", side)
        for u in np.arange(-75 + rng.uniform(0, 27), 75, 27.0):
            out += _stand(floor, make.post(8.0, 0.065), u + rng.normal(0, 1), side * (KERB + 0.4))
        for u in rng.uniform(-60, 60, 4):
            facing = 0.0 if side < 0 else np.pi
            out += _stand(
                floor,
                make.sign(str(rng.choice(["round", "triangle", "board"])), rng.uniform(0.28, 0.4)),
                u,
                side * (KERB + 0.5),
                facing,
            )
        bin_box = make.box(Matter(0.2, 0.08, 0.2, 0.05), "unlabeled", (-0.3, -0.28, 0), (0.3, 0.28, 1.05))
        for u in rng.uniform(-25, 30, 3):
            out += _stand(floor, [bin_box], u, side * (BACK - 0.4))
        out += _stand(floor, make.bicycle(), rng.uniform(-14, 14), side * (BACK - 0.35), rng.normal(0, 0.05))
    for end in (1, -1):
        where = floor.junction + end * (SIDE + 1.2), floor.side * (KERB + 1.6)
        out += _stand(floor, make.sign("triangle", 0.42), *where, -floor.side * np.pi / 2)
    return out


def _row(seed: int, name: str, start: float, end: float) -> list[Solid]:
    """Plots one beside the other from x = start to end, ground at z = 0."""
    out, x, number = [], start, 0
    while x + 11 < end:
        draw = partial(stream, seed, "lot", name, number)
        wide = min(draw("width").uniform(12, 19), end - x)
        out += lot(draw, x, x + wide)
        x, number = x + wide, number + 1
    return out


def street(seed: int) -> tuple[Ground, list[Solid]]:
    """Ground of a seed's street and everything that stands on it."""
    floor = ground(seed)
    out = parked(seed, floor) + moving(seed, floor) + furniture(seed, floor)
    j, side, clear = floor.junction, floor.side, SIDE + 2.4
    rows = []
    rows += placed(_row(seed, "opposite", -END, END), 0, 0, 0, 0.0 if side < 0 else np.pi)
    # In a row's own frame x grows along the street seen from the houses on the left: turned by pi on the right.
    for name, first, last in (("before", -END, j - clear), ("beyond", j + clear, END)):
        span = (first, last) if side > 0 else (-last, -first)
        rows += placed(_row(seed, name, *span), 0, 0, 0, 0.0 if side > 0 else np.pi)
    shift = BACK - SIDE - 2.3  # the side street is narrower
    for name, hand in (("branch", 1), ("branch", -1)):
        span = (24.0, 66.0) if hand == side else (-66.0, -24.0)
        rows += placed(_row(seed, f"{name} {hand}", *span), j + hand * shift, 0, 0, hand * np.pi / 2)
    return floor, out + rows
