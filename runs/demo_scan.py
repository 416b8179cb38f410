"""Make the scan that ships with the package: a town street of our own, as an HDL-64E on a car's roof sees it.

    python runs/demo_scan.py [OUT] [--seed N] [--labels]

OUT is a KITTI .bin (default: the one inside the package); --labels writes its SemanticKITTI .label beside it. The
result is a pure function of the seed. Distances in metres; the street's frame is described in demo_street.py, the
sensor's is KITTI's: x forward, y left, z up, origin 1.73 m above the road.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from demo_objects import GLASS, PANE, Solid
from demo_street import LAWN, PAINT, ROAD, SURFACES, Ground, stream, street

from lidar2pano.formats.kitti import write_bin, write_label
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

SHIPPED = Path(__file__).resolve().parent.parent / "src" / "lidar2pano" / "demo" / "street.bin"
SEED = 13
STEPS = 2083  # firings a turn at 10 Hz: 0.1728 degrees
BEAMS = 64
# HDL-64E: 32 beams 1/3 degree apart from +2 down, 32 beams 1/2 degree apart from -8.83 down (data sheet). The beams
# leave the housing above the frame's origin, the upper block higher than the lower one.
ELEVATION = np.concatenate([2 - np.arange(32) / 3, -8.83 - np.arange(32) / 2])
RISE = np.concatenate([np.full(32, 0.205), np.full(32, 0.12)])
HEIGHT, LANE_W = 1.73, -1.65  # the sensor over the road, in the right lane
YAW = np.radians(1.2)  # the car is not quite straight
FARTHEST, NEAREST = 80.0, 0.9
# What the car itself hides: azimuth, first beam, half width in degrees at that beam and at the last one, stagger of
# every other beam (they look past the mounts from the other side of the housing).
HIDDEN = (
    (180, 52, 20, 28, 0), (0, 57, 12, 20, 0), (161, 42, 3, 3, 2), (-159, 42, 3, 3, 2), (128, 55, 2, 9, 3),
    (-130, 55, 3, 9, 3), (-68, 46, 11, 8, 4), (36, 61, 2, 6, 3), (-36, 61, 2, 6, 3),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """One turn of the sensor in the street's frame: `way` (64, W, 3) unit vectors, `start` (64, 3)."""

    way: np.ndarray
    start: np.ndarray
    elevation: np.ndarray  # (64,) radians, falling
    step: float  # radians from column to column


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """What each ray meets first: arrays (64, W), and (64, W, 4) for `matter`."""

    distance: np.ndarray  # inf: nothing
    facing: np.ndarray  # cosine of incidence
    label: np.ndarray  # ids of SEMANTIC_KITTI
    matter: np.ndarray  # albedo, spread, gloss, loss

    @classmethod
    def empty(cls, beams: int, steps: int) -> Returns:
        """Nothing met yet."""
        shape = beams, steps
        return cls(np.full(shape, np.inf), np.ones(shape), np.zeros(shape, np.int64), np.zeros((*shape, 4)))


def rays(floor: Ground) -> Rays:
    """The sensor's rays; its beams are a few hundredths of a degree off their table, as every real one's are."""
    elevation = np.radians(ELEVATION + stream(0, "sensor", "elevation").normal(0, 0.03, BEAMS))
    azimuth = np.arange(STEPS) * (2 * np.pi / STEPS) + YAW
    turn = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    flat = np.cos(elevation)[:, None, None] * turn
    way = np.concatenate([flat, np.broadcast_to(np.sin(elevation)[:, None, None], (BEAMS, STEPS, 1))], axis=2)
    road = float(floor.height(np.zeros(1), np.full(1, LANE_W))[0])
    start = np.stack([np.zeros(BEAMS), np.full(BEAMS, LANE_W), road + HEIGHT + RISE], axis=1)
    return Rays(way, start, elevation, 2 * np.pi / STEPS)


def window(beams: Rays, solid: Solid) -> tuple[slice, np.ndarray]:
    """The beams and columns that can meet a solid."""
    away = solid.centre - beams.start.mean(axis=0)
    reach, flat = solid.reach + 0.08, float(np.hypot(away[0], away[1]))
    distance = float(np.hypot(flat, away[2]))
    half = np.arcsin(reach / distance) if distance > reach else np.pi
    middle = np.arctan2(away[2], flat)
    rows = slice(*np.searchsorted(-beams.elevation, (-(middle + half) - 0.003, -(middle - half) + 0.003)))
    wide = np.arcsin(reach / flat) if flat > reach else np.pi
    centre = np.arctan2(away[1], away[0]) - YAW
    first, last = np.floor((centre - wide) / beams.step), np.ceil((centre + wide) / beams.step)
    return rows, np.arange(int(first), int(min(last, first + STEPS - 1)) + 1) % STEPS


def distance_to(solid: Solid, beams: Rays) -> float:
    """Metres from the sensor to the middle of a solid."""
    return float(np.linalg.norm(solid.centre - beams.start[0]))


def crossing(solid: Solid, start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances at which rays (local start (B, 1, 3), way (B, C, 3)) enter and leave; enter > leave where they miss."""
    if solid.planes is not None:
        rate = way @ solid.planes[:, :3].T
        at = (solid.planes[:, 3] - start @ solid.planes[:, :3].T) / np.where(np.abs(rate) < 1e-9, 1e-9, rate)
        return np.where(rate < 0, at, -np.inf).max(axis=2), np.where(rate < 0, np.inf, at).min(axis=2)
    round_ = slice(0, 2) if solid.drum else slice(0, 3)
    a = np.maximum((way[..., round_] ** 2).sum(axis=2), 1e-12)
    b = (way[..., round_] * start[..., round_]).sum(axis=2)
    c = (start[..., round_] ** 2).sum(axis=2) - 1
    root = b * b - a * c
    spread = np.sqrt(np.maximum(root, 0)) / a
    enter, leave = np.where(root < 0, np.inf, -b / a - spread), np.where(root < 0, -np.inf, -b / a + spread)
    if solid.drum:
        fall = np.where(np.abs(way[..., 2]) < 1e-9, 1e-9, way[..., 2])
        ends = (np.array([-1.0, 1.0])[:, None, None] - start[..., 2]) / fall
        enter, leave = np.maximum(enter, ends.min(axis=0)), np.minimum(leave, ends.max(axis=0))
    return enter, leave


def normals(solid: Solid, at: np.ndarray) -> np.ndarray:
    """Unit normals in the street's frame of local surface points (N, 3)."""
    if solid.planes is not None:
        gap = at @ solid.planes[:, :3].T - solid.planes[:, 3]
        local = solid.planes[gap.argmax(axis=1), :3]
    elif solid.drum:
        cap = np.abs(at[:, 2]) > np.hypot(at[:, 0], at[:, 1])
        local = np.where(cap[:, None], at * [0, 0, 1], at * [1, 1, 0])
    else:
        local = at
    out = local @ np.linalg.inv(solid.axes)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def pattern(solid: Solid, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where local surface points (N, 3) are holes, and where they are glass."""
    size = np.linalg.norm(solid.axes, axis=0)
    x, y, z = (at * size).T
    none = np.zeros(len(at), dtype=bool)
    if solid.skin == "facade":
        return none, ((x + y + 0.7) % 2.7 < 1.15) & (z % 2.8 > 0.95) & (z % 2.8 < 2.15)
    if solid.skin == "cabin":
        return none, (z > 0.99) & (z < 1.36) & (np.abs(x + 0.38) > 0.05) & (np.abs(x + 1.38) > 0.05)
    if solid.skin == "panels":
        return none, (z > 1.25) & (z < 1.75) & (x > 0.1)
    if solid.skin == "pickets":
        rail = np.abs(np.abs(z) - 0.6 * size[2]) < 0.05
        return (x % 0.16 > 0.1) & ~rail, none
    if solid.skin == "spokes":
        angle = np.arctan2(at[:, 1], at[:, 0]) % 0.4
        return (np.hypot(at[:, 0], at[:, 1]) < 0.86) & (angle > 0.07), none
    return none, none


def strike(seen: Returns, beams: Rays, solid: Solid, depth: np.ndarray) -> None:
    """Let the rays meet one solid; `depth` (64, W) exponential draws say how far each gets into what is porous."""
    nearest = distance_to(solid, beams) - solid.reach
    rows, columns = window(beams, solid)
    if rows.start >= rows.stop or nearest > FARTHEST:
        return
    found = seen.distance[rows][:, columns]
    if found.max() < nearest - 0.1:  # all of them have ended before
        return
    inverse = np.linalg.inv(solid.axes)
    start = ((beams.start[rows] - solid.centre) @ inverse.T)[:, None]
    way = beams.way[rows][:, columns] @ inverse.T
    enter, leave = crossing(solid, start, way)
    if solid.pores:
        enter = enter + solid.pores * depth[rows][:, (columns + solid.salt) % STEPS]
    row, column = np.nonzero((enter < leave) & (enter > NEAREST) & (enter < found))
    distance = enter[row, column]
    at = start[row, 0] + distance[:, None] * way[row, column]
    hole, glass = pattern(solid, at)
    facing = np.abs((normals(solid, at) * beams.way[rows][row, columns[column]]).sum(axis=1))
    kept = ~hole
    where = row[kept] + rows.start, columns[column[kept]]
    seen.distance[where] = distance[kept]
    seen.facing[where] = facing[kept] if not solid.pores else 1.0
    seen.label[where] = SEMANTIC_KITTI.id_of(solid.label)
    seen.matter[where] = np.where(glass[kept, None], PANE if solid.skin == "facade" else GLASS, solid.matter)


def strike_ground(seen: Returns, beams: Rays, floor: Ground, rough: np.ndarray) -> None:
    """Let the rays meet the ground: march between the heights it keeps to, then halve; `rough` (64, W) is N(0, 1)."""
    labels = np.array([SEMANTIC_KITTI.id_of(name) for name, _ in SURFACES])
    matter = np.array([m for _, m in SURFACES])
    for k in np.nonzero(np.sin(beams.elevation) < -0.004)[0]:
        start, way, drop = beams.start[k], beams.way[k], -np.sin(beams.elevation[k])
        near, far = (start[2] - 0.65) / drop, min((start[2] + 0.4) / drop, 1.05 * FARTHEST)
        if near > FARTHEST:
            continue
        steps = np.geomspace(near, far, 28)

        def above(distance: np.ndarray, start=start, way=way) -> np.ndarray:
            at = start + distance[..., None] * (way if distance.ndim == 1 else way[:, None])
            return at[..., 2] > floor.height(at[..., 0], at[..., 1])

        open_ = above(np.broadcast_to(steps, (len(way), len(steps))))
        first = np.where(open_.all(axis=1), len(steps) - 1, open_.argmin(axis=1))
        low, high = steps[np.maximum(first - 1, 0)], steps[first]
        for _ in range(14):
            middle = (low + high) / 2
            clear = above(middle)
            low, high = np.where(clear, middle, low), np.where(clear, high, middle)
        at = start + high[:, None] * way
        surface = floor.surface(at[:, 0], at[:, 1])
        grassy = surface == LAWN
        surface = np.where((surface == ROAD) & floor.painted(at[:, 0], at[:, 1]), PAINT, surface)
        blades = np.clip(0.015 * rough[k] / drop, -0.5, 0.5)  # grass has no surface: 1.5 cm of height
        seen.distance[k] = np.where(open_.all(axis=1), np.inf, high + np.where(grassy, blades, 0))
        seen.facing[k], seen.label[k], seen.matter[k] = drop, labels[surface], matter[surface]


def hidden() -> np.ndarray:
    """(64, W): what the car's own roof and mounts hide."""
    azimuth = np.arange(STEPS) * 360 / STEPS
    beam = np.arange(BEAMS)[:, None]
    out = np.zeros((BEAMS, STEPS), dtype=bool)
    for middle, first, wide, wider, stagger in HIDDEN:
        half = wide + (wider - wide) * (beam - first) / max(BEAMS - 1 - first, 1)
        off = (azimuth - middle - stagger * (beam % 2 - 0.5) * 2 + 180) % 360 - 180
        out |= (beam >= first) & (np.abs(off) < half)
    return out


def remission(seed: int, seen: Returns) -> np.ndarray:
    """(64, W) in 0 .. 0.99: matter and incidence, fading beyond 22 m, less what each beam's calibration takes off."""
    sensor = stream(0, "sensor", "remission")
    offset = np.abs(sensor.normal(0, 0.025, BEAMS)) + np.where(
        sensor.random(BEAMS) < 0.2, sensor.uniform(0.1, 0.26, BEAMS), 0
    )
    albedo, spread, gloss, _ = np.moveaxis(seen.matter, 2, 0)
    fade = np.clip(1.3 - 0.02 * seen.distance, 0.12, 1.0)
    ground = np.isin(seen.label, [SEMANTIC_KITTI.id_of(name) for name, _ in SURFACES])
    fade = np.where(ground, fade**2, fade * (0.7 + 0.3 * seen.facing))
    squarely = (1 - gloss) + gloss * seen.facing**2
    value = (albedo + spread * stream(seed, "remission").normal(size=albedo.shape)) * squarely * fade - offset[:, None]
    return np.clip(value, 0.0, 0.99)


def lost(seed: int, seen: Returns) -> np.ndarray:
    """(64, W): rays of which nothing comes back: chance, glass, mirror-like paint, distance, grazing incidence."""
    gloss, loss = seen.matter[..., 2], seen.matter[..., 3]
    far = np.clip((seen.distance - 45) / 120, 0, 0.5)
    grazing = np.clip((0.055 - seen.facing) / 0.05, 0, 0.9)
    chance = 0.018 + loss + 0.2 * gloss * (1 - seen.facing) ** 2 + far + grazing
    return stream(seed, "lost").random(chance.shape) < chance


def scan(seed: int = SEED) -> Scan:
    """The labelled scan of a seed's street: beams from the top, each from straight ahead to the left, as in KITTI."""
    floor, solids = street(seed)
    beams = rays(floor)
    seen = Returns.empty(BEAMS, STEPS)
    strike_ground(seen, beams, floor, stream(seed, "grass").normal(size=(BEAMS, STEPS)))
    depth = stream(seed, "depth").exponential(size=(BEAMS, STEPS))
    for solid in sorted(solids, key=lambda solid: distance_to(solid, beams)):  # near ones first: they hide the rest
        strike(seen, beams, solid, depth)
    # 2 cm in all: a beam's own constant error and that of each shot.
    bias = stream(0, "sensor", "range").normal(0, 0.018, (BEAMS, 1))
    distance = seen.distance + bias + stream(seed, "range").normal(0, 0.008, seen.distance.shape)
    kept = (distance < FARTHEST - 0.1) & ~lost(seed, seen) & ~hidden()
    azimuth = np.arange(STEPS) * beams.step
    flat = distance * np.cos(beams.elevation)[:, None]
    with np.errstate(invalid="ignore"):
        xyz = np.stack(
            [
                flat * np.cos(azimuth),
                flat * np.sin(azimuth),
                distance * np.sin(beams.elevation)[:, None] + RISE[:, None],
            ],
            2,
        )
    return Scan(
        xyz=np.round(xyz[kept], 3).astype(np.float32),
        remission=np.round(remission(seed, seen)[kept], 2).astype(np.float32),
        label=seen.label[kept],
        name="street",
    )


def main() -> None:
    """Write the scan and print what is in it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, default=SHIPPED)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--labels", action="store_true", help="write the .label beside it")
    options = parser.parse_args()
    made = scan(options.seed)
    write_bin(options.out, made)
    if options.labels:
        write_label(options.out.with_suffix(".label"), made.label)
    print(f"{options.out}: {len(made)} points, {options.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
