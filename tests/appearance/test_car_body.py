from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lidar2pano.appearance.cars import (
    BODIES,
    CABIN,
    FLOOR_M,
    GLASS,
    HEAD_LAMP,
    TAIL_LAMP,
    TYRE,
    Boxes,
    Hits,
    _planes,
    distances,
    first_hits,
    tones_of,
)

ABOVE_M = torch.tensor(1.65)
LENGTH_M, WIDTH_M, TOP_M = 4.2, 1.76, 1.46
PAINT = torch.tensor([0.1, 0.2, 0.3])


def box(x: float, y: float, heading: float, body: str = "hatchback") -> Boxes:
    """One car at (x, y), whose nose looks into the direction `heading`."""
    measures = (torch.tensor([value]) for value in (LENGTH_M, WIDTH_M, TOP_M, 0.0))
    ahead = torch.tensor([[math.cos(heading)], [math.sin(heading)]])
    return Boxes(torch.tensor([[x], [y]]), ahead, *measures, torch.tensor([list(BODIES).index(body)]))


def rays(azimuths: np.ndarray, slopes: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    angle = torch.from_numpy(azimuths).float()
    return torch.stack([angle.cos(), angle.sin()])[:, None], torch.from_numpy(slopes).float()[None]


@pytest.mark.parametrize("body", BODIES)
def test_hits_agree_with_their_slow_definition(body):
    car, generator = box(6.0, 3.0, 0.7, body), np.random.default_rng(1)
    azimuth, slope = 0.46 + generator.uniform(-0.5, 0.5, 25), generator.uniform(-0.3, 0.05, 21)
    hits = first_hits(car, *rays(azimuth, slope), ABOVE_M)
    assert torch.equal(distances(car, *rays(azimuth, slope), ABOVE_M), hits.distance_m)
    heights = np.arange(0, 14, 0.005)
    number = 0
    for q, r in np.ndindex(len(azimuth), len(slope)):
        x, y, z = heights * math.cos(azimuth[q]), heights * math.sin(azimuth[q]), 1.65 + heights * slope[r]
        along = (x - 6) * math.cos(0.7) + (y - 3) * math.sin(0.7)
        left = -(x - 6) * math.sin(0.7) + (y - 3) * math.cos(0.7)
        within = np.zeros(len(heights), dtype=bool)
        for part in _planes(car):
            inside = np.ones(len(heights), dtype=bool)
            for normal, end in part:
                place = sum(float(n) * at for n, at in zip(normal, (along, left, z), strict=True) if n is not None)
                inside &= place <= float(end)
            within |= inside
        expected = heights[within.argmax()] if within.any() else math.inf
        found = float(hits.distance_m[0, q, r])
        if math.isinf(found) or math.isinf(expected):
            assert math.isinf(found) and within.sum() < 30  # a ray that grazes an edge
            continue
        number += 1
        assert found == pytest.approx(expected, abs=0.006)
        assert float(hits.behind[0, q, r]) == pytest.approx(0.5 - np.interp(found, heights, along) / LENGTH_M, abs=1e-4)
        assert float(hits.aside_m[0, q, r]) == pytest.approx(np.interp(found, heights, left), abs=1e-4)
        assert float(hits.height_m[0, q, r]) == pytest.approx(1.65 + found * slope[r], abs=1e-4)
    assert number > 50


def test_a_car_has_its_size_and_stands_on_the_road():
    azimuth, slope = np.linspace(0.9, 2.3, 400), np.linspace(-0.5, 0.1, 300)
    hits = first_hits(box(0.0, 5.0, 0.0), *rays(azimuth, slope), ABOVE_M)
    hit = hits.distance_m[0].isfinite()
    x = hits.distance_m[0] * torch.from_numpy(np.cos(azimuth)).float()[:, None]
    y = hits.distance_m[0] * torch.from_numpy(np.sin(azimuth)).float()[:, None]
    assert float(x[hit].max()) == pytest.approx(LENGTH_M / 2, abs=0.03)
    assert float(x[hit].min()) == pytest.approx(-LENGTH_M / 2, abs=0.03)
    assert float(y[hit].min()) == pytest.approx(5 - WIDTH_M / 2, abs=0.01)
    height = hits.height_m[0][hit]
    assert float(height.max()) == pytest.approx(TOP_M, abs=0.03)
    assert float(height.min()) == pytest.approx(FLOOR_M, abs=0.03)


@pytest.mark.parametrize("body", BODIES)
def test_the_nose_is_lower_than_the_tail_and_looks_ahead(body):
    azimuth, slope = np.linspace(0.9, 2.3, 200), np.linspace(-0.4, 0.1, 300)
    for heading, sign in ((0.0, 1), (math.pi, -1)):
        hits = first_hits(box(0.0, 5.0, heading, body), *rays(azimuth, slope), ABOVE_M)
        x = hits.distance_m[0] * torch.from_numpy(np.cos(azimuth)).float()[:, None] * sign
        height = torch.where(hits.distance_m[0].isfinite(), hits.height_m[0], 0.0)
        nose, tail = (height[(x * end > 1.4) & (x * end < 1.9)].max() for end in (1, -1))
        assert nose < tail - 0.08
        assert float(hits.behind[0][x > 1.5].max()) < 0.2


def ahead_of(heading: float, distance_m: float = 6.0) -> tuple[Boxes, Hits, torch.Tensor]:
    """Box, hits and tones of a car straight ahead of the viewpoint."""
    car = box(distance_m, 0.0, heading)
    hits = first_hits(car, *rays(np.linspace(0.5, -0.5, 301), np.linspace(0.0, -0.35, 200)), ABOVE_M)
    flat = Hits(*(part[0][hits.distance_m[0].isfinite()] for part in (p.expand_as(hits.distance_m) for p in hits)))
    each = car.of(torch.zeros(len(flat.face), dtype=torch.int64))
    return each, flat, tones_of(each, flat, PAINT[:, None].expand(3, len(flat.face)))


def test_a_side_has_panes_doors_and_wheels():
    _, hits, tones = ahead_of(math.pi / 2)
    door = (hits.face < CABIN) & ((hits.behind - 0.45).abs() < 0.1) & (hits.height_m > 0.56) & (hits.height_m < 0.9)
    assert door.sum() > 100 and torch.allclose(tones[:, door], PAINT[:, None])
    pane = (hits.face >= CABIN) & ((hits.behind - 0.5).abs() < 0.05) & ((hits.height_m - 1.2).abs() < 0.08)
    assert pane.sum() > 20 and torch.allclose(tones[:, pane], torch.tensor(GLASS)[:, None])
    for axle in (0.19, 0.80):
        off = torch.hypot((hits.behind - axle) * LENGTH_M, hits.height_m - 0.31)
        tyre = (off < 0.37) & (off > 0.20)
        assert tyre.sum() > 50 and (tones[:, tyre] == TYRE).all()


@pytest.mark.parametrize(("heading", "lamp"), [(math.pi, HEAD_LAMP), (0.0, TAIL_LAMP)])
def test_lamps_say_which_end_is_in_view(heading, lamp):
    _, hits, tones = ahead_of(heading)
    colour = torch.tensor(lamp)[:, None]
    lit = (tones == colour).all(0)
    assert lit.sum() > 40 and (hits.aside_m[lit].abs() > 0.3).all()
    left, right = (hits.aside_m[lit] > 0).sum(), (hits.aside_m[lit] < 0).sum()
    assert abs(int(left) - int(right)) <= 0.1 * int(left)
    other = torch.tensor(TAIL_LAMP if lamp is HEAD_LAMP else HEAD_LAMP)[:, None]
    assert not (tones == other).all(0).any()
    screen = (hits.face >= CABIN) & (hits.aside_m.abs() < 0.4) & ((hits.height_m - 1.15).abs() < 0.1)
    assert screen.sum() > 20 and (tones[:, screen].amax(0) < PAINT.max()).all()
