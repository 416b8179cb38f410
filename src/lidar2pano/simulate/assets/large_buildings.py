"""Blocks of flats with or without shops, and halls; the front faces +x, the width is along y."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.assets.building_shells import (
    COVERS,
    PLASTERS,
    Roof,
    Shell,
    chimney,
    closed_walls,
    dormer,
    flat_roof,
    gutters,
    pick,
    plinth,
    window_columns,
    window_style,
)
from lidar2pano.simulate.assets.facades import (
    PLAIN,
    Boards,
    Opening,
    awning,
    balcony,
    canopy,
    four_walls,
    rows,
    shop_sign,
    steps,
    wall_with_openings,
)
from lidar2pano.simulate.scene.mesh import Mesh, Tint, merged

SANDSTONE: Tint = (1.25, 0.85, 0.72)
CLOTHS: tuple[Tint, ...] = (
    (1.0, 0.2, 0.15),
    (0.15, 0.4, 0.2),
    (1.5, 1.3, 0.95),
    (1.6, 1.6, 1.6),
    (0.2, 0.25, 0.5),
    (1.5, 0.9, 0.2),
)


def flats(rng: np.random.Generator, width: float, depth: float) -> Mesh:
    """A block of flats, 3 to 6 storeys: of 1900 with stone borders, plain of 1960, or new with a flat roof."""
    era = str(rng.choice(("old", "plain", "new"), p=(0.38, 0.4, 0.22)))
    shops = bool(rng.uniform() < (0.4 if era == "old" else 0.25))
    finish = ("brick", PLAIN) if rng.uniform() < 0.1 else ("plaster", pick(rng, PLASTERS))
    style = window_style(rng, "roller" if era == "plain" else "none", finish[1])
    if era == "old":
        warm = SANDSTONE if rng.uniform() < 0.6 else (1.2, 1.15, 1.05)
        style = style._replace(surround="stone", surround_tint=warm, sill=warm, cross=True, sashes=2, deep=0.16)
    else:
        style = style._replace(surround="")
    storeys = int(rng.integers(3, 6 if era == "old" else 7))
    storey = rng.uniform(3.2, 3.7) if era == "old" else rng.uniform(2.75, 2.95)
    base = 0.15 if shops else rng.uniform(0.3, 1.0)
    shell = Shell(four_walls(width, depth), finish, style, base, storeys, storey, dressed=("front",))
    holes = {name: _windows(rng, shell, name, era) for name in shell.walls}
    boards = Boards()
    parts = _ground_floor(rng, boards, shell, holes, shops)
    if era != "old" and rng.uniform() < 0.75:
        _balconies(rng, boards, shell, holes)
    if era == "old":
        _belts(boards, shell, style.surround_tint)
    parts += closed_walls(rng, boards, shell, holes, None)
    parts += _cover(rng, shell, era, width, depth)
    return merged([*parts, boards.mesh()])


def _windows(rng: np.random.Generator, shell: Shell, name: str, era: str) -> list[Opening]:
    wall = shell.walls[name]
    if name in ("left", "right") and rng.uniform() < 0.35:
        return []  # a fire wall
    every, size = {
        "old": (rng.uniform(1.9, 2.4), (1.05, 1.9)),
        "plain": (rng.uniform(2.3, 3.0), (rng.choice((1.1, 1.4, 1.7)), 1.35)),
        "new": (rng.uniform(2.4, 3.4), (rng.choice((1.0, 1.8, 2.1)), 1.5)),
    }[era]
    middles = window_columns(rng, wall.length, every)
    if name in ("left", "right"):
        middles = [middle for middle in middles if rng.uniform() < 0.6]
    return [hole for floor in range(shell.storeys) for hole in rows(wall, middles, shell.sill(floor) - 0.05, size)]


def _ground_floor(
    rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]], shops: bool
) -> list[Mesh]:
    """Doors in the front, and shops where there are some; changes `holes`."""
    wall, base, first = shell.walls["front"], shell.base, shell.base + shell.storey
    parts: list[Mesh] = []
    count = max(round(wall.length / 14), 1)
    doors = [Opening(wall.length * (i + 0.5) / count, 1.25, base, base + 2.25, "door") for i in range(count)]
    front = [hole for hole in holes["front"] if hole.low > first or not shops]
    front = [
        hole
        for hole in front
        if hole.low > first or all(abs(hole.middle - door.middle) > hole.width / 2 + 0.8 for door in doors)
    ]
    for door in doors:
        steps(boards, wall, door)
        if not shops and rng.uniform() < 0.7:
            canopy(boards, wall, door, PLAIN)
    if shops:
        edges = sorted([0.3, wall.length - 0.3, *(door.middle + side for door in doors for side in (-1.0, 1.0))])
        for left, right in zip(edges[::2], edges[1::2], strict=True):
            if right - left > 2.0:
                front.append(Opening((left + right) / 2, right - left, base + 0.35, base + 2.6, "shop"))
                shop_sign(rng, boards, wall, (left, right), base + 2.68)
                if rng.uniform() < 0.4:
                    parts.append(awning(wall, (left, right), base + 2.66, 1.4, pick(rng, CLOTHS)))
    holes["front"] = [*front, *doors]
    plinth(boards, shell, holes, (0.6, 0.58, 0.56))
    return parts


def _balconies(rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]]) -> None:
    """Columns of balconies with glass doors, on the front or the back; changes `holes`."""
    name = "front" if rng.uniform() < 0.7 else "back"
    wall = shell.walls[name]
    places = sorted({hole.middle for hole in holes[name] if hole.what == "window"})[1::3]
    finish = [("railing", PLAIN), ("plaster", (1.1, 1.1, 1.1)), ("pane", (3.0, 4.0, 4.0)), ("metal", (0.9, 0.9, 0.9))][
        int(rng.integers(4))
    ]
    wide, out = rng.uniform(2.6, 3.4), rng.uniform(1.2, 1.8)
    for i, hole in enumerate(holes[name]):
        if hole.middle in places and hole.low > shell.base + shell.storey and hole.what == "window":
            floor = hole.low - 0.85
            holes[name][i] = Opening(hole.middle, max(hole.width, 1.5), floor + 0.03, hole.high, "glass-door")
            left = float(np.clip(hole.middle - wide / 2, 0.05, wall.length - wide - 0.05))
            balcony(boards, wall, (left, left + wide), floor, out, finish)


def _belts(boards: Boards, shell: Shell, tint: Tint) -> None:
    """Stone belts between the floors and a cornice."""
    for name in shell.dressed:
        wall = shell.walls[name]
        whole = (-0.04, wall.length + 0.04)
        for floor in range(1, shell.storeys):
            high = shell.base + floor * shell.storey + 0.32
            boards.add(wall, whole, (0.0, 0.08), (high, high + 0.18), "stone", tint)
        boards.add(wall, whole, (0.0, 0.22), (shell.eaves - 0.45, shell.eaves - 0.1), "stone", tint)
        for edge in (0.0, wall.length - 0.5):
            boards.add(wall, (edge, edge + 0.5), (0.0, 0.05), (0.0, shell.eaves - 0.4), "stone", tint, "flr")


def _cover(rng: np.random.Generator, shell: Shell, era: str, width: float, depth: float) -> list[Mesh]:
    if era == "new" or (era == "plain" and rng.uniform() < 0.2):
        house = Boards()  # of the lift
        for wall in four_walls(3.0, 3.5, (0.0, width * rng.uniform(-0.2, 0.2))).values():
            house.add(
                wall, (0, wall.length), (-0.1, 0.0), (shell.eaves, shell.eaves + 2.4), "plaster", shell.finish[1], "ft"
            )
        return [flat_roof(width, depth, shell.eaves, shell.finish[1]), house.mesh()]
    slope = rng.uniform(0.7, 0.95) if era == "old" else rng.uniform(0.4, 0.65)
    form = "hip" if width > depth + 4 and rng.uniform() < 0.6 else "gable"
    material, tint = COVERS[int(rng.choice(len(COVERS), p=(0.35, 0.2, 0.15, 0.1, 0.12, 0.08)))]
    roof = Roof(form, width, depth, shell.eaves, slope, (rng.uniform(0.3, 0.5), 0.15), material, tint)
    parts = [roof.mesh(), gutters(roof)]
    if form == "gable":
        parts += [_gable(shell, roof, name) for name in ("left", "right")]
    for place in rng.uniform(-0.35, 0.35, int(rng.integers(1, 4))):
        parts.append(chimney(rng, (-0.06 * depth, place * width), roof.ridge - 1.5, roof.ridge + 0.9))
    reach = width / 2 - 2.0 - (depth / 2 if form == "hip" else 0.0)
    if era == "old" and reach > 0.5 and rng.uniform() < 0.8:
        places = np.linspace(-reach, reach, max(int(reach / 1.8), 1)) if reach > 1.8 else np.array([0.0])
        rise = 0.9 * slope
        parts += [dormer(roof, float(place), rise, (1.4, 1.45), ("slate", PLAIN)) for place in places]
    return parts


def _gable(shell: Shell, roof: Roof, name: str) -> Mesh:
    wall = shell.walls[name]
    top, bends = roof.gable(wall.length)
    return wall_with_openings(wall, shell.eaves, top, bends, [], *shell.finish)


def hall(rng: np.random.Generator, width: float, depth: float) -> Mesh:
    """A supermarket or an industrial hall, 4.5 to 9 m high."""
    market = bool(rng.uniform() < 0.45)
    height = rng.uniform(4.5, 5.5) if market else rng.uniform(5.0, 9.0)
    tint = [
        (1.1, 1.1, 1.15),
        (0.8, 0.85, 0.95),
        (0.55, 0.57, 0.6),
        (0.95, 0.9, 0.75),
        (0.5, 0.65, 0.9),
        (1.1, 0.8, 0.6),
    ][int(rng.integers(6))]
    finish = (("plaster", "metal", "concrete", "brick")[int(rng.choice(4, p=(0.35, 0.4, 0.15, 0.1)))], tint)
    style = window_style(rng, "none", tint)._replace(surround="", deep=0.1, cross=False)
    shell = Shell(four_walls(width, depth), finish, style, 0.05, 1, height)
    holes = {name: _hall_holes(rng, shell, name, market) for name in shell.walls}
    boards = Boards()
    parts = closed_walls(rng, boards, shell, holes, None)
    plinth(boards, shell, holes, (0.6, 0.6, 0.6))
    if market:
        canopy(boards, shell.walls["front"], holes["front"][0], (2.5, 3.5, 5.5))
    front = shell.walls["front"]
    wide = min(rng.uniform(4.0, 9.0), width - 1.0)
    left = rng.uniform(0.5, width - wide - 0.4)
    shop_sign(rng, boards, front, (left, left + wide), height - 0.9)
    for name in ("front", "left", "right"):  # seams of the sheets
        wall = shell.walls[name]
        for place in np.arange(2.5, wall.length - 1, 5.0) if finish[0] in ("metal", "concrete") else ():
            if all(abs(place - hole.middle) > hole.width / 2 + 0.1 for hole in holes[name]):
                boards.add(
                    wall, (place - 0.04, place + 0.04), (0.0, 0.03), (0.0, height), "dark-metal", (4.0, 4.0, 4.0), "flr"
                )
    if market or rng.uniform() < 0.6:
        parts.append(flat_roof(width, depth, height - 0.3, tint))
        return merged([*parts, boards.mesh()])
    roof = Roof("gable", width, depth, shell.eaves, rng.uniform(0.1, 0.25), (0.3, 0.2), "slate", (2.5, 2.5, 2.6))
    gables = [_gable(shell, roof, name) for name in ("left", "right")]
    return merged([*parts, roof.mesh(), *gables, boards.mesh()])


def _hall_holes(rng: np.random.Generator, shell: Shell, name: str, market: bool) -> list[Opening]:
    wall = shell.walls[name]
    if name == "back":
        return []
    if name != "front":
        count = int(wall.length / 7) if rng.uniform() < 0.5 else 0
        return [Opening(7 * i + 3.5, 4.0, shell.eaves - 2.0, shell.eaves - 1.0, "shop") for i in range(count)]
    if market:
        wide = min(9.0, 0.5 * wall.length)
        return [Opening(wall.length * rng.uniform(0.4, 0.6), wide, 0.05, 3.0, "shop")]
    holes = [Opening(1.4, 1.1, 0.05, 2.15, "door")]
    for middle in np.arange(5.0, wall.length - 3.0, 7.0):
        if rng.uniform() < 0.55:
            holes.append(Opening(float(middle), 3.6, 0.05, min(4.2, shell.eaves - 1.2), "gate"))
        else:
            holes.append(Opening(float(middle), 4.0, 1.2, 2.6, "shop"))
    return holes
