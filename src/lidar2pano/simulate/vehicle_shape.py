"""Side views of road vehicles: the measures from which vehicle_body builds a skin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

SEAM = 0.009  # metres: width of the gap around a door


class Patch(NamedTuple):
    """Cells of an end that are not paint: rows [a, b) and steps across [c, d); `around`: metres onto the side."""

    material: str
    rows: tuple[int, int]
    across: tuple[int, int]
    around: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Side view and measures of a vehicle, metres; x backwards from the nose, z up from the road.

    profile  outline of the top: bonnet's front edge, foot and head of the windscreen, highest point of the roof, head
             and foot of the rear screen, upper edge of the tail.
    belt     height of the side windows' lower edge at the windscreen's foot and at the tail.
    rows     heights of rows 3 to 6 at the nose, and at the tail: edges for lamps and bumpers.
    panes    side windows, from x to x;  seams: gaps around doors, x;  lean: how far a window's rear end leans forward.
    rail     half width of the roof's edge, as a share of half the width;  frame: paint above the side windows.
    tuck     half width at the side windows' lower edge, as a share; near 1 the sides are flat, as a bus's.
    round    radii of the outline's corners at the screens' heads;  sweep: how far the ends' corners lie back.
    """

    length: float
    width: float
    profile: tuple[tuple[float, float], ...]
    belt: tuple[float, float]
    sill: float
    axles: tuple[float, ...]
    wheel: float
    nose_rows: tuple[float, float, float, float]
    tail_rows: tuple[float, float, float, float]
    panes: tuple[tuple[float, float], ...]
    seams: tuple[float, ...] = ()
    lean: float = 0.0
    rail: float = 0.67
    frame: float = 0.065
    round: float = 0.13
    sweep: tuple[float, float] = (0.2, 0.14)
    narrow: tuple[float, float] = (0.1, 0.08)
    tuck: float = 0.935
    crown: tuple[float, float] = (0.06, 0.045)
    gap: float = 0.045
    front: tuple[Patch, ...] = ()
    rear: tuple[Patch, ...] = ()
    rear_screen: bool = True
    cladding: str = "paint"  # of the sill and the edges of the wheel arches
    top: str = "paint"


def overhang(shape: Shape) -> float:
    """From an end to the nearest axle, metres."""
    return min([shape.length / 2, *(min(axle, shape.length - axle) for axle in shape.axles)])


def rounded(shape: Shape) -> np.ndarray:
    """The outline of the top with its corners rounded (n, 2), x growing."""
    points = np.array(shape.profile)
    middle = points[:2].mean(0) + (0, 0.16 * (points[1, 1] - points[0, 1]))  # bonnets are convex
    points = np.insert(points, 1, middle, axis=0)
    radii = [0.6, 0.03, shape.round, 0.5, shape.round, 0.04]
    line = [points[0]]
    for before, corner, after, radius in zip(points[:-2], points[1:-1], points[2:], radii, strict=True):
        to, on = before - corner, after - corner
        reach = [min(radius, 0.42 * np.hypot(*way)) / np.hypot(*way) for way in (to, on)]
        a, b = corner + to * reach[0], corner + on * reach[1]
        line += [(1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b for t in (0, 0.5, 1)]
    return np.array([*line, points[-1]])


def screens(shape: Shape) -> tuple[tuple[float, float], tuple[float, float]]:
    """From x to x: the glass of the windscreen and of the rear screen."""
    (a, _), (b, _) = shape.profile[1:3]
    (c, _), (d, _) = shape.profile[4:6]
    return (a + 0.01, b - 0.1 * (b - a)), (c + 0.14 * (d - c), d - 0.05 * (d - c))


def columns(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Places x of the columns, and where each ends below: at the sill or at a wheel's arch; both (n,)."""
    length, radius = shape.length, shape.wheel + shape.gap
    (a, b), (c, d) = screens(shape)
    edges = [0.0, length, a - 0.045, a, b, c, d, *(x for pane in shape.panes for x in pane)]
    edges = np.unique(np.round([*edges, *(x for seam in shape.seams for x in (seam, seam + SEAM))], 4))
    edges = edges[np.concatenate([[True], np.diff(edges) > 0.006])]
    between = np.unique(np.round([*rounded(shape)[1:-1, 0], 0.05, 0.16, length - 0.14, length - 0.05], 4))
    between = between[np.concatenate([[True], np.diff(between) > 0.03])]
    x = np.sort(np.concatenate([edges, between[np.abs(between[:, None] - edges).min(1) > 0.04]]))
    bottom = shape.sill + np.interp(x, [0, 0.35, length - 0.45, length], [0.05, 0, 0, 0.09])
    order = np.zeros(len(x))
    for axle in shape.axles:
        turn = np.linspace(0, np.pi, 9)
        away = np.abs(x - axle) > radius + 0.004
        keep = away | (np.abs(np.abs(x - axle)[:, None] - radius * np.abs(np.cos(turn))).min(1) > 0.012)
        x, bottom, order = x[keep], bottom[keep], order[keep]
        inside = np.abs(x - axle) < radius
        bottom = np.where(inside, shape.wheel + np.sqrt(np.maximum(radius**2 - (x - axle) ** 2, 0)), bottom)
        x = np.concatenate([x, axle - radius * np.cos(turn), [axle - radius, axle + radius]])
        bottom = np.concatenate([bottom, shape.wheel + radius * np.sin(turn), [shape.sill, shape.sill]])
        order = np.concatenate([order, np.zeros(len(turn)), [-1, 1]])
    by_x = np.lexsort([order, np.round(x, 5)])
    return x[by_x], bottom[by_x]
