"""Trailers: a car's, a caravan, a lorry's; and what lorries share with them."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.cars import colour, wheels
from lidar2pano.simulate.mesh import Mesh, merged
from lidar2pano.simulate.shapes import box, tube
from lidar2pano.simulate.vehicle_body import body, both_sides
from lidar2pano.simulate.vehicle_shape import Patch, Shape
from lidar2pano.simulate.wheels import plate, wheel

Tint = tuple[float, float, float]

WHITE: Tint = (1.42, 1.42, 1.4)


def trailer(rng: np.random.Generator) -> Mesh:
    """A trailer by itself: a small one for cars, a caravan, or a lorry's."""
    which = rng.uniform()
    if which < 0.45:
        return centred(_small_trailer(rng))
    if which < 0.75:
        return centred(_caravan(rng))
    return centred(semitrailer(rng, "trailer"))


def semitrailer(rng: np.random.Generator, kind: str) -> Mesh:
    """The trailer of a tractor, 13.6 m, around x = 0; by itself it stands on its legs."""
    length, wide, tall = 13.6, 2.5, 2.75
    bed = box((0, 0, 1.18), (length, wide, 0.14), "dark-metal", kind)
    frame = box((-1.0, 0, 0.95), (length - 3.2, 1.0, 0.3), "underbody", kind)
    fill = (
        boxed(length, wide, 1.25, tall, WHITE, kind)
        if rng.uniform() < 0.4
        else covered(length, wide, 1.25, tall, cloth(rng), kind)
    )
    axles = [part for x in (-2.9, -4.2, -5.5) for part in axle(x, 1.0, kind)]
    down = 1.15 if kind == "trailer" else 0.5
    legs = both_sides(box((3.4, 0.6, 1.155 - down / 2), (0.14, 0.14, down), "dark-metal", kind))
    guard = both_sides(box((0.6, 1.2, 0.75), (4.6, 0.03, 0.12), "metal", kind))
    return merged([bed, frame, *fill, *axles, *legs, *guard, *stern(-length / 2, 1.05, 1.25, kind)])


def centred(mesh: Mesh) -> Mesh:
    """Moved along x so that the footprint's middle is the origin."""
    x = mesh.vertices[:, 0]
    return mesh.placed((-float(x.min() + x.max()) / 2, 0.0, 0.0))


def axle(x: float, scale: float, kind: str) -> list[Mesh]:
    """A pair of twin wheels with mudguards."""
    radius = 0.5 * scale
    twin = wheel(radius, 0.52 * scale, kind, spokes=8, rim=0.56)
    guard = box((x, 0.98 * scale, 2 * radius + 0.04), (2.1 * radius, 0.5 * scale, 0.04), "dark-metal", kind)
    across = box((x, 0, radius), (0.16, 1.6 * scale, 0.16), "underbody", kind)
    return [*both_sides(twin.placed((x, 0.98 * scale, radius))), *both_sides(guard), across]


def stern(x: float, z: float, half: float, kind: str) -> list[Mesh]:
    """Tail lamps, the bar below them and the plate, at the end x of a lorry or trailer."""
    lamp = box((x + 0.02, half - 0.26, z - 0.14), (0.08, 0.42, 0.14), "tail-lamp", kind)
    bar = box((x + 0.15, 0, 0.52), (0.1, 2 * half - 0.1, 0.12), "metal", kind)
    return [*both_sides(lamp), bar, plate(x - 0.02, z - 0.16, kind, forward=False)]


def cloth(rng: np.random.Generator) -> Tint:
    """The tint of a tarpaulin."""
    return (
        (0.05, 0.12, 0.4),
        (0.6, 0.03, 0.03),
        (1.1, 1.1, 1.08),
        (0.05, 0.2, 0.1),
        (0.9, 0.55, 0.03),
        (0.3, 0.31, 0.33),
    )[rng.integers(6)]


def boxed(length: float, wide: float, low: float, tall: float, tint: Tint, kind: str) -> list[Mesh]:
    """A plain box with metal edges and doors at its back."""
    parts = [box((0, 0, low + tall / 2), (length, wide, tall), "paint", kind, tint=tint)]
    for x in (-length / 2, length / 2):
        for y in (-wide / 2, wide / 2):
            parts.append(box((x, y, low + tall / 2), (0.08, 0.08, tall), "metal", kind))
    for z in (low, low + tall):
        parts += [box((0, s * wide / 2, z), (length + 0.08, 0.06, 0.08), "metal", kind) for s in (-1, 1)]
        parts += [box((s * length / 2, 0, z), (0.08, wide, 0.08), "metal", kind) for s in (-1, 1)]
    for y in (-0.3 * wide, -0.12 * wide, 0.12 * wide, 0.3 * wide):
        parts.append(box((-length / 2 - 0.03, y, low + tall / 2), (0.03, 0.035, tall), "metal", kind))
    return parts


def covered(length: float, wide: float, low: float, tall: float, tint: Tint, kind: str) -> list[Mesh]:
    """A tarpaulin over hoops, with boards of metal below and straps."""
    boards = box((0, 0, low + 0.25), (length, wide, 0.5), "metal", kind)
    cover = [
        box(
            (0, 0, low + 0.45 + (tall - 0.55) / 2),
            (length - 0.02, wide + 0.03, tall - 0.55),
            "tarpaulin",
            kind,
            tint=tint,
        )
    ]
    cover.append(box((0, 0, low + tall - 0.07), (length - 0.06, wide - 0.14, 0.14), "tarpaulin", kind, tint=tint))
    straps = []
    for x in np.linspace(-0.47, 0.47, max(4, int(length / 0.7))) * length:
        straps.append(
            box(
                (x, 0, low + 0.42 + tall / 4),
                (0.05, wide + 0.05, tall / 2 - 0.1),
                "dark-metal",
                kind,
                without=("top", "bottom"),
            )
        )
    return [boards, *cover, *straps]


def _drawbar(front: float, z: float, kind: str) -> list[Mesh]:
    """The bar that couples a small trailer to a car, with its jockey wheel; `front` is the body's end."""
    bar = tube(np.array([(front - 0.3, 0.0, z), (front + 1.15, 0.0, z)]), 0.04, "metal", kind, sides=6)
    ties = both_sides(tube(np.array([(front - 0.1, 0.45, z), (front + 0.7, 0.02, z)]), 0.03, "metal", kind, sides=6))
    leg = tube(np.array([(front + 0.85, 0.08, z + 0.35), (front + 0.85, 0.08, 0.09)]), 0.025, "metal", kind, sides=6)
    return [bar, *ties, leg, wheel(0.09, 0.06, kind, 0).placed((front + 0.85, 0.08, 0.09))]


def _small_trailer(rng: np.random.Generator) -> Mesh:
    """A car's trailer with boards, mostly under a tarpaulin."""
    kind, length, wide = "trailer", float(rng.uniform(2.0, 2.9)), float(rng.uniform(1.15, 1.45))
    low, lidded = 0.5, rng.uniform() < 0.7
    parts = covered(length, wide, low, float(rng.uniform(0.95, 1.5)), cloth(rng), kind) if lidded else []
    if not lidded:
        for s in (-1, 1):
            parts.append(box((0, s * wide / 2, low + 0.18), (length, 0.03, 0.36), "metal", kind))
            parts.append(box((s * length / 2, 0, low + 0.18), (0.03, wide, 0.36), "metal", kind))
    parts.append(box((0, 0, low), (length, wide, 0.05), "wood", kind))
    one = wheel(0.29, 0.16, kind, 0).placed((-0.1, wide / 2 + 0.12, 0.29))
    guard = box((-0.1, wide / 2 + 0.12, 0.63), (0.7, 0.2, 0.03), "dark-metal", kind)
    across = box((-0.1, 0, 0.3), (0.08, wide + 0.1, 0.08), "underbody", kind)
    lamp = box((-length / 2 - 0.03, wide / 2 - 0.14, low - 0.06), (0.06, 0.22, 0.12), "tail-lamp", kind)
    back = plate(-length / 2 - 0.04, low - 0.08, kind, forward=False)
    return merged([*parts, across, back, *both_sides(merged([one, guard, lamp])), *_drawbar(length / 2, 0.45, kind)])


def _caravan(rng: np.random.Generator) -> Mesh:
    """A caravan: white, round-edged, one axle."""
    long = float(rng.uniform(4.2, 5.6))
    shape = Shape(
        length=long, width=2.2, belt=(1.35, 1.35), sill=0.4, axles=(0.55 * long,), wheel=0.31, rail=0.94,
        frame=0.38, tuck=0.99, round=0.25, sweep=(0.12, 0.1), crown=(0.02, 0.04),
        profile=((0, 1.2), (0.08, 1.3), (0.45, 2.3), (0.5 * long, 2.58),
                 (long - 0.25, 2.45), (long - 0.06, 1.4), (long, 1.25)),
        nose_rows=(1.1, 0.95, 0.75, 0.55), tail_rows=(1.1, 0.95, 0.75, 0.55),
        panes=((0.6, 1.5), (0.55 * long, 0.55 * long + 1.1)), rear=(Patch("tail-lamp", (5, 6), (2, 4), 0.05),),
    )  # fmt: skip
    skin = body(shape, "trailer", (1.4, 1.38, 1.32))
    stripe = box(
        (0, 0, 0.98), (0.86 * long, 2.225, 0.09), "paint", "trailer", tint=colour(rng), without=("top", "bottom")
    )
    parts = [skin.mesh, stripe, *wheels(shape, "trailer", 0, width=0.19), *_drawbar(long / 2 - 0.1, 0.47, "trailer")]
    return merged([*parts, plate(-long / 2 - 0.01, 0.68, "trailer", forward=False)])
