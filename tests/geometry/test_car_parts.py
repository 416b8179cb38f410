from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from lidar2pano.geometry.car_parts import (
    ANGLES,
    AXLE,
    GLASS,
    GLASS_TONE,
    LONGEST_M,
    RUBBER_TONE,
    WHEEL_M,
    _numbers,
    _over,
    _rectangles,
    car_tones,
)
from lidar2pano.views import VIEWS

VIEW = replace(VIEWS["panorama"].scaled(0.25), origin=(0.0, 0.0, 0.0))
ABOVE_M = 1.6
LENGTH_M, WIDTH_M, HEIGHT_M = 4.2, 1.7, 1.45
ROWS, COLUMNS = VIEW.rows, VIEW.columns
SLOPE = VIEW.up - (np.arange(ROWS) + 0.5) / ROWS * (VIEW.up - VIEW.down)
AZIMUTH = math.pi - (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * math.pi


def boxes(*places: tuple[float, float, float], length: float = LENGTH_M):
    """Which pixels show boxes of a car's size at (x, y, heading), and their distance: slowly, ray by ray."""
    cars, radius_m = torch.zeros(1, ROWS, COLUMNS), torch.full((1, ROWS, COLUMNS), 80.0)
    for (x, y, heading), column in product(places, range(COLUMNS)):
        ray = np.array([math.cos(AZIMUTH[column]), math.sin(AZIMUTH[column])])
        turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
        start, step = turn @ -np.array([x, y]), turn @ ray
        half = np.array([length / 2, WIDTH_M / 2])
        ends = np.sort([(-half - start) / step, (half - start) / step], 0)
        near, far = ends[0].max(), ends[1].min()
        if 0 < near < far:
            height = near * SLOPE + ABOVE_M
            here = torch.from_numpy((height > 0) & (height < HEIGHT_M)) & (radius_m[0, :, column] > near)
            cars[0, here, column], radius_m[0, here, column] = 1.0, float(near)
    return cars, radius_m


def tones(cars, radius_m, pose=None):
    return car_tones(cars, radius_m, torch.tensor([ABOVE_M]), VIEW, pose)[0]


def places(radius_m, x, y, heading):
    """Along (H, W) a car's side and height of every pixel."""
    radius = radius_m[0].numpy()
    aside = np.stack([radius * np.cos(AZIMUTH) - x, radius * np.sin(AZIMUTH) - y])
    return aside[0] * math.cos(heading) + aside[1] * math.sin(heading), radius * SLOPE[:, None] + ABOVE_M


@pytest.mark.parametrize("place", [(0.0, 5.0, 0.0), (3.0, -6.0, 0.4), (-7.0, 1.0, 1.5), (-6.0, 0.0, 1.7)])
def test_a_cars_side_has_windows_and_wheels(place):
    cars, radius_m = boxes(place)
    tone = tones(cars, radius_m)
    assert (tone[:, cars[0] == 0] == 0).all()
    along, height = places(radius_m, *place)
    car = cars[0].numpy() > 0
    inner = car & (np.abs(along) < 1.2) & (np.abs(along) > 0.2)
    glass = inner & (height > (GLASS[0] + 0.07) * HEIGHT_M) & (height < (GLASS[1] - 0.07) * HEIGHT_M)
    assert glass.sum() > 20 and np.allclose(tone[:, glass], GLASS_TONE, atol=0.02)
    axle = np.hypot(np.abs(along) - AXLE * LENGTH_M, height - WHEEL_M)
    wheels = car & (axle < WHEEL_M - 0.15)
    assert wheels.sum() > 8 and np.allclose(tone[:, wheels], RUBBER_TONE, atol=0.02)
    doors = inner & (axle > WHEEL_M + 0.15) & (height > 0.3) & (height < (GLASS[0] - 0.07) * HEIGHT_M)
    paint = tone[:, doors]
    assert doors.sum() > 20 and torch.allclose(paint, paint[:, :1].expand_as(paint), atol=1e-4)
    assert paint.min() > GLASS_TONE + 0.05


def test_what_is_behind_a_car_and_what_is_no_car_has_no_tone():
    cars, radius_m = boxes((0.0, 5.0, 0.0))
    behind = cars[0] > 0
    radius_m[0, :20][behind[:20]] = 60.0
    cars[0, 5:20, :] = 1.0
    radius_m[0, 5:20, :] = 60.0
    assert (tones(cars, radius_m)[:, 5:20] == 0).all()
    assert (tones(torch.zeros_like(cars), radius_m) == 0).all()


def test_parked_cars_that_touch_are_two():
    cars, radius_m = boxes((0.0, 5.0, 0.0), length=2 * LENGTH_M)
    assert LENGTH_M < LONGEST_M < 2 * LENGTH_M
    along, height = places(radius_m, 0.0, 5.0, 0.0)
    tone = tones(cars, radius_m)
    for middle in (-LENGTH_M / 2, LENGTH_M / 2):
        wheels = (cars[0].numpy() > 0) & (np.hypot(np.abs(along - middle) - AXLE * LENGTH_M, height - WHEEL_M) < 0.15)
        assert wheels.sum() > 4 and np.allclose(tone[:, wheels], RUBBER_TONE, atol=0.05)


def test_cars_that_stand_apart_differ_in_colour():
    cars, radius_m = boxes((3.0, 5.0, 0.0), (-3.0, 5.0, 0.0), (4.0, -6.0, 0.0), (-4.0, -6.0, 0.0))
    tone = tones(cars, radius_m)
    row = ROWS - 1 - int(np.searchsorted((5 * SLOPE + ABOVE_M)[::-1], 0.7))
    paints = {tuple(np.round(colour, 2)) for colour in tone[:, row].T.tolist() if any(colour)}
    assert len(paints) >= 3


def test_tones_turn_with_the_scene_and_hang_in_the_world():
    cars, radius_m = boxes((3.0, 5.0, 0.3), (-4.0, 5.0, 0.0), (-8.0, 0.2, 0.0))  # the last is behind: across the seam
    turned = COLUMNS // 8 + 3
    angle = -turned * 2 * math.pi / COLUMNS  # scene and columns go to the right, so the world is to the left
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    expected = tones(cars, radius_m).roll(turned, 2)
    given = tones(cars.roll(turned, 2), radius_m.roll(turned, 2), pose)
    assert torch.isclose(given, expected, atol=0.02).float().mean() > 0.999


def test_a_parked_car_keeps_its_colour_when_the_sensor_moves():
    paints = []
    for moved in (0.0, 2.0, 4.0):
        pose = np.eye(4)
        pose[:2, 3] = moved, -moved / 4
        cars, radius_m = boxes((3.0 - moved, 5.0 + moved / 4, 0.0))
        tone = tones(cars, radius_m, pose)
        along, height = places(radius_m, 3.0 - moved, 5.0 + moved / 4, 0.0)
        doors = (cars[0].numpy() > 0) & (np.abs(along) < 0.5) & (height > 0.4) & (height < 0.8)
        paints.append(tone[:, doors].mean(1))
    assert torch.allclose(paints[0], paints[1], atol=0.1) and torch.allclose(paints[0], paints[2], atol=0.1)


def test_numbers_count_on_around_the_seam():
    first = torch.tensor([False, True, False, False, True, True, False])
    assert _numbers(first).tolist() == [2, 0, 0, 0, 1, 2, 2]
    assert _numbers(torch.zeros(5, dtype=torch.bool)).tolist() == [0] * 5


def test_rectangles_agree_with_their_slow_definition():
    generator = np.random.default_rng(3)
    number = torch.from_numpy(generator.integers(0, 4, 40))
    point = torch.from_numpy(generator.normal(size=(2, 40)) * [[3.0], [1.0]])
    middle, length, along, across = _rectangles(point, number)
    for one in range(4):
        own = number == one
        found = []
        for step in range(ANGLES):
            angle = step * math.pi / 2 / ANGLES
            axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
            turned = axes @ point[:, own].numpy()
            size = np.ptp(turned, axis=1) + 0.1
            places = turned - (turned.min(1) + turned.max(1))[:, None] / 2
            centre = np.linalg.inv(axes) @ (turned.min(1) + turned.max(1)) / 2
            found.append((size.prod(), size.max(), places[np.argsort(-size)], centre))
        _, longest, (slow_along, slow_across), centre = min(found, key=lambda each: each[0])
        assert np.allclose(middle[:, own].T, centre)
        assert np.allclose(length[own], longest)
        assert np.allclose(along[own], slow_along) and np.allclose(across[own], slow_across)


def test_sums_over_cars_agree_with_their_slow_definition():
    number, values = torch.tensor([0, 1, 0, 2, 1]), torch.tensor([[1.0, 5, 3, 7, -1]])
    assert _over(number, values, "amax").tolist() == [[3, 5, 3, 7, 5]]
    assert _over(number, values, "mean").tolist() == [[2, 2, 2, 7, 2]]
