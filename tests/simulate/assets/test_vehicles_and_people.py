"""Vehicles and people of the street world: sizes, materials, symmetry, and outsides that are outside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lidar2pano.simulate.assets.motor_vehicles import BODIES, COLOURS, SHARES, bus, car, colour, trailer, tram, truck
from lidar2pano.simulate.assets.people import person
from lidar2pano.simulate.assets.two_wheelers import bicycle, bicyclist, motorcycle, motorcyclist
from lidar2pano.simulate.scene.mesh import Mesh, face_normals
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, OBJECT_TYPE_IDS

Maker = Callable[[np.random.Generator], Mesh]

# Length, width and height in metres, from and to: models on German roads, mirrors included.
SIZES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "hatchback": ((4.0, 4.4), (1.95, 2.15), (1.4, 1.56)),
    "saloon": ((4.5, 4.95), (1.95, 2.2), (1.38, 1.53)),
    "estate": ((4.5, 4.95), (1.95, 2.2), (1.4, 1.6)),
    "suv": ((4.3, 4.7), (1.95, 2.25), (1.6, 1.82)),
    "minivan": ((4.2, 4.65), (1.95, 2.2), (1.55, 1.78)),
    "small": ((3.4, 3.75), (1.8, 2.05), (1.4, 1.58)),
    "coupe": ((4.2, 4.65), (1.95, 2.2), (1.28, 1.46)),
    "cabriolet": ((4.1, 4.5), (1.95, 2.15), (1.3, 1.49)),
    "van": ((4.7, 5.15), (2.05, 2.3), (1.85, 2.08)),
    "truck": ((5.5, 16.5), (2.2, 3.15), (2.3, 4.05)),
    "trailer": ((2.9, 13.8), (1.4, 2.65), (0.8, 4.05)),
    "bus": ((11.8, 12.6), (2.5, 2.95), (2.9, 3.35)),
    "tram": ((28.5, 30.5), (2.3, 2.65), (4.5, 5.5)),
    "bicycle": ((1.65, 1.95), (0.45, 0.75), (0.95, 1.2)),
    "motorcycle": ((1.7, 2.3), (0.6, 1.0), (1.0, 1.4)),
    "bicyclist": ((1.65, 1.95), (0.5, 0.9), (1.55, 2.1)),
    "motorcyclist": ((1.7, 2.3), (0.6, 1.0), (1.45, 2.0)),
    "person": ((0.2, 1.1), (0.3, 0.8), (0.95, 2.1)),
    "walker": ((0.2, 1.1), (0.3, 0.8), (0.95, 2.1)),
}
MAKERS: dict[str, Maker] = {
    **{body: (lambda rng, body=body: car(rng, body)) for body in BODIES},
    **{"truck": truck, "trailer": trailer, "bus": bus, "tram": tram, "bicycle": bicycle, "motorcycle": motorcycle},
    **{"bicyclist": bicyclist, "motorcyclist": motorcyclist, "person": person, "walker": lambda rng: person(rng, 0.3)},
}
TWO_WHEELED = ("bicycle", "bicyclist", "motorcycle", "motorcyclist")
CAR_PARTS = {"paint", "window", "rubber", "rim", "underbody", "headlamp", "tail-lamp", "plate"}
SEEDS = range(4)


@pytest.fixture(scope="module")
def made() -> dict[str, list[Mesh]]:
    return {name: [make(stream(seed, name)) for seed in SEEDS] for name, make in MAKERS.items()}


def names(mesh: Mesh) -> tuple[set[str], set[str]]:
    """Materials and kinds that are there."""
    return (
        {name for name, index in MATERIAL_IDS.items() if index in mesh.material},
        {name for name, index in OBJECT_TYPE_IDS.items() if index in mesh.object_type},
    )


def same(one: Mesh, other: Mesh) -> bool:
    fields = ("vertices", "normals", "uv", "faces", "material", "object_type", "tint")
    return all(getattr(one, field).tobytes() == getattr(other, field).tobytes() for field in fields)


@pytest.mark.parametrize("name", MAKERS)
def test_meshes_are_sound(made, name):
    for mesh in made[name]:
        for values in (mesh.vertices, mesh.normals, mesh.uv, mesh.tint):
            assert values.dtype == np.float32
            assert np.isfinite(values).all()
        assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices)
        assert mesh.tint.min() >= 0


@pytest.mark.parametrize("name", MAKERS)
def test_sizes_are_real_and_things_stand_on_the_ground_around_their_middle(made, name):
    for mesh in made[name]:
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        for extent, (least, most) in zip(high - low, SIZES[name], strict=True):
            assert least <= extent <= most, (low, high)
        assert -0.02 <= low[2] <= 0.03
        assert np.abs(low + high)[:2].max() / 2 < (0.2 if name in ("person", "walker") else 0.1)


@pytest.mark.parametrize("name", MAKERS)
def test_a_seed_is_a_thing(made, name):
    assert same(MAKERS[name](stream(3, name)), made[name][3])
    assert not any(same(one, made[name][0]) for one in made[name][2:])


@pytest.mark.parametrize("name", MAKERS)
def test_normals_agree_with_their_faces(made, name):
    for mesh in made[name]:
        flat = face_normals(mesh.vertices, mesh.faces)
        agreeing = (mesh.normals[mesh.faces] * flat[:, None]).sum(2).mean(1) > 0
        assert agreeing[flat.any(1)].mean() > 0.99


@pytest.mark.parametrize("name", MAKERS)
def test_outer_faces_point_outwards(made, name):
    pytest.importorskip("embreex")
    from lidar2pano.simulate.scene.raycast import Scene, SceneObject

    mesh, rng = made[name][1], stream(0, "rays")
    middle, reach = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2, np.ptp(mesh.vertices, axis=0).max() + 2
    turn, rise = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0.0, 0.5, 4000)
    start = middle + reach * np.stack([np.cos(turn), np.sin(turn), rise], axis=1)
    way = middle + rng.uniform(-0.4, 0.4, (4000, 3)) * np.ptp(mesh.vertices, axis=0) - start
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    hits = Scene([SceneObject(mesh=mesh)]).cast(start, way)
    facing = (face_normals(mesh.vertices, mesh.faces)[hits.face[hits.valid]] * way[hits.valid]).sum(1) < 0
    assert len(facing) > 100
    assert facing.mean() > (0.92 if name in TWO_WHEELED else 0.98)  # spokes and mudguards have one side


@pytest.mark.parametrize("body", BODIES)
def test_cars_have_two_equal_sides(made, body):
    for mesh in made[body]:
        place = mesh.vertices
        left, right = (place[side * place[:, 1] > 1e-3] * (1, side, 1) for side in (1, -1))
        assert len(left) == len(right)
        sample = left[:: len(left) // 200]
        away = np.abs(sample[:, None] - right).max(2).min(1)
        assert away.max() < 1e-3  # metres


@pytest.mark.parametrize("body", BODIES)
def test_cars_are_cars_all_over_and_light(made, body):
    for mesh in made[body]:
        materials, object_types = names(mesh)
        assert object_types == {"car"}
        assert materials >= CAR_PARTS
        assert 1500 <= len(mesh) <= 4200
    glass = made[body][0].material == MATERIAL_IDS["window"]
    corners = made[body][0].vertices[made[body][0].faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert 1.2 < area[glass].sum() < 7.0  # square metres


def test_a_car_looks_along_x():
    mesh = car(stream(5, "ahead"))
    x = mesh.vertices[mesh.faces].mean(1)[:, 0]
    assert x[mesh.material == MATERIAL_IDS["headlamp"]].min() > 1.0
    assert x[mesh.material == MATERIAL_IDS["tail-lamp"]].max() < 0.0


def test_the_shares_of_colours_and_bodies_are_shares():
    assert sum(SHARES) == pytest.approx(1)
    assert sum(share for share, _ in COLOURS) == pytest.approx(1)
    bright = np.array([np.mean(colour(stream(i, "colour"))) for i in range(400)])
    assert 0.3 < (bright < 0.12).mean() < 0.6  # black, anthracite, dark blue
    assert bright.max() < 1.7


@pytest.mark.parametrize(
    ("make", "materials", "object_types"),
    [
        (truck, {"paint", "window", "rubber", "rim", "headlamp", "tail-lamp", "plate"}, {"truck"}),
        (trailer, {"rubber", "rim", "tail-lamp", "plate"}, {"trailer"}),
        (bus, {"paint", "window", "rubber", "rim", "headlamp", "tail-lamp", "plate"}, {"bus"}),
        (tram, {"paint", "window", "headlamp", "tail-lamp"}, {"tram"}),
        (bicycle, {"paint", "rubber", "rim", "metal"}, {"bicycle"}),
        (motorcycle, {"paint", "rubber", "rim", "headlamp", "tail-lamp", "plate"}, {"motorcycle"}),
        (bicyclist, {"paint", "rubber", "skin", "cloth"}, {"ridden-bicycle", "bicyclist"}),
        (motorcyclist, {"paint", "plastic", "cloth", "skin"}, {"ridden-motorcycle", "motorcyclist"}),
        (person, {"skin", "hair", "cloth", "rubber"}, {"person"}),
    ],
)
def test_materials_and_object_types(make, materials, object_types):
    for seed in SEEDS:
        there = names(make(stream(seed, "parts")))
        assert there[0] >= materials
        assert there[1] == object_types


def test_doors_of_a_bus_are_on_its_right():
    mesh = bus(stream(0, "doors"))
    corners = mesh.vertices[mesh.faces]
    low = (mesh.material == MATERIAL_IDS["window"]) & (corners[..., 2].min(1) < 0.6)
    assert low.any()
    assert corners[low][..., 1].max() < -1.2


def test_walkers_keep_their_looks_and_move_their_legs():
    still, steps = person(stream(4, "walk"), 0.0), [person(stream(4, "walk"), i / 8) for i in range(9)]
    for step in steps:
        assert (step.tint == still.tint).all()
        assert (step.material == still.material).all()
        assert -0.02 < step.vertices[:, 2].min() < 0.01
        assert abs(np.ptp(step.vertices[:, 2]) - np.ptp(still.vertices[:, 2])) < 0.12
    assert np.allclose(steps[8].vertices, still.vertices, atol=1e-4)
    assert np.ptp(steps[0].vertices[:, 0]) > np.ptp(steps[2].vertices[:, 0]) + 0.15  # heel down; feet side by side
    shoes = still.material == MATERIAL_IDS["rubber"]
    left = [step.vertices[step.faces[shoes]].mean(1) for step in steps]
    ahead = [feet[feet[:, 1] > 0][:, 0].mean() for feet in left]
    assert ahead[0] > 0.2 > -0.2 > ahead[4]


def test_people_differ_in_height_and_dress():
    crowd = [person(stream(i, "crowd")) for i in range(60)]
    heights = np.array([mesh.vertices[:, 2].max() for mesh in crowd])
    assert (heights < 1.52).sum() >= 2  # children
    assert (heights > 1.6).sum() >= 35
    assert len({mesh.tint.tobytes() for mesh in crowd}) == len(crowd)
    assert all(600 <= len(mesh) <= 2000 for mesh in crowd)
