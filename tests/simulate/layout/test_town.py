"""Roads, land and the things beside them: geometry against slow definitions, and what may stand where."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lidar2pano.simulate.layout.ground import ground, split_triangles
from lidar2pano.simulate.layout.roads import Bay, Road, Terrain, locate, winding_centreline
from lidar2pano.simulate.layout.town import LAND_USES, PLACES, ROAD_MARGIN, Town, build_town, clear_of_roads
from lidar2pano.simulate.layout.traffic import Drive, SpeedProfile, lanes
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import OBJECT_TYPE_IDS


def road(xy: np.ndarray, heading: np.ndarray, **more: object) -> Road:
    values = {
        "half_width": 3.0,
        "sidewalk": 2.0,
        "kerb": 0.1,
        "marking": "town",
        "surface": "asphalt",
        "paving": "paving",
    }
    return Road(xy=xy, heading=heading, **(values | more))  # type: ignore[arg-type]


def straight(length: int = 100, heading: float = 0.0, start: tuple[float, float] = (0.0, 0.0), **more: object) -> Road:
    way = np.arange(length + 1)[:, None] * np.array([np.cos(heading), np.sin(heading)])
    return road(np.asarray(start) + way, np.full(length + 1, heading), **more)


@pytest.mark.parametrize("seed", range(3))
def test_positions_agree_with_a_search_over_the_whole_centreline(seed):
    rng = np.random.default_rng(seed)
    line = road(*winding_centreline(rng, (-20, 3), 0.3, 150, 60))
    points = rng.uniform([-30, -40], [130, 60], (200, 2))
    at = locate([line], points)
    s = np.linspace(0, line.length, 20_000)
    centre, heading = line.at(s)
    away = points[:, None] - centre[None]
    nearest = np.hypot(away[..., 0], away[..., 1]).argmin(axis=1)
    row = np.arange(len(points))
    left = np.cos(heading[nearest]) * away[row, nearest, 1] - np.sin(heading[nearest]) * away[row, nearest, 0]
    inner = (nearest > 10) & (nearest < len(s) - 10) & (np.abs(left) < 25)  # beyond 25 m a bend's ways cross
    assert np.abs(at.s - s[nearest])[inner].max() < 0.5
    assert np.abs(at.d - left)[inner].max() < 0.05
    assert np.allclose(at.kerb_distance[inner], np.abs(left[inner]) - 3.0, atol=0.06)


def test_places_and_positions_are_inverse():
    line = road(*winding_centreline(np.random.default_rng(5), (0, 0), 1.0, 120, 80))
    s, d = np.linspace(3, 117, 60), np.linspace(-20, 20, 60)
    at = locate([line], line.at(s, d)[0])
    assert np.abs(at.s - s).max() < 0.12
    assert np.abs(at.d - d).max() < 0.05


def test_bends_are_no_tighter_than_their_radius():
    _, heading = winding_centreline(np.random.default_rng(1), (0, 0), 0.0, 2000, 90)
    assert np.abs(np.diff(heading)).max() <= 1 / 90 + 1e-9
    assert np.abs(heading).max() < np.pi * 0.7, "keeps to its direction"


def test_corners_between_roads_are_round():
    roads = [straight(), straight(60, np.pi / 2, (50.0, 0.0))]
    at = locate(roads, np.array([[53.0 + 1.4, 3.0 + 1.4], [50.0, 30.0], [20.0, 0.0], [53.1, 3.1]]))
    assert at.kerb_distance[0] < 0.1, "the kerb's corner has a radius"
    assert at.kerb_distance[1] == pytest.approx(-3.0) and at.road[1] == 1
    assert at.kerb_distance[2] == pytest.approx(-3.0) and at.road[2] == 0
    assert at.kerb_distance[3] < 0


def test_a_bay_widens_one_side():
    line = straight(bays=(Bay(start=20, end=60, side=1, width=2.0),))
    assert line.kerb_offset(np.array([40.0, 40.0, 5.0]), np.array([1, -1, 1])).tolist() == [5.0, 3.0, 3.0]


def area(corners: np.ndarray) -> float:
    a, b = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    return float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def test_split_cuts_along_zero_and_loses_nothing():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (500, 3, 3))
    flip = np.array([area(one[None]) < 0 for one in corners])
    corners[flip] = corners[flip][:, ::-1]
    corners[:, :, 2] = corners[:, :, 0] * 0.7 + corners[:, :, 1] + 0.2  # a linear field
    negative, positive, cuts = split_triangles(corners, 2)
    assert negative[:, :, 2].max() <= 0 <= positive[:, :, 2].min()
    assert area(negative) + area(positive) == pytest.approx(area(corners))
    assert min(area(one[None]) for one in np.concatenate([negative, positive])) >= -1e-12, "no triangle turns over"
    assert np.abs(cuts[:, :, 0] * 0.7 + cuts[:, :, 1] + 0.2).max() < 1e-9
    run = cuts[:, 1, :2] - cuts[:, 0, :2]
    assert (run[:, 0] * 1.0 - run[:, 1] * 0.7 >= -1e-12).all(), "the positive side lies on the left"


def test_terrain_normals_are_those_of_its_heights():
    land = Terrain.random(np.random.default_rng(3), 0.05)
    xy, step = np.random.default_rng(4).uniform(-200, 200, (50, 2)), 1e-3
    slope = [
        (land.height(xy + d) - land.height(xy - d)) / (2 * step) for d in (np.array([step, 0]), np.array([0, step]))
    ]
    normal = land.normal(xy)
    assert np.allclose(-normal[:, :2] / normal[:, 2:], np.stack(slope, 1), atol=1e-6)
    assert np.abs(np.stack(slope)).max() > 0.005, "not flat"


def test_ground_covers_everything_once_and_steps_up_at_the_kerb():
    roads = (straight(bays=(Bay(start=20, end=60, side=1, width=2.0),)), straight(60, np.pi / 2, (50.0, 0.0)))
    land = Terrain(np.zeros((1, 4)))
    low, high = np.array([10.0, -20.0]), np.array([90.0, 30.0])
    town = Town(seed=0, name="residential", roads=roads, terrain=land, stretches=((), ()), junctions=())
    made = ground(town, low, high)
    corners = made.vertices[made.faces].astype(np.float64)
    inside = ((corners[:, :, :2] >= low - 1e-3) & (corners[:, :, :2] <= high + 1e-3)).all(axis=(1, 2))
    assert area(corners[inside]) == pytest.approx(80 * 50, rel=1e-4)
    faces = {
        name: inside & (made.object_type == OBJECT_TYPE_IDS[name])
        for name in ("road", "sidewalk", "parking", "terrain")
    }
    assert all(mask.any() for mask in faces.values())
    flat = made.normals[made.faces[:, 0], 2] > 0.5
    assert np.abs(corners[faces["road"]][:, :, 2]).max() < 1e-6
    assert np.allclose(corners[faces["sidewalk"] & flat][:, :, 2], 0.1, atol=1e-6)
    middle = corners.mean(axis=1)
    at = locate(roads, middle[:, :2])
    assert at.kerb_distance[faces["road"] & flat].max() < 0.05
    walk = at.kerb_distance[faces["sidewalk"] & flat]
    assert walk.min() > -0.2 and walk.max() < 2.2, "cells of a metre cut bevels short"
    upright = faces["sidewalk"] & ~flat
    towards = middle[upright, :2] + 0.3 * made.normals[made.faces[upright, 0], :2]
    assert (locate(roads, towards).kerb_distance < at.kerb_distance[upright]).mean() > 0.97, (
        "kerbs face the carriageway"
    )


@pytest.fixture(scope="module")
def worlds():
    pytest.importorskip("embreex")
    from lidar2pano.simulate.layout.street_world import build_world

    return {place: build_world(7, 1.0, place) for place in PLACES}


def test_nothing_stands_on_a_carriageway_that_should_not(worlds):
    rolling = {"car", "van", "truck", "trailer", "motorcycle"}
    for made in worlds.values():
        fixed = [thing for thing in made.objects if thing.template.name not in rolling]
        at = locate(made.town.roads, np.array([thing.position[:2] for thing in fixed]))
        median = np.abs(at.d) < made.town.roads[0].median
        assert ((at.kerb_distance > 0) | median).all()


def test_buildings_keep_clear_of_pavements_and_of_each_other(worlds):
    for made in worlds.values():
        houses = [t for t in made.objects if t.template.name in ("house", "terrace", "flats", "hall")]
        if len(houses) < 2:
            continue
        xy = np.array([thing.position[:2] for thing in houses])
        assert clear_of_roads(made.town.roads, xy, 1.0).all()
        assert min(np.hypot(*(a - b)) for a, b in itertools.combinations(xy, 2)) > 5


def test_every_place_has_what_belongs_there(worlds):
    names = {place: {thing.template.name for thing in made.objects} for place, made in worlds.items()}
    assert {"house", "car", "lamp", "tree"} <= names["residential"]
    assert {"flats", "sign"} <= names["avenue"]
    assert "guard rail" in names["motorway"]
    assert "house" not in names["motorway"] and "car" not in names["motorway"]


def test_a_centre_has_many_of_what_is_rare_elsewhere(worlds):
    from lidar2pano.simulate.layout.street_world import build_world

    names: dict[str, list[str]] = {}
    for place in ("centre", "avenue"):
        made = [worlds[place], build_world(8, 1.0, place), build_world(9, 1.0, place)]
        names[place] = [thing.template.name for one in made for thing in one.objects]
        names[place] += [actor.name.split()[0] for one in made for actor in one.traffic.actors]

    def count(place, *wanted):
        return sum(name in wanted for name in names[place])

    for wanted in (("truck", "trailer", "bus", "tram"), ("person", "walker"), ("bicyclist", "motorcyclist")):
        assert count("centre", *wanted) > 3 * count("avenue", *wanted) > 0
    assert count("centre", "car", "van") < 2 * count("avenue", "car", "van")


def test_only_a_requested_drive_is_in_a_centre():
    from lidar2pano.simulate.scene.random_streams import weighted_choice

    others = {name: place.share for name, place in PLACES.items() if name != "centre"}
    with_centre = {name: place.share for name, place in PLACES.items()}
    assert with_centre["centre"] == 0
    for seed in range(200):
        assert weighted_choice(stream(seed, "world"), with_centre) == weighted_choice(stream(seed, "world"), others)


def test_another_seed_is_another_town_and_the_same_is_the_same(worlds):
    from lidar2pano.simulate.layout.street_world import build_world

    first, again, other = worlds["avenue"], build_world(7, 1.0, "avenue"), build_world(8, 1.0, "avenue")
    assert [t.position for t in first.objects] == [t.position for t in again.objects]
    assert [t.position for t in first.objects] != [t.position for t in other.objects]


def test_drives_keep_right_and_are_smooth():
    for place in PLACES:
        speed = SpeedProfile.random(stream(3, "speed"), place)
        built = build_town(3, 60.0, place)
        drive = Drive.random(built, speed)
        assert drive.lane < 0 and any(way > 0 and lane == drive.lane for lane, way in lanes(built))
        time = np.arange(0, 5, 0.02)
        poses = drive.poses(time)
        assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-9)
        assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
        velocity = np.diff(poses[:, :3, 3], axis=0) / 0.02
        ahead = poses[:-1, :3, 0]
        pace = (velocity * ahead).sum(1)
        travelled = np.diff(speed.travelled(time)) / 0.02
        assert np.allclose(pace, travelled, rtol=0.1, atol=0.3)
        assert np.abs(np.diff(velocity, axis=0)).max() / 0.02 < 6, "no jerks (m/s^2)"
        height = poses[:, 2, 3] - built.terrain.height(poses[:, :2, 3])
        assert np.allclose(height, 1.73, atol=0.02)
        assert poses[0, 0, 3] == pytest.approx(built.roads[0].at(np.array(ROAD_MARGIN), drive.lane)[0][0], abs=0.3)


def test_quarters_are_named_everywhere():
    built = build_town(11, 80.0, "residential")
    s = np.linspace(0, built.roads[0].length, 200)
    assert set(built.land_use_ids(0, s, np.ones(200))) <= set(range(len(LAND_USES)))


def test_every_class_has_its_place():
    """Nineteen classes: those of the ground by what lies in the quarters, those of things by what can stand about."""
    from lidar2pano.simulate.layout.ground import OBJECT_TYPE_OF_COVER

    lands = {material for land_use in LAND_USES.values() for material in (land_use.near, land_use.far)}
    assert {OBJECT_TYPE_OF_COVER.get(material, "terrain") for material in lands} == {
        "terrain",
        "sidewalk",
        "other-ground",
    }
