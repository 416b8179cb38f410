"""The street world's textures, noise, looks and skies."""

import numpy as np
import pytest

from lidar2pano.simulate.render import textures
from lidar2pano.simulate.render.looks import LOOKS, look, sky
from lidar2pano.simulate.render.textures import SIZE, bilinear, spatial_hash, spectral
from lidar2pano.simulate.scene.surfaces import MATERIALS


def test_every_material_has_its_texture():
    assert {material.texture for material in MATERIALS.values()} <= set(textures.TEXTURES)


@pytest.mark.parametrize("name", textures.TEXTURES[1:])
def test_tiles_go_on_over_their_edges(name):
    """The mean step over the edge of a tile is no greater than those from row to row and column to column in it."""
    size_m, texture = np.array(textures.PATTERNS[name].size_m), textures.TEXTURE_IDS[name]
    v, u = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    place = (np.stack([u, v], axis=-1).reshape(-1, 2) / SIZE * size_m).astype(np.float32)
    tile = textures.sample(np.full(len(place), texture), place, np.zeros(len(place)))[0].reshape(SIZE, SIZE, 3)
    for axis in (0, 1):
        steps = np.abs(np.roll(tile, -1, axis) - tile).mean(axis=(1 - axis, 2))
        assert steps[-1] <= 1.15 * steps[:-1].max()


@pytest.mark.parametrize("name", textures.TEXTURES[1:])
def test_all_levels_have_one_mean(name):
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 50, (20000, 2)).astype(np.float32)
    means = []
    for footprint in (0.0, 0.05, 0.3, 2.0, 100.0):
        factor, slope = textures.sample(np.full(20000, textures.TEXTURE_IDS[name]), place, np.full(20000, footprint))
        means.append(factor.mean(axis=0))
        assert np.abs(slope.mean(axis=0)).max() < 0.03
    assert np.ptp(means, axis=0).max() < 0.03
    if name != "litter":
        assert np.abs(np.array(means) - 1).max() < 0.03


def test_wider_footprints_see_less_detail():
    place = np.random.default_rng(1).uniform(0, 50, (5000, 2)).astype(np.float32)
    for name in ("asphalt", "grass", "brick", "leaves"):
        texture = np.full(5000, textures.TEXTURE_IDS[name])
        spread = [textures.sample(texture, place, np.full(5000, f))[0].std() for f in (0.001, 0.02, 0.1, 0.5, 5)]
        assert all(fine > coarse for fine, coarse in zip(spread, spread[1:], strict=False)), (name, spread)


def test_wide_patterns_do_not_repeat_within_sixty_metres():
    walk = np.stack([np.linspace(0, 60, 600), np.zeros(600)], axis=1).astype(np.float32)
    texture = np.full(600, textures.TEXTURE_IDS["grass"])
    line = textures.sample_wide(texture, walk, np.full(600, 0.1))[:, 0]
    for shift in range(50, 550, 10):
        assert np.abs(line[shift:] - line[: 600 - shift]).mean() > 0.01


def test_the_even_texture_changes_nothing():
    factor, slope = textures.sample(np.zeros(9, int), np.random.default_rng(0).normal(0, 9, (9, 2)), np.full(9, 0.1))
    assert np.allclose(factor, 1) and np.allclose(slope, 0)


def test_lotteries_belong_to_places():
    place = np.random.default_rng(0).uniform(-300, 300, (3, 20000)).astype(np.float32)
    number = spatial_hash(place, 0.02, 1)
    assert np.array_equal(number, spatial_hash(place.copy(), 0.02, 1))
    assert abs(number.mean() - 0.5) < 0.02 and abs(number.std() - 12**-0.5) < 0.01
    assert abs(np.corrcoef(number, spatial_hash(place, 0.02, 2))[0, 1]) < 0.03
    floor = np.vstack([place[:2], np.zeros((1, 20000), np.float32)])  # rounding must not decide on floors and walls
    off = np.array([[0], [0], [1e-5]], dtype=np.float32)
    assert np.array_equal(spatial_hash(floor - off, 0.02, 1), spatial_hash(floor + off, 0.02, 1))


def test_bilinear_goes_through_its_pixels_and_around_the_edge():
    tile = spectral("test", 1.0)
    x = np.array([3.0, 3.5, SIZE - 0.5], dtype=np.float32)
    wanted = [tile[7, 3], (tile[7, 3] + tile[7, 4]) / 2, (tile[7, -1] + tile[7, 0]) / 2]
    assert np.allclose(bilinear(tile, x, np.full(3, 7, np.float32)), wanted, atol=1e-5)


@pytest.mark.parametrize("name", LOOKS)
def test_the_sky_is_finite_and_bright_all_round(name):
    direction = np.random.default_rng(0).normal(0, 1, (3, 20000)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=0)
    direction[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    for seed in range(3):
        above = sky(look(name, seed))
        for light in (above.radiance(direction), above.ambient(direction)):
            assert np.isfinite(light).all() and (light >= 0).all()
        up, down = above.ambient(np.array([[0, 0], [0, 0], [1.0, -1.0]], dtype=np.float32)).mean(axis=0)
        assert up > 1.5 * down > 0


def test_looks_differ_by_seed():
    assert look("day", 1) == look("day", 1) != look("day", 2)
    assert np.linalg.norm(look("evening", 3).sun_direction) == pytest.approx(1)
