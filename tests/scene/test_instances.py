"""Instances of things: connected surfaces of one class, across the seam, with a point each."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from lidar2pano.labels import COMMON15, THINGS
from lidar2pano.scene.instances import LEAST_PIXELS, components, thing_instances
from lidar2pano.scene.surfaces import SAME_SURFACE

CAR, PERSON, ROAD = (COMMON15.id_of(name) for name in ("car", "person", "road"))


def flooded(segments, depth_m, measured, circular):
    """The slow definition: floods from each pixel."""
    rows, columns = segments.shape
    number, last = np.zeros(segments.shape, dtype=int), 0
    seen = ~(np.isin(segments, THINGS) & (depth_m > 0))
    for start in np.ndindex(rows, columns):
        if seen[start]:
            continue
        seen[start], waiting, surface = True, deque([start]), [start]
        while waiting:
            row, column = waiting.popleft()
            for r, beside in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                c = beside % columns if circular else beside
                if not (0 <= r < rows and 0 <= c < columns) or seen[r, c] or segments[r, c] != segments[row, column]:
                    continue
                one, other = depth_m[row, column], depth_m[r, c]
                if max(one, other) < SAME_SURFACE * min(one, other):
                    seen[r, c] = True
                    waiting.append((r, c))
                    surface.append((r, c))
        place = tuple(np.array(surface).T)
        if len(surface) >= LEAST_PIXELS and measured[place].any():
            last += 1
            number[place] = last
    return number


def scene(rows=40, columns=120):
    """A road at 10 m, all of it measured."""
    return (
        np.full((rows, columns), ROAD, dtype=np.uint8),
        np.full((rows, columns), 10, dtype=np.float32),
        np.ones((rows, columns), dtype=bool),
    )


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_flooding(seed, circular):
    generator = np.random.default_rng(seed)
    segments = generator.choice([CAR, CAR, PERSON, ROAD], (12, 24)).astype(np.uint8).repeat(5, 0).repeat(5, 1)
    depth_m = generator.uniform(12, 30, (12, 24)).astype(np.float32).repeat(5, 0).repeat(5, 1)
    measured = generator.random(segments.shape) < 0.02
    found = thing_instances(segments, depth_m, measured, circular=circular)
    expected = flooded(segments, depth_m, measured, circular)
    assert np.array_equal(found, expected) and expected.max() > 3


def test_one_behind_the_other_are_two_and_across_the_seam_one():
    segments, depth_m, measured = scene()
    segments[5:25, 40:60] = segments[5:25, 110:] = segments[5:25, :10] = CAR
    depth_m[5:25, 50:60] = 30  # behind
    found = thing_instances(segments, depth_m, measured, circular=True)
    assert found.max() == 3 and found[10, 45] != found[10, 55] and found[10, 0] == found[10, 119] > 0
    assert thing_instances(segments, depth_m, measured, circular=False).max() == 4


def test_a_guess_without_a_point_and_a_speck_are_none():
    segments, depth_m, measured = scene()
    segments[5:25, 40:60] = CAR
    measured[5:25, 40:60] = False
    segments[30:39, 80:91] = PERSON  # 99 pixels
    assert not thing_instances(segments, depth_m, measured, circular=True).any()
    measured[6, 50], segments[30, 91] = True, PERSON
    assert thing_instances(segments, depth_m, measured, circular=True).max() == 2


def test_nothing_has_no_instances():
    segments, depth_m, measured = scene()
    assert not thing_instances(segments, depth_m, measured, circular=True).any()


def test_a_long_chain_is_one_component():
    node = np.random.default_rng(0).permutation(5000)
    assert not components(5000, node[:-1], node[1:]).any()
    assert np.array_equal(components(4, np.array([3]), np.array([1])), [0, 1, 2, 1])
