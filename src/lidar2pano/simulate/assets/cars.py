"""Cars: hatchbacks, saloons, estates, SUVs, minivans, city cars, coupés, cabriolets and vans, as in Germany."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar2pano.simulate.assets.vehicle_body import Body, Patch, VehicleShape, body, both_sides, plate, wheel
from lidar2pano.simulate.scene.mesh import Mesh, box, ellipsoid, merged, tube

# Share of cars, linear RGB albedo: Germany's registrations around 2012 (KBA), rounded.
COLOURS: tuple[tuple[float, tuple[float, float, float]], ...] = (
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


def colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """Tint of a car's paint over the material's grey of 0.5."""
    pick = rng.choice(len(COLOURS), p=[share for share, _ in COLOURS])
    r, g, b = np.asarray(COLOURS[pick][1]) * rng.uniform(0.8, 1.25) * rng.uniform(0.94, 1.06, 3) / 0.5
    return float(min(r, 1.6)), float(min(g, 1.6)), float(min(b, 1.6))


def car(rng: np.random.Generator, body: str | None = None) -> Mesh:
    """A car on its wheels, facing +x; `body` in BODIES, by default random by SHARES."""
    name = BODIES[rng.choice(len(BODIES), p=SHARES)] if body is None else body
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


def _assembled(rng: np.random.Generator, shape: VehicleShape, tint: tuple[float, float, float]) -> Mesh:
    skin = body(shape, "car", tint)
    front_z, rear_z = float(np.mean(shape.nose_rows[1:3])), float(np.mean(shape.tail_rows[1:3]))
    parts = [
        skin.mesh,
        plate(_place(skin.nose, front_z) + 0.012, front_z, "car", forward=True),
        plate(_place(skin.tail, rear_z) - 0.012, rear_z, "car", forward=False),
        *wheels(shape, "car", int(rng.choice([0, 5, 6, 7, 10], p=[0.3, 0.25, 0.1, 0.2, 0.15])), width=0.2),
        *_mirrors(shape, tint),
        *_handles(shape, tint),
        *_bulbs(skin, shape),
        *_extras(rng, skin, shape),
    ]
    return merged(parts)


def _place(line: np.ndarray, z: float) -> float:
    return float(np.interp(z, line[::-1, 1], line[::-1, 0]))


def wheels(shape: VehicleShape, object_type: str, spokes: int, width: float) -> list[Mesh]:
    """A pair of wheels under each axle of a body; `width` of a tyre in metres."""
    one = wheel(shape.wheel, width, object_type, spokes)
    y = shape.width / 2 - width / 2 - 0.03
    return [side for axle in shape.axles for side in both_sides(one.placed((shape.length / 2 - axle, y, shape.wheel)))]


def _mirrors(shape: VehicleShape, tint: tuple[float, float, float]) -> list[Mesh]:
    x = shape.length / 2 - shape.profile[1][0] - 0.36
    y, z = shape.width / 2 + 0.06, shape.belt[0] + 0.07
    shell = ellipsoid((x, y, z), (0.075, 0.105, 0.07), "paint", "car", detail=4, tint=tint)
    glass = box((x - 0.055, y, z), (0.02, 0.15, 0.09), "window", "car")
    arm = box((x, y - 0.12, z - 0.05), (0.05, 0.16, 0.03), "underbody", "car")
    return list(both_sides(merged([shell, glass, arm])))


def _handles(shape: VehicleShape, tint: tuple[float, float, float]) -> list[Mesh]:
    y = 0.486 * shape.width
    parts = []
    for seam in shape.seams[1:]:
        z = np.interp(seam, [shape.profile[1][0], shape.length], shape.belt) - 0.13
        parts.append(box((shape.length / 2 - seam + 0.16, y, z), (0.19, 0.03, 0.03), "paint", "car", tint=tint))
    return list(both_sides(merged(parts)))


def _bulbs(skin: Body, shape: VehicleShape) -> list[Mesh]:
    """The bulbs behind a headlamp's glass."""
    z = (shape.profile[0][1] - 0.06 + shape.nose_rows[1]) / 2
    y = 0.76 * 0.44 * shape.width
    x = _place(skin.nose, z) - shape.sweep[0] * (2 * y / shape.width) ** 2.6 - 0.012
    return list(
        both_sides(ellipsoid((x, y, z), (0.04, 0.068, 0.06), "headlamp", "car", detail=3, tint=(1.1, 1.1, 1.1)))
    )


def _extras(rng: np.random.Generator, skin: Body, shape: VehicleShape) -> list[Mesh]:
    """Badges, the third brake lamp, and what some cars have: roof rails, rub strips, an aerial."""
    half, parts = shape.length / 2, []
    z = shape.profile[0][1] - 0.09
    parts.append(ellipsoid((_place(skin.nose, z), 0, z), (0.015, 0.05, 0.05), "rim", "car", detail=3))
    z = shape.tail_rows[0] - 0.03
    parts.append(ellipsoid((_place(skin.tail, z), 0, z), (0.012, 0.045, 0.045), "rim", "car", detail=3))
    head, foot = shape.profile[4:6]
    parts.append(box((half - head[0] - 0.05, 0, head[1] - 0.04), (0.06, 0.26, 0.022), "tail-lamp", "car"))
    if rng.uniform() < 0.35:
        parts.append(box((half - head[0] + 0.25, 0, head[1] + 0.03), (0.1, 0.015, 0.06), "underbody", "car"))
    strips = rng.uniform() < 0.3
    if strips:
        low, high = shape.axles[0] + shape.wheel + 0.09, shape.axles[-1] - shape.wheel - 0.09
        middle = float(shape.sill + np.mean(shape.belt)) / 2
        strip = box((half - (low + high) / 2, shape.width / 2, middle), (high - low, 0.024, 0.055), "dark-metal", "car")
        parts += both_sides(strip)
    rails = rng.uniform() < 0.5
    if rails and foot[0] - head[0] < 0.42 and head[0] > 3.8:  # estates, minivans, SUVs
        ends = np.array([half - head[0] + 0.15, half - shape.profile[2][0] - 0.25])
        x = np.array([ends[0], ends[0] + 0.12, ends[1] - 0.12, ends[1]])
        top = np.interp(half - x, *np.array(shape.profile[2:5]).T)
        y = np.full(4, 0.5 * shape.rail * shape.width - 0.03)
        parts += both_sides(
            tube(np.stack([x, y, top + (-0.03, 0.02, 0.02, -0.03)], axis=1), 0.016, "rim", "car", sides=4)
        )
    return parts
