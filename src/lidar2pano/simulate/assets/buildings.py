"""Houses, garages, sheds, blocks of flats and halls; the front faces +x, the width is along y."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.assets.building_parts import (
    COVERS,
    DEEP,
    DOORS,
    PLASTERS,
    Boards,
    Finish,
    Opening,
    Roof,
    Shell,
    Wall,
    awning,
    balcony,
    canopy,
    chimney,
    closed_walls,
    dormer,
    fill_opening,
    flat_roof,
    flat_top,
    four_walls,
    gutters,
    has_gable,
    plinth,
    rows,
    shop_sign,
    skylight,
    slabs,
    steps,
    wall_with_openings,
    window_columns,
    window_style,
)
from lidar2pano.simulate.scene.mesh import PLAIN, Mesh, Tint, merged
from lidar2pano.simulate.scene.random_streams import pick

COVER_SHARES = (0.35, 0.2, 0.15, 0.1, 0.12, 0.08)
SANDSTONE: Tint = (1.25, 0.85, 0.72)
SHEETS: tuple[Tint, ...] = (  # of halls
    (1.1, 1.1, 1.15), (0.8, 0.85, 0.95), (0.55, 0.57, 0.6), (0.95, 0.9, 0.75), (0.5, 0.65, 0.9), (1.1, 0.8, 0.6),
)  # fmt: skip
PARAPETS = (("railing", PLAIN), ("plaster", (1.1, 1.1, 1.1)), ("pane", (3.0, 4.0, 4.0)), ("metal", (0.9, 0.9, 0.9)))
CLOTHS: tuple[Tint, ...] = (
    (1.0, 0.2, 0.15), (0.15, 0.4, 0.2), (1.5, 1.3, 0.95), (1.6, 1.6, 1.6), (0.2, 0.25, 0.5), (1.5, 0.9, 0.2),
)  # fmt: skip


def _holes(rng: np.random.Generator, shell: Shell, roof: Roof, name: str, front: bool) -> list[Opening]:
    """Windows of one wall; the front has the door, the others are emptier."""
    wall = shell.walls[name]
    columns = window_columns(rng, wall.length, rng.uniform(2.3, 3.2))
    if not front:
        columns = [middle for middle in columns if rng.uniform() < (0.85 if name == "back" else 0.55)]
    widths = (0.9, 1.0, 1.1) if shell.style.shutters == "swing" else (0.95, 1.1, 1.3, 1.6)
    width, height = float(rng.choice(widths)), rng.uniform(1.15, 1.45)
    holes: list[Opening] = []
    for floor in range(shell.storeys):
        holes += rows(wall, columns, shell.sill(floor), (width, height))
    top, bends = roof.gable(wall.length)
    if top(np.array([wall.length / 2]))[0] > shell.eaves + 2.0 and has_gable(roof, name):
        near = [middle for middle in (wall.length / 2 - 1.3, wall.length / 2 + 1.3) if 0 < middle < wall.length]
        middles = near if roof.ridge - shell.eaves > 3.2 else [wall.length / 2]
        attic = rows(wall, middles, shell.eaves + 0.45, (0.95, 1.2))
        holes += [hole for hole in attic if (top(np.array(hole.along)) > hole.high + 0.3).all()]
    if front:
        place = columns[int(rng.integers(len(columns)))]
        upper = shell.base + shell.storey
        holes = [hole for hole in holes if hole.low > upper or abs(hole.middle - place) > hole.width / 2 + 0.7]
        holes.append(Opening(float(np.clip(place, 0.8, wall.length - 0.8)), 1.05, shell.base, shell.base + 2.1, "door"))
    return holes


def house(rng: np.random.Generator, width: float, depth: float) -> Mesh:
    """A detached or terraced house of `width` (y) times `depth` (x) metres with a pitched roof."""
    turned = bool(width < 1.25 * depth and rng.uniform() < 0.35)  # its gable faces the street
    if turned:
        return _house(rng, depth, width, front="right").placed((0, 0, 0), np.pi / 2)
    return _house(rng, width, depth, front="front")


def _house(rng: np.random.Generator, width: float, depth: float, front: str) -> Mesh:
    finish = ("brick", PLAIN) if rng.uniform() < 0.06 else ("plaster", pick(rng, PLASTERS))
    shutters = str(rng.choice(("none", "swing", "roller"), p=(0.2, 0.3, 0.5)))
    shell = Shell(
        walls=four_walls(width, depth),
        finish=finish,
        style=window_style(rng, shutters, finish[1]),
        base=rng.uniform(0.2, 0.9),
        storeys=int(rng.choice((1, 2, 3), p=(0.36, 0.54, 0.1))),
        storey=rng.uniform(2.65, 2.95),
    )
    roof = _roof(rng, shell, width, depth)
    holes = {name: _holes(rng, shell, roof, name, name == front) for name in shell.walls}
    boards = Boards()
    wing = _wing(rng, boards, shell, holes, roof) if front == "front" and rng.uniform() < 0.3 else []
    timbered = finish[0] == "plaster" and shutters != "swing" and not wing and rng.uniform() < 0.1
    if not timbered and not wing and shell.storeys > 1 and rng.uniform() < 0.35:
        _porch(rng, boards, shell, holes, front)
    parts = [*closed_walls(rng, boards, shell, holes, roof), *wing]
    if finish[0] == "plaster" and rng.uniform() < 0.8:
        plinth(boards, shell, holes, (0.55, 0.54, 0.53) if rng.uniform() < 0.5 else (0.8, 0.78, 0.74))
    _entrance(rng, boards, shell.walls[front], holes[front][-1])
    if timbered:
        _timber(boards, shell, roof, holes)
    parts += [roof.mesh(), gutters(roof), *_on_roof(rng, roof, shell.finish, plain=bool(wing))]
    return merged([*parts, boards.mesh()], "building")


def _roof(rng: np.random.Generator, shell: Shell, width: float, depth: float) -> Roof:
    form = str(rng.choice(("gable", "hip", "half-hip"), p=(0.7, 0.16, 0.14))) if width > depth + 1.0 else "gable"
    steep = rng.uniform(0.45, 0.7) if form == "hip" or shell.storeys == 3 else rng.uniform(0.6, 1.1)
    finish = pick(rng, COVERS, p=COVER_SHARES)
    overhang = (rng.uniform(0.35, 0.7), rng.uniform(0.12, 0.5))
    return Roof(form, width, depth, shell.eaves, min(steep, 9.0 / depth), overhang, finish)


def _entrance(rng: np.random.Generator, boards: Boards, wall: Wall, door: Opening) -> None:
    steps(boards, wall, door)
    if rng.uniform() < 0.55:
        canopy(boards, wall, door, (1.0, 1.0, 1.0) if rng.uniform() < 0.5 else (2.2, 3.2, 5.0))
    if rng.uniform() < 0.5:
        side = door.along[1] + 0.35
        boards.add(wall, (side, side + 0.14), (0.0, 0.14), (door.low + 1.7, door.low + 1.95), "lamp")


def _clear(place: float, holes: list[Opening]) -> bool:
    """Return True for a place along a wall beside all openings, by 0.1 metres at least."""
    return all(abs(place - hole.middle) > hole.width / 2 + 0.1 for hole in holes)


def _timber(boards: Boards, shell: Shell, roof: Roof, holes: dict[str, list[Opening]]) -> None:
    """Half timber on the upper storey (or the gables): posts beside the windows, rails above and below them."""
    out, dark = (0.0, 0.025), (0.42, 0.38, 0.35)
    low = shell.eaves - shell.storey
    for name, wall in shell.walls.items():
        level = [hole for hole in holes[name] if hole.low >= low and hole.high < shell.eaves]
        sill, lintel = low + 0.78, low + shell.storey - 0.32
        rails = [(low - 0.1, low + 0.08), *((middle - 0.07, middle + 0.07) for middle in (sill, lintel))]
        for up in (*rails, (shell.eaves - 0.18, shell.eaves)):
            gaps = (edge for hole in level if up[0] < hole.high and up[1] > hole.low for edge in hole.along)
            edges = sorted([0.0, wall.length, *gaps])
            for span in zip(edges[::2], edges[1::2], strict=True):
                boards.add(wall, span, out, up, "wood", dark)
        posts = np.linspace(0.09, wall.length - 0.09, max(round(wall.length / 1.3), 2) + 1)
        clear = [post for post in posts if _clear(post, level)]
        flanks = [edge + side for hole in level for edge, side in zip(hole.along, (-0.09, 0.09), strict=True)]
        for post in [*clear, *flanks]:
            boards.add(wall, (post - 0.08, post + 0.08), out, (low, shell.eaves), "wood", dark, "flr")
        if has_gable(roof, name):
            top = roof.gable(wall.length)[0]
            for post in [post for post in clear if top(np.array([post]))[0] > shell.eaves + 0.4]:
                high = float(top(np.array([post]))[0])
                if _clear(post, [hole for hole in holes[name] if hole.high > shell.eaves]):
                    boards.add(wall, (post - 0.08, post + 0.08), out, (shell.eaves, high - 0.1), "wood", dark, "flr")


def _porch(rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]], front: str) -> None:
    """A balcony on the first floor, in front of a window, then a glass door; changes `holes`."""
    wall, floor = shell.walls[front], shell.base + shell.storey
    level = [i for i, hole in enumerate(holes[front]) if floor < hole.low < floor + 1.5]
    if not level:
        return
    number = pick(rng, level)
    hole = holes[front][number]
    holes[front][number] = hole._replace(low=floor + 0.03, kind="glass-door")
    wide = min(rng.uniform(2.5, 4.5), wall.length - 1.0)
    left = float(np.clip(hole.middle - wide * rng.uniform(0.3, 0.7), 0.2, wall.length - wide - 0.2))
    finish = pick(rng, (("railing", PLAIN), ("wood", PLAIN), ("plaster", shell.finish[1])))
    balcony(boards, wall, (left, left + wide), floor, 1.3, finish)


def _wing(
    rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]], roof: Roof
) -> list[Mesh]:
    """A protruding part of the front under a gable of its own, away from the door; changes `holes`."""
    wall, door = shell.walls["front"], holes["front"][-1]
    wide, out = rng.uniform(2.6, 3.6), rng.uniform(0.7, 1.4)
    middle = wall.length * (0.25 if door.middle > wall.length / 2 else 0.75)
    eaves = shell.eaves + rng.uniform(0.3, 1.2)
    slope = min(1.0, 2 * (roof.ridge - 0.3 - eaves) / wide)
    if abs(middle - door.middle) < wide / 2 + 1.0 or slope < 0.4 or roof.form == "hip":
        return []
    holes["front"] = [hole for hole in holes["front"] if abs(hole.middle - middle) > (wide + hole.width) / 2 + 0.3]
    front, y = roof.span / 2 + out, middle - wall.length / 2
    back = roof.span / 2 - (eaves + slope * wide / 2 - roof.eaves) / roof.slope - 0.3
    walls = four_walls(wide, front - back, ((front + back) / 2, y))
    gable = Roof("gable", front - back, wide, eaves, slope, (0.3, 0.3), roof.finish)
    parts = []
    for name in ("front", "left", "right"):
        top, bends = gable.gable(wide) if name == "front" else (flat_top(eaves + 0.04), [])
        sills = [shell.sill(floor) for floor in range(shell.storeys + int(eaves > shell.eaves + 0.8))]
        own = [hole for sill in sills for hole in rows(walls[name], [wide / 2], sill, (1.3, 1.3)) if name == "front"]
        own = [hole for hole in own if (top(np.array(hole.along)) > hole.high + 0.1).all()]
        parts.append(wall_with_openings(walls[name], DEEP, top, bends, own, shell.finish))
        for hole in own:
            fill_opening(boards, walls[name], hole, shell.style, rng)
    x, ridge, low = front + 0.3, eaves + slope * wide / 2, eaves - 0.3 * slope
    half = wide / 2 + 0.3
    points = [(end, *line) for end in (x, back) for line in ((-half, low), (0, ridge), (half, low))]
    return [*parts, slabs(np.array(points) + (0, y, 0), [[2, 5, 4, 1], [3, 0, 1, 4]], roof.finish)]


def _on_roof(rng: np.random.Generator, roof: Roof, finish: Finish, *, plain: bool) -> list[Mesh]:
    """A chimney, and dormers or roof windows where the roof is not `plain`."""
    ridge = roof.ridge + 0.2
    place = (-0.1 * roof.span, rng.uniform(-0.3, 0.3) * roof.long)
    parts = [chimney(rng, place, ridge - 2.0, ridge + rng.uniform(0.4, 0.9))]
    tall = roof.ridge - roof.eaves
    reach = roof.long / 2 - 1.2 if roof.form != "hip" else (roof.long - roof.span) / 2
    if plain or roof.slope < 0.6 or reach < 1.0 or tall < 2.6:
        return parts
    rise = min(0.5 * roof.slope + 0.2, tall - 2.0)
    if rng.uniform() < 0.45:
        wide = float(rng.choice((1.2, 1.5, 2.6, 3.4)))
        count = 1 if wide > 2 or reach < 2.2 else 2
        cheeks = finish if rng.uniform() < 0.5 else ("slate", PLAIN)
        if wide / 2 < reach:
            places = [0.0] if count == 1 else [-0.55 * reach, 0.55 * reach]
            parts += [dormer(roof, place, rise, (wide, 1.25), cheeks) for place in places]
    elif rng.uniform() < 0.6:
        places = rng.permutation(np.linspace(-reach, reach, 4))[:2]
        parts += [skylight(roof, float(place), 0.8 * roof.slope) for place in places]
    ahead = rng.uniform() < 0.8
    return [parts[0], *(part if ahead else part.placed((0, 0, 0), np.pi) for part in parts[1:])]


def garage(rng: np.random.Generator) -> Mesh:
    """A single garage, 3 m wide and 6 m deep, its gate to +x."""
    width, depth = rng.uniform(2.9, 3.2), rng.uniform(5.6, 6.2)
    finish = ("plaster", pick(rng, PLASTERS)) if rng.uniform() < 0.8 else ("concrete", (1.2, 1.2, 1.2))
    style = window_style(rng, "none", finish[1])._replace(surround="", door=pick(rng, DOORS))
    shell = Shell(four_walls(width, depth), finish, style, 0.03, 1, 2.45)
    holes: dict[str, list[Opening]] = {name: [] for name in shell.walls}
    holes["front"] = [Opening(width / 2, width - 0.5, 0.03, 2.1, "gate")]
    boards = Boards()
    if rng.uniform() < 0.75:
        parts = closed_walls(rng, boards, shell, holes, None)
        parts.append(flat_roof(width, depth, shell.eaves - 0.2, (0.6, 0.6, 0.6)))
    else:
        roof = Roof("gable", depth, width, shell.eaves, rng.uniform(0.4, 0.7), (0.25, 0.2), pick(rng, COVERS[:4]))
        shell = shell._replace(walls=four_walls(depth, width))
        holes = {name: holes["front"] if name == "right" else [] for name in shell.walls}
        parts = [*closed_walls(rng, boards, shell, holes, roof), roof.mesh(), boards.mesh()]
        return merged(parts, "building").placed((0, 0, 0), np.pi / 2)
    return merged([*parts, boards.mesh()], "building")


def shed(rng: np.random.Generator) -> Mesh:
    """A wooden garden shed with a door and a window to +x."""
    width, depth, height = rng.uniform(2.2, 3.8), rng.uniform(2.0, 3.0), rng.uniform(2.0, 2.3)
    tint = pick(rng, ((1.2, 1.2, 1.2), (0.6, 0.65, 0.7), (0.9, 0.4, 0.35), (0.6, 0.9, 0.7)))
    style = window_style(rng, "none", tint)._replace(surround="", deep=0.04, door=tint)
    shell = Shell(four_walls(width, depth), ("wood", tint), style, 0.08, 1, height)
    roof = Roof("gable", width, depth, shell.eaves, rng.uniform(0.35, 0.8), (0.25, 0.2), ("slate", (1.6, 1.5, 1.4)))
    holes: dict[str, list[Opening]] = {name: [] for name in shell.walls}
    holes["front"] = [Opening(0.7, 0.8, 0.08, 1.95, "door"), Opening(width - 0.7, 0.6, 1.1, 1.7)]
    boards = Boards()
    parts = [*closed_walls(rng, boards, shell, holes, roof), roof.mesh()]
    return merged([*parts, boards.mesh()], "building")


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
    return merged([*parts, boards.mesh()], "building")


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
    front = [
        hole
        for hole in holes["front"]
        if hole.low > first
        or (not shops and all(abs(hole.middle - door.middle) > hole.width / 2 + 0.8 for door in doors))
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
    places = sorted({hole.middle for hole in holes[name] if hole.kind == "window"})[1::3]
    finish = pick(rng, PARAPETS)
    wide, out = rng.uniform(2.6, 3.4), rng.uniform(1.2, 1.8)
    for i, hole in enumerate(holes[name]):
        if hole.middle in places and hole.low > shell.base + shell.storey and hole.kind == "window":
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
            up = (shell.eaves, shell.eaves + 2.4)
            house.add(wall, (0, wall.length), (-0.1, 0.0), up, "plaster", shell.finish[1], "ft")
        return [flat_roof(width, depth, shell.eaves, shell.finish[1]), house.mesh()]
    slope = rng.uniform(0.7, 0.95) if era == "old" else rng.uniform(0.4, 0.65)
    form = "hip" if width > depth + 4 and rng.uniform() < 0.6 else "gable"
    finish = pick(rng, COVERS, p=COVER_SHARES)
    roof = Roof(form, width, depth, shell.eaves, slope, (rng.uniform(0.3, 0.5), 0.15), finish)
    parts = [roof.mesh(), gutters(roof)]
    if form == "gable":
        parts += [_gable(shell, roof, name) for name in ("left", "right")]
    for place in rng.uniform(-0.35, 0.35, int(rng.integers(1, 4))):
        parts.append(chimney(rng, (-0.06 * depth, place * width), roof.ridge - 1.5, roof.ridge + 0.9))
    reach = width / 2 - 2.0 - (depth / 2 if form == "hip" else 0.0)
    if era == "old" and reach > 0.5 and rng.uniform() < 0.8:
        places = np.linspace(-reach, reach, max(int(reach / 1.8), 1)) if reach > 1.8 else np.array([0.0])
        parts += [dormer(roof, float(place), 0.9 * slope, (1.4, 1.45), ("slate", PLAIN)) for place in places]
    return parts


def _gable(shell: Shell, roof: Roof, name: str) -> Mesh:
    wall = shell.walls[name]
    top, bends = roof.gable(wall.length)
    return wall_with_openings(wall, shell.eaves, top, bends, [], shell.finish)


def hall(rng: np.random.Generator, width: float, depth: float) -> Mesh:
    """A supermarket or an industrial hall, 4.5 to 9 m high."""
    market = bool(rng.uniform() < 0.45)
    height = rng.uniform(4.5, 5.5) if market else rng.uniform(5.0, 9.0)
    tint = pick(rng, SHEETS)
    finish = (pick(rng, ("plaster", "metal", "concrete", "brick"), p=(0.35, 0.4, 0.15, 0.1)), tint)
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
            if _clear(place, holes[name]):
                seam = (place - 0.04, place + 0.04)
                boards.add(wall, seam, (0.0, 0.03), (0.0, height), "dark-metal", (4.0, 4.0, 4.0), "flr")
    if market or rng.uniform() < 0.6:
        parts.append(flat_roof(width, depth, height - 0.3, tint))
        return merged([*parts, boards.mesh()], "building")
    roof = Roof("gable", width, depth, shell.eaves, rng.uniform(0.1, 0.25), (0.3, 0.2), ("slate", (2.5, 2.5, 2.6)))
    gables = [_gable(shell, roof, name) for name in ("left", "right")]
    return merged([*parts, roof.mesh(), *gables, boards.mesh()], "building")


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
