"""How the page's layers are coded: what is exact, and how far the rest is off."""

from __future__ import annotations

import io
import zlib

import numpy as np
import pytest
from PIL import Image

from lidar2pano.viewer.page import (
    CONFIDENCE_STEPS,
    FARTHEST_M,
    NEAREST_M,
    Coding,
    chosen_points,
    code_image,
    coding_for,
    colour_image,
    confidence_codes,
    depth_codes,
    point_bytes,
)
from small_panoramas import small_panorama

EXACT = coding_for(1)


def pixels(coded: tuple[bytes, str]) -> np.ndarray:
    data, mime = coded
    with Image.open(io.BytesIO(data)) as image:
        assert mime == Image.MIME[str(image.format)]
        return np.array(image)


def points_slowly(data: bytes, count: int) -> np.ndarray:
    """(N, 3) metres: one point after the other, as the page's script reads them."""
    planes = np.frombuffer(zlib.decompress(data), dtype=np.uint8).reshape(3, 2, count)
    found, place = [], [0, 0, 0]
    for index in range(count):
        for axis in range(3):
            step = int(planes[axis, 0, index]) + 256 * int(planes[axis, 1, index])
            place[axis] = (place[axis] + step + 0x8000) % 0x10000 - 0x8000
        found.append(list(place))
    return np.array(found).reshape(-1, 3) / 100


def test_few_frames_are_exact():
    around = small_panorama()
    np.testing.assert_array_equal(pixels(colour_image(around.colour, EXACT)), around.colour)
    np.testing.assert_array_equal(pixels(code_image(around.segments, 1))[..., 0], around.segments)
    np.testing.assert_array_equal(
        pixels(code_image(depth_codes(around.depth_m), 1))[..., 1], depth_codes(around.depth_m)
    )
    levels = pixels(code_image(confidence_codes(around.confidence), 1))[..., 0]
    np.testing.assert_allclose(levels / CONFIDENCE_STEPS, around.confidence, atol=0.5 / CONFIDENCE_STEPS + 1e-6)
    see_through = np.dstack([around.colour, around.segments * 17])
    np.testing.assert_array_equal(pixels(colour_image(see_through, EXACT)), see_through)


@pytest.mark.parametrize(("frames", "coarser", "depth_coarser"), [(5, 1, 2), (60, 1, 2), (61, 2, 4), (5000, 2, 4)])
def test_drives_are_smaller(frames, coarser, depth_coarser):
    coding = coding_for(frames)
    around = small_panorama()
    smooth = np.linspace(0, 255, around.colour.size).reshape(around.colour.shape).astype(np.uint8)
    found = pixels(colour_image(smooth, coding))
    assert found.shape == (96 // coarser, 1152 // coarser, 3)
    assert np.abs(found[::, ::, 1].astype(int) - smooth[::coarser, ::coarser, 1]).mean() < 4
    middle = coarser // 2
    classes = pixels(code_image(around.segments, coding.coarser))[..., 0]
    np.testing.assert_array_equal(classes, around.segments[middle::coarser, middle::coarser])
    assert pixels(code_image(depth_codes(around.depth_m), coding.depth_coarser)).shape == (
        96 // depth_coarser,
        1152 // depth_coarser,
        3,
    )


def test_depth_codes_are_equal_steps_of_the_logarithm():
    assert depth_codes(np.array([0, 0.3, NEAREST_M, 16, FARTHEST_M, 1000])).tolist() == [0, 1, 1, 128, 255, 255]
    depth_m = np.exp(np.random.default_rng(0).uniform(np.log(NEAREST_M), np.log(FARTHEST_M), 2000))
    read = NEAREST_M * (FARTHEST_M / NEAREST_M) ** ((depth_codes(depth_m) - 1.0) / 254)
    assert np.abs(read / depth_m - 1).max() < 0.0111


def coded(xyz, coding):
    chosen, usable = chosen_points(xyz, coding)
    return point_bytes(xyz[chosen]), len(chosen), usable


def test_points_come_back_to_the_centimetre():
    generator = np.random.default_rng(1)
    xyz = generator.uniform(-327, 327, (500, 3)).astype(np.float32)
    xyz[7], xyz[8], xyz[9], xyz[10] = np.nan, np.inf, (400, 0, 0), 0
    data, count, usable = coded(xyz, EXACT)
    assert count == usable == 496
    np.testing.assert_allclose(points_slowly(data, count), np.delete(xyz, [7, 8, 9, 10], axis=0), atol=0.0051)


def test_a_drive_shows_a_part_of_the_points():
    xyz = np.arange(3000, dtype=np.float32).reshape(-1, 3) / 30
    data, count, usable = coded(xyz, Coding(quality=None, coarser=1, depth_coarser=1, points=10))
    found = points_slowly(data, count)
    assert (count, usable) == (10, 1000)
    np.testing.assert_allclose(found[[0, -1]], xyz[[0, -1]], atol=0.0051)
    assert [coding_for(frames).points for frames in (0, 4, 60, 61, 5000)] == [1_200_000, 300_000, 20_000, 3000, 3000]
    empty, none, _ = coded(np.empty((0, 3), dtype=np.float32), EXACT)
    assert none == 0 and points_slowly(empty, 0).size == 0
