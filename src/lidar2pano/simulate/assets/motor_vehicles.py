"""Motor vehicles on four wheels and more: cars, as in Germany, lorries, trailers, buses and trams."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from lidar2pano.simulate.assets.vehicle_body import Body, Patch, VehicleShape, body, both_sides, plate, wheel
from lidar2pano.simulate.scene.mesh import Mesh, Tint, box, ellipsoid, merged, tube
from lidar2pano.simulate.scene.random_streams import pick

# Share of cars, linear RGB albedo: Germany's registrations around 2012 (KBA), rounded.
COLOURS: tuple[tuple[float, Tint], ...] = (
    (0.26, (0.012, 0.012, 0.013)),  # black
    (0.10, (0.045, 0.048, 0.052)),  # anthracite
    (0.08, (0.13, 0.135, 0.14)),  # grey
    (0.18, (0.40, 0.41, 0.42)),  # silver
    (0.13, (0.72, 0.72, 0.71)),  # white
    (0.06, (0.015, 0.03, 0.10)),  # dark blue
    (0.045, (0.03, 0.10, 0.30)),  # blue
    (0.05, (0.38, 0.012, 0.015)),  # red
    (0.025, (0.16, 0.01, 0.015)),  # dark red
    (0.02, (0.01, 0.05, 0.03)),  # dark green
    (0.015, (0.28, 0.22, 0.14)),  # beige, gold
    (0.015, (0.70, 0.45, 0.02)),  # yellow
    (0.01, (0.60, 0.13, 0.01)),  # orange
    (0.01, (0.10, 0.05, 0.03)),  # brown
)

LAMP = Patch("headlamp", (0, 4), (2, 4), 0.2)
GRILLE = Patch("underbody", (2, 4), (0, 2))
INTAKE = Patch("underbody", (5, 6), (0, 3))
FRONT = (GRILLE, LAMP, INTAKE)
REAR = (Patch("tail-lamp", (0, 4), (2, 4), 0.16),)

SHAPES: dict[str, VehicleShape] = {
    "hatchback": VehicleShape(
        length=4.22, width=1.78, belt=(0.93, 1.03), sill=0.2, axles=(0.86, 3.46), wheel=0.315,
        profile=((0, 0.74), (1.12, 1.0), (1.88, 1.41), (2.45, 1.48), (3.72, 1.39), (4.1, 1.0), (4.22, 0.93)),
        nose_rows=(0.69, 0.55, 0.43, 0.29), tail_rows=(0.88, 0.72, 0.56, 0.34),
        panes=((0.9, 2.2), (2.27, 3.06), (3.12, 3.5)), seams=(1.3, 2.24, 3.08), lean=0.14, front=FRONT, rear=REAR,
    ),
    "saloon": VehicleShape(
        length=4.72, width=1.81, belt=(0.92, 1.02), sill=0.19, axles=(0.9, 3.66), wheel=0.32,
        profile=((0, 0.72), (1.26, 0.98), (2.08, 1.39), (2.65, 1.45), (3.5, 1.36), (4.12, 1.06), (4.7, 1.0)),
        nose_rows=(0.67, 0.53, 0.42, 0.28), tail_rows=(0.93, 0.76, 0.58, 0.35),
        panes=((1.0, 2.4), (2.47, 3.32), (3.38, 3.72)), seams=(1.42, 2.44, 3.36), lean=0.12, front=FRONT, rear=REAR,
    ),
    "estate": VehicleShape(
        length=4.74, width=1.8, belt=(0.92, 1.02), sill=0.19, axles=(0.9, 3.62), wheel=0.32,
        profile=((0, 0.72), (1.22, 0.98), (2.02, 1.4), (2.6, 1.47), (4.3, 1.4), (4.64, 1.0), (4.74, 0.92)),
        nose_rows=(0.67, 0.53, 0.42, 0.28), tail_rows=(0.88, 0.68, 0.54, 0.34),
        panes=((1.0, 2.36), (2.43, 3.26), (3.33, 4.2)), seams=(1.4, 2.4, 3.3), lean=0.1, front=FRONT, rear=REAR,
    ),
    "suv": VehicleShape(
        length=4.48, width=1.84, belt=(1.1, 1.18), sill=0.27, axles=(0.88, 3.52), wheel=0.355, cladding="dark-metal",
        profile=((0, 0.9), (1.12, 1.14), (1.85, 1.6), (2.45, 1.69), (3.95, 1.6), (4.34, 1.16), (4.48, 1.06)),
        nose_rows=(0.84, 0.68, 0.54, 0.38), tail_rows=(1.02, 0.84, 0.64, 0.42), crown=(0.05, 0.045),
        panes=((0.9, 2.28), (2.35, 3.2), (3.27, 3.8)), seams=(1.32, 2.31, 3.24), lean=0.1, front=FRONT, rear=REAR,
    ),
    "minivan": VehicleShape(
        length=4.42, width=1.8, belt=(1.0, 1.08), sill=0.2, axles=(0.88, 3.57), wheel=0.32,
        profile=((0, 0.8), (0.98, 1.08), (1.86, 1.57), (2.5, 1.65), (4.05, 1.55), (4.32, 1.04), (4.42, 0.96)),
        nose_rows=(0.75, 0.58, 0.46, 0.3), tail_rows=(0.92, 0.72, 0.56, 0.34), round=0.18,
        panes=((0.85, 2.3), (2.37, 3.22), (3.29, 3.95)), seams=(1.3, 2.33, 3.25), lean=0.08, front=FRONT, rear=REAR,
    ),
    "small": VehicleShape(
        length=3.6, width=1.64, belt=(0.95, 1.06), sill=0.2, axles=(0.68, 3.08), wheel=0.29,
        profile=((0, 0.76), (0.84, 1.02), (1.52, 1.42), (2.05, 1.49), (3.2, 1.41), (3.5, 1.02), (3.6, 0.94)),
        nose_rows=(0.71, 0.56, 0.44, 0.29), tail_rows=(0.9, 0.7, 0.54, 0.34),
        panes=((0.7, 2.06), (2.13, 3.02)), seams=(1.07, 2.09), lean=0.12, sweep=(0.24, 0.18), front=FRONT, rear=REAR,
    ),
    "coupe": VehicleShape(
        length=4.42, width=1.8, belt=(0.88, 0.97), sill=0.18, axles=(0.9, 3.52), wheel=0.325,
        profile=((0, 0.68), (1.36, 0.93), (2.16, 1.31), (2.6, 1.36), (3.0, 1.33), (3.94, 1.0), (4.4, 0.95)),
        nose_rows=(0.63, 0.51, 0.4, 0.26), tail_rows=(0.88, 0.73, 0.56, 0.34),
        panes=((1.0, 2.62), (2.68, 3.3)), seams=(1.44, 2.72), lean=0.2, front=FRONT, rear=REAR,
    ),
    "cabriolet": VehicleShape(
        length=4.3, width=1.78, belt=(0.89, 0.96), sill=0.19, axles=(0.86, 3.42), wheel=0.32, top="cloth",
        profile=((0, 0.7), (1.24, 0.94), (1.95, 1.33), (2.45, 1.39), (3.0, 1.34), (3.62, 1.02), (4.28, 0.96)),
        nose_rows=(0.65, 0.52, 0.41, 0.27), tail_rows=(0.88, 0.73, 0.56, 0.34),
        panes=((1.0, 2.5),), seams=(1.38, 2.58), lean=0.1, front=FRONT, rear=REAR,
    ),
    "van": VehicleShape(
        length=4.9, width=1.9, belt=(1.16, 1.2), sill=0.22, axles=(0.93, 3.93), wheel=0.335, rail=0.83, frame=0.17,
        profile=((0, 0.98), (0.62, 1.24), (1.45, 1.86), (2.4, 1.96), (4.66, 1.92), (4.84, 1.2), (4.9, 1.06)),
        nose_rows=(0.92, 0.72, 0.56, 0.36), tail_rows=(1.12, 0.78, 0.58, 0.36), round=0.2, sweep=(0.2, 0.08),
        panes=((0.75, 2.05), (2.13, 3.35), (3.42, 4.55)), seams=(1.05, 2.09, 3.38), front=FRONT, rear=REAR,
    ),
}  # fmt: skip
BODIES: tuple[str, ...] = tuple(SHAPES)
SHARES: tuple[float, ...] = (0.30, 0.14, 0.17, 0.08, 0.10, 0.10, 0.03, 0.01, 0.07)  # of BODIES, by the roadside
WHITE: Tint = (1.42, 1.42, 1.4)
TARPAULINS: tuple[Tint, ...] = (
    (0.05, 0.12, 0.4), (0.6, 0.03, 0.03), (1.1, 1.1, 1.08), (0.05, 0.2, 0.1), (0.9, 0.55, 0.03), (0.3, 0.31, 0.33),
)  # fmt: skip


def colour(rng: np.random.Generator) -> Tint:
    """Tint of a car's paint over the material's grey of 0.5."""
    albedo = pick(rng, [albedo for _, albedo in COLOURS], p=[share for share, _ in COLOURS])
    r, g, b = np.asarray(albedo) * rng.uniform(0.8, 1.25) * rng.uniform(0.94, 1.06, 3) / 0.5
    return float(min(r, 1.6)), float(min(g, 1.6)), float(min(b, 1.6))


def car(rng: np.random.Generator, body: str | None = None) -> Mesh:
    """A car on its wheels, facing +x; `body` in BODIES, by default random by SHARES."""
    name = pick(rng, BODIES, p=SHARES) if body is None else body
    tint = colour(rng)
    shape = varied(rng, _equipped(rng, name, SHAPES[name]))
    return _assembled(rng, shape, tint)


def _equipped(rng: np.random.Generator, name: str, shape: VehicleShape) -> VehicleShape:
    """Variants of a model: a delivery van without windows, unpainted bumpers, dark or wide lamps."""
    if name == "van" and rng.uniform() < 0.45:
        shape = replace(shape, panes=shape.panes[:1], rear_screen=bool(rng.uniform() < 0.5))
    if rng.uniform() < 0.12:  # unpainted bumpers
        dark = Patch("dark-metal", (4, 7), (0, 4), 0.5 * (shape.axles[0] - shape.wheel))
        shape = replace(shape, front=(dark, *shape.front), rear=(dark, *shape.rear), cladding="dark-metal")
    if rng.uniform() < 0.4:  # a skirt of dark plastic under the tail
        shape = replace(shape, rear=(*shape.rear, Patch("dark-metal", (6, 7), (0, 3))))
    if rng.uniform() < 0.15:  # a radiator behind the bumper only
        shape = replace(shape, front=tuple(patch for patch in shape.front if patch is not GRILLE))
    return shape


def varied(rng: np.random.Generator, shape: VehicleShape) -> VehicleShape:
    """Another model of the same body: a few per cent longer, wider, higher; other heights of the lines."""
    along, wide, high = 1 + 0.03 * rng.uniform(-1, 1, 3)
    nudge = rng.uniform(-1, 1, (len(shape.profile), 2)) * (0.035, 0.012)
    nudge[[0, -1]] = 0
    return replace(
        shape,
        length=shape.length * along,
        width=shape.width * wide,
        profile=tuple((x * along + dx, z * high + dz) for (x, z), (dx, dz) in zip(shape.profile, nudge, strict=True)),
        belt=(shape.belt[0] * high, shape.belt[1] * high + rng.uniform(-0.02, 0.03)),
        axles=tuple(axle * along for axle in shape.axles),
        wheel=shape.wheel * rng.uniform(0.97, 1.04),
        panes=tuple((low * along, high_ * along) for low, high_ in shape.panes),
        seams=tuple(seam * along for seam in shape.seams),
        sweep=(shape.sweep[0] * rng.uniform(0.85, 1.2), shape.sweep[1] * rng.uniform(0.8, 1.2)),
    )


def _assembled(rng: np.random.Generator, shape: VehicleShape, tint: Tint) -> Mesh:
    skin = body(shape, tint)
    front_z, rear_z = float(np.mean(shape.nose_rows[1:3])), float(np.mean(shape.tail_rows[1:3]))
    parts = [
        skin.mesh,
        plate(_place(skin.nose, front_z) + 0.012, front_z, forward=True),
        plate(_place(skin.tail, rear_z) - 0.012, rear_z, forward=False),
        *wheels(shape, int(rng.choice([0, 5, 6, 7, 10], p=[0.3, 0.25, 0.1, 0.2, 0.15])), 0.2),
        *_mirrors(shape, tint),
        *_handles(shape, tint),
        *_bulbs(skin, shape),
        *_extras(rng, skin, shape),
    ]
    return merged(parts, "car")


def _place(line: np.ndarray, z: float) -> float:
    return float(np.interp(z, line[::-1, 1], line[::-1, 0]))


def wheels(shape: VehicleShape, spokes: int, width: float) -> list[Mesh]:
    """A pair of wheels under each axle of a body; `width` of a tyre in metres."""
    left = wheel(shape.wheel, width, spokes)
    y = shape.width / 2 - width / 2 - 0.03
    return [side for axle in shape.axles for side in both_sides(left.placed((shape.length / 2 - axle, y, shape.wheel)))]


def _mirrors(shape: VehicleShape, tint: Tint) -> list[Mesh]:
    x = shape.length / 2 - shape.profile[1][0] - 0.36
    y, z = shape.width / 2 + 0.06, shape.belt[0] + 0.07
    shell = ellipsoid((x, y, z), (0.075, 0.105, 0.07), "paint", tint, detail=4)
    glass = box((x - 0.055, y, z), (0.02, 0.15, 0.09), "window")
    arm = box((x, y - 0.12, z - 0.05), (0.05, 0.16, 0.03), "underbody")
    return list(both_sides(merged([shell, glass, arm])))


def _handles(shape: VehicleShape, tint: Tint) -> list[Mesh]:
    y = 0.486 * shape.width
    parts = []
    for seam in shape.seams[1:]:
        z = np.interp(seam, [shape.profile[1][0], shape.length], shape.belt) - 0.13
        parts.append(box((shape.length / 2 - seam + 0.16, y, z), (0.19, 0.03, 0.03), "paint", tint))
    return list(both_sides(merged(parts)))


def _bulbs(skin: Body, shape: VehicleShape) -> list[Mesh]:
    """The bulbs behind a headlamp's glass."""
    z = (shape.profile[0][1] - 0.06 + shape.nose_rows[1]) / 2
    y = 0.76 * 0.44 * shape.width
    x = _place(skin.nose, z) - shape.sweep[0] * (2 * y / shape.width) ** 2.6 - 0.012
    return list(both_sides(ellipsoid((x, y, z), (0.04, 0.068, 0.06), "headlamp", (1.1, 1.1, 1.1), detail=3)))


def _extras(rng: np.random.Generator, skin: Body, shape: VehicleShape) -> list[Mesh]:
    """Badges, the third brake lamp, and extras of some cars: roof rails, rub strips, an aerial."""
    half, nose, tail = shape.length / 2, shape.profile[0][1] - 0.09, shape.tail_rows[0] - 0.03
    parts = [ellipsoid((_place(skin.nose, nose), 0, nose), (0.015, 0.05, 0.05), "rim", detail=3)]
    parts.append(ellipsoid((_place(skin.tail, tail), 0, tail), (0.012, 0.045, 0.045), "rim", detail=3))
    head, foot = shape.profile[4:6]
    parts.append(box((half - head[0] - 0.05, 0, head[1] - 0.04), (0.06, 0.26, 0.022), "tail-lamp"))
    if rng.uniform() < 0.35:
        parts.append(box((half - head[0] + 0.25, 0, head[1] + 0.03), (0.1, 0.015, 0.06), "underbody"))
    if rng.uniform() < 0.3:  # rub strips
        low, high = shape.axles[0] + shape.wheel + 0.09, shape.axles[-1] - shape.wheel - 0.09
        middle = float(shape.sill + np.mean(shape.belt)) / 2
        strip = box((half - (low + high) / 2, shape.width / 2, middle), (high - low, 0.024, 0.055), "dark-metal")
        parts += both_sides(strip)
    if rng.uniform() < 0.5 and foot[0] - head[0] < 0.42 and head[0] > 3.8:  # estates, minivans, SUVs
        ends = np.array([half - head[0] + 0.15, half - shape.profile[2][0] - 0.25])
        x = np.array([ends[0], ends[0] + 0.12, ends[1] - 0.12, ends[1]])
        top = np.interp(half - x, *np.array(shape.profile[2:5]).T)
        y = np.full(4, 0.5 * shape.rail * shape.width - 0.03)
        parts += both_sides(tube(np.stack([x, y, top + (-0.03, 0.02, 0.02, -0.03)], axis=1), 0.016, "rim", sides=4))
    return parts


def trailer(rng: np.random.Generator) -> Mesh:
    """A trailer by itself: a small one for cars, a caravan, or a lorry's."""
    draw = rng.uniform()
    made = _small_trailer(rng) if draw < 0.45 else _caravan(rng) if draw < 0.75 else semitrailer(rng, parked=True)
    return merged([centred(made)], "trailer")


def semitrailer(rng: np.random.Generator, *, parked: bool) -> Mesh:
    """The trailer of a tractor, 13.6 m, around x = 0; by itself it stands on its legs."""
    length, wide, tall = 13.6, 2.5, 2.75
    bed = box((0, 0, 1.18), (length, wide, 0.14), "dark-metal")
    frame = box((-1.0, 0, 0.95), (length - 3.2, 1.0, 0.3), "underbody")
    plain = rng.uniform() < 0.4
    fill = (boxed if plain else covered)(length, wide, 1.25, tall, WHITE if plain else pick(rng, TARPAULINS))
    axles = [part for x in (-2.9, -4.2, -5.5) for part in axle(x, 1.0)]
    down = 1.15 if parked else 0.5
    legs = both_sides(box((3.4, 0.6, 1.155 - down / 2), (0.14, 0.14, down), "dark-metal"))
    guard = both_sides(box((0.6, 1.2, 0.75), (4.6, 0.03, 0.12), "metal"))
    return merged([bed, frame, *fill, *axles, *legs, *guard, *rear_end(-length / 2, 1.05, 1.25)])


def centred(mesh: Mesh) -> Mesh:
    """Move a mesh along x to the middle of its footprint."""
    x = mesh.vertices[:, 0]
    return mesh.placed((-float(x.min() + x.max()) / 2, 0.0, 0.0))


def axle(x: float, scale: float) -> list[Mesh]:
    """A pair of twin wheels with mudguards."""
    radius = 0.5 * scale
    twin = wheel(radius, 0.52 * scale, 8, 0.56)
    guard = box((x, 0.98 * scale, 2 * radius + 0.04), (2.1 * radius, 0.5 * scale, 0.04), "dark-metal")
    across = box((x, 0, radius), (0.16, 1.6 * scale, 0.16), "underbody")
    return [*both_sides(twin.placed((x, 0.98 * scale, radius))), *both_sides(guard), across]


def rear_end(x: float, z: float, half: float) -> list[Mesh]:
    """Tail lamps, the bar below them and the plate, at the end x of a lorry or trailer."""
    lamp = box((x + 0.02, half - 0.26, z - 0.14), (0.08, 0.42, 0.14), "tail-lamp")
    bar = box((x + 0.15, 0, 0.52), (0.1, 2 * half - 0.1, 0.12), "metal")
    return [*both_sides(lamp), bar, plate(x - 0.02, z - 0.16, forward=False)]


def boxed(length: float, wide: float, low: float, tall: float, tint: Tint) -> list[Mesh]:
    """A plain box with metal edges and doors at its back."""
    parts = [box((0, 0, low + tall / 2), (length, wide, tall), "paint", tint)]
    for x in (-length / 2, length / 2):
        for y in (-wide / 2, wide / 2):
            parts.append(box((x, y, low + tall / 2), (0.08, 0.08, tall), "metal"))
    for z in (low, low + tall):
        parts += [box((0, s * wide / 2, z), (length + 0.08, 0.06, 0.08), "metal") for s in (-1, 1)]
        parts += [box((s * length / 2, 0, z), (0.08, wide, 0.08), "metal") for s in (-1, 1)]
    for y in (-0.3 * wide, -0.12 * wide, 0.12 * wide, 0.3 * wide):
        parts.append(box((-length / 2 - 0.03, y, low + tall / 2), (0.03, 0.035, tall), "metal"))
    return parts


def covered(length: float, wide: float, low: float, tall: float, tint: Tint) -> list[Mesh]:
    """A tarpaulin over hoops, with boards of metal below and straps."""
    boards = box((0, 0, low + 0.25), (length, wide, 0.5), "metal")
    cover = [box((0, 0, low + 0.45 + (tall - 0.55) / 2), (length - 0.02, wide + 0.03, tall - 0.55), "tarpaulin", tint)]
    cover.append(box((0, 0, low + tall - 0.07), (length - 0.06, wide - 0.14, 0.14), "tarpaulin", tint))
    strap, z = (0.05, wide + 0.05, tall / 2 - 0.1), low + 0.42 + tall / 4
    places = np.linspace(-0.47, 0.47, max(4, int(length / 0.7))) * length
    straps = [box((x, 0, z), strap, "dark-metal", open_sides=("top", "bottom")) for x in places]
    return [boards, *cover, *straps]


def _drawbar(front: float, z: float) -> list[Mesh]:
    """The bar between a small trailer and a car, with its jockey wheel; `front` is the body's end."""
    bar = tube([(front - 0.3, 0.0, z), (front + 1.15, 0.0, z)], 0.04, "metal", sides=6)
    ties = both_sides(tube([(front - 0.1, 0.45, z), (front + 0.7, 0.02, z)], 0.03, "metal", sides=6))
    leg = tube([(front + 0.85, 0.08, z + 0.35), (front + 0.85, 0.08, 0.09)], 0.025, "metal", sides=6)
    return [bar, *ties, leg, wheel(0.09, 0.06, 0).placed((front + 0.85, 0.08, 0.09))]


def _small_trailer(rng: np.random.Generator) -> Mesh:
    """A car's trailer with boards, mostly under a tarpaulin."""
    length, wide = float(rng.uniform(2.0, 2.9)), float(rng.uniform(1.15, 1.45))
    low, lidded = 0.5, rng.uniform() < 0.7
    parts = covered(length, wide, low, float(rng.uniform(0.95, 1.5)), pick(rng, TARPAULINS)) if lidded else []
    if not lidded:
        for s in (-1, 1):
            parts.append(box((0, s * wide / 2, low + 0.18), (length, 0.03, 0.36), "metal"))
            parts.append(box((s * length / 2, 0, low + 0.18), (0.03, wide, 0.36), "metal"))
    parts.append(box((0, 0, low), (length, wide, 0.05), "wood"))
    tyre = wheel(0.29, 0.16, 0).placed((-0.1, wide / 2 + 0.12, 0.29))
    guard = box((-0.1, wide / 2 + 0.12, 0.63), (0.7, 0.2, 0.03), "dark-metal")
    across = box((-0.1, 0, 0.3), (0.08, wide + 0.1, 0.08), "underbody")
    lamp = box((-length / 2 - 0.03, wide / 2 - 0.14, low - 0.06), (0.06, 0.22, 0.12), "tail-lamp")
    back = plate(-length / 2 - 0.04, low - 0.08, forward=False)
    return merged([*parts, across, back, *both_sides(merged([tyre, guard, lamp])), *_drawbar(length / 2, 0.45)])


def _caravan(rng: np.random.Generator) -> Mesh:
    """A caravan: white, round-edged, one axle."""
    long = float(rng.uniform(4.2, 5.6))
    shape = VehicleShape(
        length=long, width=2.2, belt=(1.35, 1.35), sill=0.4, axles=(0.55 * long,), wheel=0.31, rail=0.94,
        frame=0.38, tuck=0.99, round=0.25, sweep=(0.12, 0.1), crown=(0.02, 0.04),
        profile=((0, 1.2), (0.08, 1.3), (0.45, 2.3), (0.5 * long, 2.58),
                 (long - 0.25, 2.45), (long - 0.06, 1.4), (long, 1.25)),
        nose_rows=(1.1, 0.95, 0.75, 0.55), tail_rows=(1.1, 0.95, 0.75, 0.55),
        panes=((0.6, 1.5), (0.55 * long, 0.55 * long + 1.1)), rear=(Patch("tail-lamp", (5, 6), (2, 4), 0.05),),
    )  # fmt: skip
    skin = body(shape, (1.4, 1.38, 1.32))
    stripe = box((0, 0, 0.98), (0.86 * long, 2.225, 0.09), "paint", colour(rng), open_sides=("top", "bottom"))
    parts = [skin.mesh, stripe, *wheels(shape, 0, 0.19), *_drawbar(long / 2 - 0.1, 0.47)]
    return merged([*parts, plate(-long / 2 - 0.01, 0.68, forward=False)])


CAB = VehicleShape(
    length=2.25, width=2.48, belt=(1.72, 1.78), sill=0.42, axles=(1.32,), wheel=0.5, rail=0.9, frame=0.24, tuck=0.985,
    profile=((0, 1.6), (0.05, 1.66), (0.3, 2.72), (0.9, 2.95), (2.13, 2.98), (2.22, 2.2), (2.25, 2.1)),
    nose_rows=(1.4, 0.98, 0.72, 0.5), tail_rows=(1.6, 1.2, 0.9, 0.6), panes=((0.2, 1.36),), seams=(0.28, 1.46),
    sweep=(0.16, 0.03), narrow=(0.05, 0.0), crown=(0.03, 0.06), rear_screen=False, cladding="dark-metal",
    front=(
        Patch("underbody", (3, 4), (0, 3)), Patch("dark-metal", (5, 7), (0, 4), 0.3),
        Patch("headlamp", (5, 6), (2, 4), 0.1),
    ),
)  # fmt: skip
BUS = VehicleShape(
    length=12.0, width=2.55, belt=(1.12, 1.2), sill=0.3, axles=(2.72, 8.6), wheel=0.48, rail=0.95, tuck=0.99,
    profile=((0, 1.0), (0.04, 1.08), (0.24, 2.75), (1.2, 3.05), (11.84, 3.0), (11.95, 1.75), (12.0, 1.6)),
    nose_rows=(0.92, 0.82, 0.6, 0.42), tail_rows=(1.5, 1.15, 0.8, 0.5), sweep=(0.2, 0.1), narrow=(0.04, 0.03),
    panes=((0.25, 1.9), (1.98, 3.6), (3.68, 5.3), (5.38, 7.0), (7.08, 8.7), (8.78, 10.4), (10.48, 11.6)),
    crown=(0.02, 0.09), round=0.18, frame=0.34,
    front=(
        Patch("headlamp", (4, 5), (2, 4), 0.12), Patch("underbody", (4, 5), (0, 2)),
        Patch("underbody", (6, 7), (0, 3)),
    ),
    rear=(Patch("tail-lamp", (3, 5), (3, 4), 0.04), Patch("underbody", (4, 6), (0, 2))),
)  # fmt: skip
TRAM = VehicleShape(
    length=29.0, width=2.4, belt=(1.3, 1.3), sill=0.24, axles=(), wheel=0.3, rail=0.9, frame=0.5, tuck=0.99,
    profile=((0, 1.02), (0.14, 1.14), (1.0, 3.06), (14.5, 3.18), (28.0, 3.06), (28.86, 1.14), (29.0, 1.02)),
    nose_rows=(0.95, 0.86, 0.66, 0.42), tail_rows=(0.95, 0.86, 0.66, 0.42), sweep=(0.4, 0.4), narrow=(0.12, 0.12),
    panes=(), crown=(0.03, 0.1), round=0.35,
    front=(Patch("headlamp", (4, 5), (2, 3)), Patch("dark-metal", (6, 7), (0, 4), 0.5)),
    rear=(Patch("tail-lamp", (4, 5), (2, 3)), Patch("dark-metal", (6, 7), (0, 4), 0.5)),
)  # fmt: skip
LIVERIES: tuple[Tint, ...] = (WHITE, (1.3, 0.75, 0.03), (0.75, 0.03, 0.03), (0.05, 0.16, 0.55), (0.75, 0.76, 0.78))


def truck(rng: np.random.Generator) -> Mesh:
    """A lorry: a rigid one with a box, a tarpaulin or a tipper's tub, or a tractor with its trailer."""
    articulated = rng.uniform() < 0.25
    small = not articulated and rng.uniform() < 0.45
    tint = WHITE if rng.uniform() < 0.45 else colour(rng)
    scale = 0.82 if small else 1.0
    cab = _cab(rng, tint)
    cab = replace(cab, vertices=cab.vertices * np.float32(scale))
    if articulated:
        bed = semitrailer(rng, parked=False)
        tractor = [cab.placed((1.9, 0, 0)), box((1.2, 0, 0.72), (3.6, 0.8, 0.3), "underbody"), *axle(-0.2, 1.0)]
        return centred(merged([bed.placed((-1.25, 0, 0)), *(part.placed((5.15, 0, 0)) for part in tractor)], "truck"))
    length = float(rng.uniform(3.6, 4.8) if small else rng.uniform(4.6, 6.6))
    front = length / 2 + 1.2 * scale
    parts = [cab.placed((front + 0.05, 0, 0)), _cargo(rng, length, 0.92 * scale, scale)]
    parts.append(box((0.8 * scale + 0.1, 0, 0.72), (length + 1.6 * scale, 0.8, 0.3), "underbody"))  # girders
    tandem = not small and rng.uniform() < 0.4
    for x in (0.5, -0.85) if tandem else (0.0,):
        parts += axle(x - 0.2 * length, scale)
    parts += rear_end(-length / 2, 0.85 * scale, 1.2 * scale)
    parts += both_sides(box((0.35 * length, 0.95 * scale, 0.62), (0.8, 0.45, 0.45), "metal"))
    return centred(merged(parts, "truck"))


def bus(rng: np.random.Generator) -> Mesh:
    """A city bus of 12 m with doors on its right."""
    tint = pick(rng, LIVERIES)
    skin = body(BUS, tint)
    half, side = BUS.length / 2, -BUS.width / 2
    parts = [skin.mesh, *wheels(BUS, 0, 0.3)]
    for x in (1.15, 5.9, 9.75):
        parts += _door(half - x, side, 1.25, 0.36, 2.45)
    parts.append(box((half - 0.18, 0, 2.68), (0.2, 1.7, 0.26), "underbody"))
    parts.append(box((half - 0.075, 0, 2.68), (0.01, 1.3, 0.13), "light-yellow", (0.6, 0.6, 0.6)))
    arm = np.array([(half - 0.25, 1.15, 2.7), (half + 0.12, 1.28, 2.65), (half + 0.14, 1.3, 2.4)])
    mirror = [tube(arm, 0.022, "dark-metal", sides=5)]
    mirror.append(box((half + 0.13, 1.31, 2.2), (0.1, 0.2, 0.42), "dark-metal"))
    parts += both_sides(merged(mirror))
    roof = [box((x, 0, 3.1), (long, 1.5, 0.28), "paint", tint) for x, long in ((1.8, 2.4), (-3.4, 3.0))]
    plates = [plate(half + 0.005, 0.55, forward=True), plate(-half - 0.005, 0.72, forward=False)]
    return merged([*parts, *roof[: int(rng.integers(0, 3))], *plates], "bus")


def tram(rng: np.random.Generator) -> Mesh:
    """A tram of three or five stiff sections on a straight track, 29 m, doors on its right."""
    tint = pick(rng, LIVERIES[1:4])
    sections, half, side = int(rng.choice([3, 5])), TRAM.length / 2, -TRAM.width / 2
    joints = np.linspace(0, TRAM.length, sections + 1)
    panes = []
    for low, high in zip(joints[:-1] + 0.75, joints[1:] - 0.75, strict=True):
        ends = np.linspace(low, high, max(2, round((high - low) / 1.7)) + 1)
        panes += [(float(a) + 0.04, float(b) - 0.04) for a, b in pairwise(ends)]
    parts = [body(replace(TRAM, panes=tuple(panes)), tint).mesh]
    for low, high in pairwise(joints):
        middle = half - (low + high) / 2
        parts.append(box((middle, 0, 3.26), (0.6 * (high - low), 1.6, 0.3), "dark-metal"))
        parts.append(box((middle, 0, 0.25), (2.4, 2.0, 0.46), "underbody"))
        for x in (0.22, -0.22) if sections == 3 else (0.0,):
            parts += _door(middle + x * (high - low), side, 1.3, 0.34, 2.55)
    for joint in joints[1:-1]:
        parts.append(box((half - joint, 0, 1.72), (0.7, 2.44, 2.75), "rubber"))
    parts.append(box((0, 0, 2.72), (TRAM.length - 4.0, TRAM.width * 0.955, 0.16), "paint", WHITE))
    back = half - 6.5  # of the pantograph
    for y in (-0.3, 0.3):
        arm = [(back, y, 3.45), (half - 5.2, y, 4.2), (back + 0.1, y, 4.95)]
        parts.append(tube(arm, 0.03, "metal", sides=5))
    parts.append(box((back + 0.1, 0, 4.97), (0.3, 1.6, 0.05), "dark-metal"))
    parts.append(box((half - 0.86, 0, 2.72), (0.25, 1.2, 0.24), "underbody"))
    parts.append(box((half - 0.72, 0, 2.72), (0.01, 0.9, 0.13), "light-yellow", (0.6, 0.6, 0.6)))
    return merged(parts, "tram")


def _door(x: float, y: float, wide: float, low: float, high: float) -> list[Mesh]:
    """A glazed double door in the right side at y, centred at x."""
    middle, tall, leaf = (low + high) / 2, high - low, wide / 2 - 0.1
    glass = [box((x + s * wide / 4, y - 0.012, middle), (leaf, 0.02, tall - 0.16), "window") for s in (-1, 1)]
    return [box((x, y + 0.015, middle), (wide, 0.06, tall), "dark-metal"), *glass]


def _cab(rng: np.random.Generator, tint: Tint) -> Mesh:
    """A lorry's cab around its front axle, its back wall at x = -1.125."""
    high = 1 + 0.1 * rng.uniform()
    shape = replace(CAB, profile=tuple((x, z * (high if z > 2.5 else 1)) for x, z in CAB.profile))
    skin, half = body(shape, tint), CAB.length / 2
    parts = [skin.mesh, *wheels(shape, 10, 0.3), plate(half + 0.01, 0.6, forward=True)]
    arm = tube([(half - 0.3, 1.2, 2.5), (half - 0.2, 1.4, 2.48)], 0.02, "dark-metal", sides=5)
    mirror = box((half - 0.2, 1.44, 2.22), (0.12, 0.22, 0.55), "dark-metal")
    visor = box((half - 0.2, 0, 2.66 * high), (0.18, 2.0, 0.05), "dark-metal")
    steps = box((half - 0.42, 1.19, 0.42), (0.45, 0.1, 0.1), "dark-metal")
    return merged([*parts, visor, *both_sides(merged([arm, mirror, steps]))])


def _cargo(rng: np.random.Generator, length: float, floor: float, scale: float) -> Mesh:
    """The load of a lorry, around x = 0: a box, a tarpaulin over boards, or a tipper's tub."""
    draw, wide, tall = rng.uniform(), 2.5 * scale, float(rng.uniform(2.3, 2.7)) * scale
    bed = box((0, 0, floor + 0.06), (length, wide, 0.12), "dark-metal")
    if draw < 0.4:
        return merged([bed, *boxed(length, wide, floor + 0.12, tall, WHITE if rng.uniform() < 0.6 else colour(rng))])
    if draw < 0.75:
        return merged([bed, *covered(length, wide, floor + 0.12, tall, pick(rng, TARPAULINS))])
    tint, high = colour(rng), 1.0 * scale
    z, thick = floor + 0.12 + high / 2, 0.07
    tub = [box((0, s * (wide - thick) / 2, z), (length, thick, high), "paint", tint) for s in (-1, 1)]
    tub += [box((s * (length - thick) / 2, 0, z), (thick, wide, high), "paint", tint) for s in (-1, 1)]
    ribs = [
        box((x, 0, z), (0.08, wide + 0.08, high), "paint", tint, open_sides=("top", "bottom"))
        for x in np.linspace(-0.45, 0.45, 5) * length
    ]
    load = ellipsoid((0, 0, floor + 0.6 * scale), (0.46 * length, 0.46 * wide, 0.5 * scale), "gravel", detail=8)
    shield = box((length / 2 + 0.06, 0, z + 0.3), (0.08, wide, high + 0.6), "paint", tint)
    return merged([bed, *tub, *ribs, load, shield])
