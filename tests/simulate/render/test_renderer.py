"""The street world's light: sky, shading and cameras."""

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.projection import pixels
from lidar2pano.views import View

pytest.importorskip("embreex")
from lidar2pano.simulate.render import renderer as camera
from lidar2pano.simulate.render import shading
from lidar2pano.simulate.render.looks import look, seasonal_albedo, sky
from lidar2pano.simulate.scene import mesh
from lidar2pano.simulate.scene.raycast import Scene, SceneObject
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS, OBJECT_TYPE_IDS, SKY

VIEW = View(rows=40, columns=240, up=0.3, down=-0.5, kind="cylinder", origin=(0.2, 0.1, -0.1))
DOWN = np.array([[0.0, 0.0, -1.0]], dtype=np.float32)


def box(centre: Any, size: Any, material: str, object_type: str, **more: Any) -> mesh.Mesh:
    return mesh.merged([mesh.box(centre, size, material, **more)], object_type)


def ground(material="asphalt", object_type="road"):
    return SceneObject(mesh=box((0, 0, -0.5), (200, 200, 1), material, object_type))


def street():
    """A road, two houses, a car, a bush."""
    things = [
        box((12, 6, 3), (8, 6, 6), "plaster", "building"),
        box((-9, -7, 2), (6, 6, 4), "brick", "building"),
        box((8, -3, 0.8), (4, 1.8, 1.4), "paint", "car", tint=(1.5, 0.2, 0.2)),
        mesh.merged([mesh.ellipsoid((6, 2, 0.8), (0.8, 0.8, 0.8), "hedge-core")], "vegetation"),
    ]
    return Scene([ground(), *(SceneObject(mesh=thing) for thing in things)])


def pose(x=0.0, y=0.0, yaw=0.0):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 1.8], [0, 0, 0, 1]])


def calibration(width=120, height=60):
    K = np.array([[90.0, 0, (width - 1) / 2], [0, 90.0, (height - 1) / 2], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T[:3, 3] = -T[:3, :3] @ np.array(VIEW.origin)
    return Calibration(K=K, T_camera_lidar=T, size=(width, height))


def plain(**changes):
    """A look without haze or clouds whose light is easy to reckon with."""
    wanted = {
        "zenith": (0, 0, 0),
        "horizon": (0, 0, 0),
        "glow": (0, 0, 0),
        "cloud_cover": 0.0,
        "haze_m": 1e12,
    } | changes
    return replace(look("day"), sun_colour=(1.0, 1.0, 1.0), **wanted)


def shaded(scene, hits, origin, direction, angle, light):
    """Radiance of hits that the whole sky reaches."""
    visible = shading.Visibility(
        shading.sunlit(scene, hits, origin, direction, light), np.ones(len(direction), np.float32)
    )
    return shading.shade(scene, hits, origin, direction, angle, light, visible)


def looked_down_upon(scene, places, light, height=3.0):
    """Radiance (N, 3) of places (N, 2) on the ground seen from above."""
    origin = np.column_stack([places, np.full(len(places), height)]).astype(np.float32)
    direction = np.repeat(DOWN, len(places), axis=0)
    return shaded(scene, scene.cast(origin, direction), origin, direction, 1e-4, light)


# ---- sky


def test_the_light_of_an_even_dome_is_the_dome():
    """Radiance 1 above and nothing below: a floor gets all of it, a wall half (the cosine law's integral)."""
    even = plain(zenith=(1.0, 1.0, 1.0), horizon=(1.0, 1.0, 1.0))
    normal = np.array([[0, 1, 0], [0, 0, 0], [1.0, 0, -1.0]], dtype=np.float32)
    above = sky(even)
    floor, wall, ceiling = above.ambient(normal)[0]
    below = above.ground[0, 0]
    assert floor == pytest.approx(1, abs=0.07)
    assert wall == pytest.approx((1 + below) / 2, abs=0.07)
    assert ceiling == pytest.approx(below, abs=0.07)


# ---- shading


def test_a_matt_floor_shines_by_the_cosine_law():
    """Radiance = albedo x sun x cosine; textures have mean 1, and the look's sky is black."""
    light = plain(sun_direction=(0.6, 0.0, 0.8))
    place = np.random.default_rng(0).uniform(-60, 60, (4000, 2))
    grey = Scene([ground("frame", "road")])  # no texture
    shiny = looked_down_upon(grey, place, light).mean(axis=0)
    albedo = np.array(MATERIALS["frame"].albedo)
    bounced = sky(light).ambient(np.array([[0], [0], [1.0]], np.float32))[:, 0]
    assert np.abs(shiny - albedo * (0.8 + bounced)).max() < 0.06 * albedo.max()
    matt = looked_down_upon(Scene([ground("paving", "road")]), place, light).mean(axis=0)
    assert matt == pytest.approx(np.array(MATERIALS["paving"].albedo) * 0.8, rel=0.05)


def test_a_box_throws_a_shadow():
    """A wall 2 m high, the sun 45 degrees high: the shadow ends 2 m behind it."""
    scene = Scene([ground("paving", "road"), SceneObject(mesh=box((0, 0, 1), (0.2, 40, 2), "concrete", "wall"))])
    light = plain(sun_direction=(0.5**0.5, 0.0, 0.5**0.5))
    x = np.array([-2.5, -1.7, -0.5, 0.5, 2.5])
    visible = [
        looked_down_upon(scene, np.column_stack([np.full(200, at), np.linspace(-9, 9, 200)]), light).mean() for at in x
    ]
    sunny = np.array(visible) > 0.5 * max(visible)
    assert sunny.tolist() == [True, False, False, True, True]
    assert max(visible[1], visible[2]) < 0.12 * max(visible)


def test_leaves_let_light_through_and_walls_do_not():
    up = np.array([[0, 0, 1.0]], dtype=np.float32)
    light = plain(sun_direction=(0.0, 0.0, 1.0))
    for material, shines in (("leaves", True), ("concrete", False)):
        sheet = box((0, 0, 5), (30, 30, 1e-3), material, "vegetation", open_sides=("bottom",))
        scene = Scene([SceneObject(mesh=sheet)])
        origin = np.column_stack([np.random.default_rng(0).uniform(-9, 9, (900, 2)), np.zeros(900)]).astype(np.float32)
        direction = np.repeat(up, 900, axis=0)
        hits = scene.cast(origin, direction)
        assert (shading.sunlit(scene, hits, origin, direction, light)[hits.valid] == shines).mean() > 0.98
    leaf = MATERIALS["leaves"]
    black = replace(light, sun_colour=(0.0, 0.0, 0.0))
    scene = Scene([SceneObject(mesh=box((0, 0, 5), (30, 30, 1e-3), "leaves", "vegetation", open_sides=("bottom",)))])
    hits = scene.cast(origin, direction)
    with_sun, without = (
        shaded(scene, hits, origin, direction, 1e-3, sky_of)[hits.valid].mean() for sky_of in (light, black)
    )
    bounced = sky(light).ground.mean()
    assert with_sun - without == pytest.approx(np.mean(leaf.albedo) * (leaf.transmission + bounced), rel=0.15)


def test_car_paint_mirrors_sky_and_things():
    flat = Scene([SceneObject(mesh=box((0, 0, 0), (9, 9, 1), "paint", "car", tint=(0, 0, 0)))])
    origin = np.array([[-4, 0, 1.0]], dtype=np.float32)
    direction = np.array([[0.99, 0, -0.14]], dtype=np.float32)
    direction /= np.linalg.norm(direction)
    hits = flat.cast(origin, direction)
    dark, bright = (
        shaded(flat, hits, origin, direction, 1e-3, plain(sun_direction=(0, 1.0, 0.0), horizon=(level,) * 3))[0, 0]
        for level in (0.1, 1)
    )
    assert bright > 5 * dark > 0
    light = plain(sun_direction=(0, 1.0, 0.0))
    lamp = flat.with_moving([SceneObject(mesh=box((3, 0, 1.2), (0.1, 4, 0.9), "light-red", "traffic-light"))])
    red, _, blue = shaded(lamp, hits, origin, direction, 1e-3, light)[0]
    assert red > 10 * blue and red > 5 * shaded(flat, hits, origin, direction, 1e-3, light)[0, 0]


# ---- cameras


def test_a_pinhole_looks_where_the_calibration_says():
    camera_, T = calibration(), pose(3, -2, 0.7)
    origin, ray, angle, _ = camera.pinhole(camera_, T)
    assert ray.shape == (60, 120, 3) and angle == 1 / 90
    places = origin + 7.5 * ray.reshape(-1, 3)
    lidar = (np.linalg.inv(T) @ np.column_stack([places, np.ones(len(places))]).T)[:3]
    x, y, z = camera_.K @ (camera_.T_camera_lidar[:3, :3] @ lidar + camera_.T_camera_lidar[:3, 3:])
    v, u = np.mgrid[0:60, 0:120]
    assert np.abs(x / z - u.reshape(-1)).max() < 1e-3 and np.abs(y / z - v.reshape(-1)).max() < 1e-3 and (z > 0).all()


def test_a_cylinder_looks_where_the_projection_says():
    T = pose(3, -2, 0.7)
    origin, ray, *_ = camera.cylinder(VIEW, T)
    lidar = torch.from_numpy(ray.reshape(-1, 3).astype(np.float64) @ T[:3, :3])
    row, column = pixels(*lidar.unbind(1), VIEW)
    i, j = np.mgrid[0:40, 0:240] + 0.5
    assert np.abs(row.numpy() - i.reshape(-1)).max() < 1e-3 and np.abs(column.numpy() - j.reshape(-1)).max() < 1e-3
    assert np.allclose(origin, camera.pinhole(calibration(), T)[0])  # one optical centre


def test_an_image_has_object_types_and_distances():
    scene, T = street(), pose()
    rendered = camera.render(scene, camera.cylinder(VIEW, T), look("day"))
    hits = scene.cast(*(part.reshape(-1, 3)[:, :] if part.ndim > 1 else part for part in camera.cylinder(VIEW, T)[:2]))
    assert rendered.image.shape == (40, 240, 3) and rendered.image.dtype == np.uint8
    assert np.array_equal(rendered.object_type.reshape(-1), hits.object_type) and np.array_equal(
        rendered.distance.reshape(-1), hits.distance
    )
    assert {OBJECT_TYPE_IDS["road"], OBJECT_TYPE_IDS["car"], OBJECT_TYPE_IDS["building"], SKY} <= set(
        rendered.object_type.reshape(-1).tolist()
    )
    assert np.isinf(rendered.distance[rendered.object_type == SKY]).all()
    bright = {
        object_type: rendered.image[rendered.object_type == object_type].mean()
        for object_type in (SKY, OBJECT_TYPE_IDS["road"])
    }
    assert bright[SKY] > bright[OBJECT_TYPE_IDS["road"]] > 40


def test_the_same_call_gives_the_same_bytes():
    scene, rays, light = street(), camera.cylinder(VIEW, pose()), look("day")
    first, again = (camera.render(scene, rays, light) for _ in range(2))
    other = camera.render(scene, rays, light, seed=1)
    assert np.array_equal(first.image, again.image)
    assert not np.array_equal(first.image, other.image)  # the sensor's noise alone
    assert np.abs(first.image.astype(int) - other.image).max() < 25


def test_numbers_fit_the_arrays_that_they_go_into(monkeypatch):
    """NumPy 2.5 refuses in `where` what it wrapped around before: -1 beside uint8."""
    where = np.where

    def strict(condition, first: Any, second: Any):
        for number, array in ((first, second), (second, first)):
            if type(number) is int and isinstance(array, np.ndarray):
                np.array(number, array.dtype)
        return where(condition, first, second)

    monkeypatch.setattr(np, "where", strict)
    with pytest.raises(OverflowError):
        np.where([True], np.zeros(1, np.uint8), -1)
    assert camera.render(street(), camera.cylinder(VIEW, pose()), look("day")).image.any()


@pytest.mark.parametrize("shift", [2, 80])
def test_a_panorama_has_no_seam(shift, monkeypatch):
    """A view that begins some columns later is the same picture, rolled; a bright post stands across the seam."""
    monkeypatch.setattr(camera, "SENSOR_NOISE", 0.0)
    post = SceneObject(mesh=box((-4, -0.085, 1.5), (0.1, 0.25, 3), "frame", "pole"))
    scene, light = street().with_moving([post]), look("day", 1)
    step = 360 / VIEW.columns
    turned = replace(VIEW, left=VIEW.left - shift * step, right=VIEW.right - shift * step)
    one, other = (
        camera.render(scene, camera.cylinder(view, pose()), light).image.astype(float) for view in (VIEW, turned)
    )
    off = np.abs(np.roll(one, -shift, axis=1) - other)
    assert off.mean() < 0.04  # rounding may move a ray over an edge now and then
    assert off[:, [-shift - 1, -shift, 0, -1]].mean() < 0.5


def test_a_place_keeps_its_colour_from_frame_to_frame(monkeypatch):
    """Two cameras a metre apart: what both see differs little, before noise, and patterns stay where they are."""
    monkeypatch.setattr(camera, "SENSOR_NOISE", 0.0)
    scene, light = (
        street().with_moving([SceneObject(mesh=box((0, 0, -0.49), (60, 60, 1), "cobbles", "parking"))]),
        look("day", 2),
    )
    view = replace(VIEW, rows=120, columns=600, down=-0.9)
    first = camera.render(scene, camera.cylinder(view, pose()), light)
    second = camera.render(scene, camera.cylinder(view, pose(x=1.0)), light)
    origin, ray, *_ = camera.cylinder(view, pose())
    visible = np.isfinite(first.distance) & (first.distance < 25) & (first.object_type != OBJECT_TYPE_IDS["car"])
    away = torch.from_numpy(
        origin + ray[visible] * first.distance[visible, None] - camera.cylinder(view, pose(x=1.0))[0]
    )
    row, column = (part.floor().long().numpy() for part in pixels(*away.unbind(1), view))
    inside = (row >= 0) & (row < 120)
    row, column, far = row[inside], column[inside] % 600, away.norm(dim=1).numpy()[inside]
    same = np.abs(second.distance[row, column] - far) < 0.03 * far
    assert same.sum() > 5000
    a, b = (
        ((colour[same] / 255.0) ** 2.2).mean(axis=1)
        for colour in (first.image[visible][inside], second.image[row, column])
    )
    assert np.median(np.abs(a - b) / (a + b)) < 0.03
    near = (first.object_type[visible][inside][same] == OBJECT_TYPE_IDS["parking"]) & (far[same] < 4)
    assert np.corrcoef(a[near], b[near])[0, 1] > 0.65  # 0.4 by the shadows alone


def test_overcast_days_have_no_shadows():
    scene = Scene([ground()])
    assert shading.sunlit(scene, scene.cast(DOWN * -3, DOWN), DOWN * -3, DOWN, look("overcast")).sum() == 0


def test_half_the_sky_is_hidden_at_the_foot_of_a_wall():
    scene = Scene([ground(), SceneObject(mesh=box((3.5, 0, 10), (1, 40, 20), "plaster", "building"))])
    view = replace(VIEW, rows=100, columns=500, down=-0.9)
    origin, ray, *_ = camera.cylinder(view, pose())
    hits = scene.cast(origin, ray.reshape(-1, 3))
    surfaces = shading.gbuffer(hits, origin, ray)
    free = shading.sky_visibility(scene, hits, surfaces, True)
    floor = (hits.object_type == OBJECT_TYPE_IDS["road"]).reshape(free.shape)
    x, y, _ = surfaces.position
    assert 0.4 < free[floor & (x > 2.85) & (np.abs(y) < 3)].mean() < 0.72  # what is seen far along the wall counts less
    assert free[floor & (x < -3)].mean() > 0.93
    assert np.median(free[~hits.valid.reshape(free.shape)]) == 1


def test_autumn_turns_leaves_and_strews_them():
    green = np.array([MATERIALS["leaves"].albedo] * 4000).T
    place, tint = np.random.default_rng(0).uniform(-90, 90, (3, 4000)), np.ones((3, 4000))
    for material, turns in (("leaves", True), ("needles", False)):
        which = np.full(4000, MATERIAL_IDS[material])
        for name, autumn in (("autumn", True), ("day", False)):
            turned = seasonal_albedo(look(name), green, which, tint, place)
            assert (turned[0].mean() > 1.15 * turned[1].mean()) == (turns and autumn)
            assert np.array_equal(turned, green) != (turns and autumn)
    scene, light = Scene([ground("asphalt-new")]), look("autumn", 1)
    where = np.random.default_rng(0).uniform(-60, 60, (4000, 2))
    swept, strewn = (
        looked_down_upon(scene, where, one).mean(axis=0) for one in (replace(light, leaf_litter=0.0), light)
    )
    assert strewn[0] / strewn[2] > 1.2 * swept[0] / swept[2]


def test_nothing_at_all_is_sky():
    rendered = camera.render(Scene([]), camera.cylinder(VIEW, pose()), look("evening"))
    assert (rendered.object_type == SKY).all() and np.isinf(rendered.distance).all()
    assert rendered.image.mean() > 30


def test_the_sun_is_as_wide_as_the_look_says():
    """The share of a fine raster around the sun that is blown stands for its disc: pi r^2."""
    light = replace(plain(), sun_direction=(0.0, 0.0, 1.0), sun_radius_deg=0.5)
    side = np.linspace(-0.02, 0.02, 401, dtype=np.float32)
    x, y = np.meshgrid(side, side)
    direction = np.stack([x, y, np.sqrt(1 - x * x - y * y)]).reshape(3, -1)
    share = (sky(light).radiance(direction)[0] > 10).mean()
    assert share * 0.04**2 == pytest.approx(pi * np.radians(0.5) ** 2, rel=0.05)
