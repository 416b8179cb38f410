"""Plants, buildings, street furniture and barriers: what every one of them promises."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest

from lidar2pano.simulate.assets import barriers, buildings, plants
from lidar2pano.simulate.assets import street_furniture as furniture
from lidar2pano.simulate.scene.mesh import Mesh, face_normals
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, OBJECT_TYPE_IDS, SIZE, masks, solid_at

Maker = Callable[[np.random.Generator], Mesh]


def slope(x: np.ndarray) -> np.ndarray:
    return 0.09 * x + 0.4 * np.sin(x / 7)


# name: maker, object types that it must have, its size at least and at most (along x, y, z), triangles at most
THINGS: dict[str, tuple[Maker, set[str], tuple[float, float, float], tuple[float, float, float], int]] = {
    "bush": (plants.bush, {"vegetation"}, (0.5, 0.5, 0.6), (4.5, 4.5, 3.4), 4500),
    "hedge": (lambda rng: plants.hedge(rng, 8, 1.6, 0.8), {"vegetation"}, (7.5, 0.6, 1.5), (8.8, 1.5, 2.4), 4000),
    "house": (lambda rng: buildings.house(rng, 12, 9), {"building"}, (9.5, 12.2, 5), (14, 15, 16), 4000),
    "narrow house": (lambda rng: buildings.house(rng, 8, 10), {"building"}, (10.2, 8.2, 5), (14, 12, 16), 4000),
    "flats": (lambda rng: buildings.flats(rng, 20, 12), {"building"}, (12, 20, 9), (17, 22, 32), 8000),
    "garage": (buildings.garage, {"building"}, (5.5, 2.9, 2.4), (7.5, 4, 5), 300),
    "shed": (buildings.shed, {"building"}, (2, 2.2, 2), (4, 4.8, 5), 300),
    "hall": (lambda rng: buildings.hall(rng, 30, 20), {"building"}, (20, 30, 4.4), (23, 31, 14), 1200),
    "lamp": (furniture.street_lamp, {"pole"}, (0.1, 0.1, 3.3), (3.5, 1.2, 10.2), 500),
    "pole": (furniture.pole, {"pole"}, (0.2, 1.4, 6.5), (1, 2, 10.2), 500),
    "traffic light": (furniture.traffic_light, {"pole", "traffic-light"}, (0.2, 0.2, 3), (1, 6, 6.5), 1500),
    "sign": (furniture.sign, {"pole", "traffic-sign"}, (0.05, 0.2, 1.2), (1, 1.5, 4.2), 700),
    "bollard": (furniture.bollard, {"pole"}, (0.08, 0.08, 0.4), (0.5, 0.5, 1.2), 400),
    "bin": (furniture.bin, {"other-object"}, (0.5, 0.4, 0.9), (1.4, 2.3, 1.2), 500),
    "bench": (furniture.bench, {"other-object"}, (0.3, 1.5, 0.4), (1, 2.1, 1.1), 300),
    "bus stop": (furniture.bus_stop, {"other-object", "pole", "traffic-sign"}, (1.5, 3, 2.4), (2.5, 6.5, 3.3), 800),
    "column": (furniture.advertising_column, {"other-object"}, (1, 1, 2.5), (1.7, 1.7, 4), 1200),
    "box": (furniture.junction_box, {"other-object"}, (0.3, 0.5, 0.8), (0.6, 1.8, 1.6), 200),
    **{
        f"tree {name}": (partial(plants.tree, name=name), {"vegetation", "trunk"}, (1, 1, 3), (19, 19, 24), 10000)
        for name in plants.SPECIES
    },
    **{
        f"sign {n}": (partial(furniture.sign, name=n), {"pole", "traffic-sign"}, (0, 0.3, 1), (1, 1.5, 4.2), 700)
        for n in furniture.SIGNS
    },
}  # fmt: skip

BARRIERS: dict[str, tuple[Callable[..., Mesh], str, float, float]] = {
    "picket fence": (barriers.picket_fence, "fence", 0.8, 1.3),
    "wire fence": (barriers.wire_fence, "fence", 0.9, 2.1),
    "railing": (barriers.railing, "fence", 0.85, 1.8),
    "wall": (barriers.wall, "wall", 0.6, 2.2),
    "guard rail": (barriers.guard_rail, "guard-rail", 0.7, 0.8),
    "noise barrier": (barriers.noise_barrier, "wall", 2.4, 4.6),
}
PIECES = {"wire fence": 2.5, "noise barrier": 4.0}  # metres from post to post, elsewhere 2
SEEDS = (1, 2, 3)


@cache
def made(name: str, seed: int) -> Mesh:
    return THINGS[name][0](stream(seed, name)) if name in THINGS else BARRIERS[name][0](stream(seed, name), 17.0, slope)


def of(mesh: Mesh, field: str, name: str) -> np.ndarray:
    ids = MATERIAL_IDS if field == "material" else OBJECT_TYPE_IDS
    return mesh.faces[getattr(mesh, field) == ids[name]]


@pytest.mark.parametrize("name", [*THINGS, *BARRIERS])
def test_arrays_are_sound(name: str) -> None:
    for seed in SEEDS:
        mesh = made(name, seed)
        for field in ("vertices", "normals", "uv", "tint"):
            assert np.isfinite(getattr(mesh, field)).all(), field
        assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3
        assert mesh.faces.max() < len(mesh.vertices)
        assert mesh.vertices.dtype == mesh.normals.dtype == mesh.uv.dtype == mesh.tint.dtype == np.float32
        assert (mesh.tint >= 0).all()
        # Except on leaves, which are lit as a whole crown, normals are on the side that faces outwards.
        hard = ~np.isin(mesh.object_type, [OBJECT_TYPE_IDS["vegetation"], OBJECT_TYPE_IDS["terrain"]])
        flat = face_normals(mesh.vertices, mesh.faces)
        side = (flat * mesh.normals[mesh.faces].mean(axis=1)).sum(axis=1)
        area = np.linalg.norm(flat, axis=1) > 0.5
        assert (side[hard & area] > 0).all()


@pytest.mark.parametrize("name", [*THINGS, *BARRIERS])
def test_same_seed_same_bytes_and_another_seed_another_thing(name: str) -> None:
    again = THINGS[name][0](stream(1, name)) if name in THINGS else BARRIERS[name][0](stream(1, name), 17.0, slope)
    first = made(name, 1)
    for field in ("vertices", "normals", "uv", "faces", "material", "object_type", "tint"):
        assert getattr(first, field).tobytes() == getattr(again, field).tobytes()
    other = made(name, 2)
    assert first.vertices.tobytes() + first.tint.tobytes() != other.vertices.tobytes() + other.tint.tobytes()


@pytest.mark.parametrize("name", THINGS)
def test_size_object_types_and_budget(name: str) -> None:
    _, object_types, least, most, budget = THINGS[name]
    for seed in SEEDS:
        mesh = made(name, seed)
        assert len(mesh) <= budget
        assert {
            object_type for object_type, number in OBJECT_TYPE_IDS.items() if number in mesh.object_type
        } >= object_types
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        size = np.array([*(high - low)[:2], high[2]])
        assert (size >= least).all() and (size <= most).all(), size
        assert -0.8 <= low[2] <= 0.05, "it floats, or is buried"
        assert (low[:2] < 0.1).all() and (high[:2] > -0.1).all(), "the origin is not in its footprint"


@pytest.mark.parametrize("name", ["house", "narrow house", "flats", "hall", "garage", "shed"])
def test_buildings_are_buildings_throughout(name: str) -> None:
    for seed in SEEDS:
        assert set(made(name, seed).object_type) == {OBJECT_TYPE_IDS["building"]}


@pytest.mark.parametrize(("name", "wide", "deep"), [("house", 12, 9), ("narrow house", 8, 10), ("flats", 20, 12)])
def test_panes_stay_in_their_walls_and_roofs_cover_the_footprint(name: str, wide: float, deep: float) -> None:
    for seed in range(1, 9):
        mesh = made(name, seed)
        panes = mesh.vertices[of(mesh, "material", "pane")]
        assert len(panes) >= 8
        reach = np.abs(panes).max(axis=(0, 1))
        assert reach[0] <= deep / 2 + 1.9 and reach[1] <= wide / 2 + 0.01  # 1.9: wings and glass balconies
        assert panes[..., 2].min() > 0.2
        # From above, every place of the footprint lies under a covering of the roof.
        tops = [of(mesh, "material", material) for material in ("tiles", "slate", "gravel")]
        triangles = mesh.vertices[np.concatenate(tops)]
        rng = np.random.default_rng(seed)
        places = rng.uniform(-1, 1, (200, 2)) * (deep / 2, wide / 2)
        assert covered(places, triangles).all()


def covered(places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether places (N, 2) lie under one of some triangles (F, 3, 3), seen from above."""
    a, b, c = (triangles[None, :, corner, :2] for corner in range(3))
    p = places[:, None]

    def side(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return (end - start)[..., 0] * (p - start)[..., 1] - (end - start)[..., 1] * (p - start)[..., 0]

    least, most = (pick([side(a, b), side(b, c), side(c, a)]) for pick in (np.minimum.reduce, np.maximum.reduce))
    return np.any((least >= -1e-4) | (most <= 1e-4), axis=-1)


def test_house_walls_have_no_gaps_but_their_openings() -> None:
    mesh = buildings.house(stream(4, "front"), 12, 9)
    front = mesh.vertices[of(mesh, "object_type", "building")]
    level = np.ptp(front[..., 0], axis=1) < 1e-4
    front = front[level & (front[:, 0, 0] > 4.2)][
        ..., [1, 2]
    ]  # upright faces near the plane of the front, and frames behind
    rng = np.random.default_rng(0)
    places = rng.uniform((-5.9, 0.05), (5.9, 2.6), (300, 2))
    assert covered(places, np.concatenate([front, np.zeros((*front.shape[:2], 1))], axis=2)).all()


def test_house_has_a_door_to_the_front() -> None:
    for seed in SEEDS:
        for name in ("house", "narrow house"):
            door = made(name, seed).vertices[of(made(name, seed), "material", "door")]
            assert len(door) and door[..., 0].min() > 3.5


@pytest.mark.parametrize("name", plants.SPECIES)
def test_far_trees_have_few_cards_and_as_wide_a_crown(name: str) -> None:
    near, far = plants.tree(stream(1, name), name), plants.tree(stream(1, name), name, 0.15)
    assert len(far) < 0.35 * len(near)
    tops = [mesh.vertices[:, 2].max() for mesh in (near, far)]
    assert tops[1] == pytest.approx(tops[0], rel=0.12)
    area = [cards(mesh) for mesh in (near, far)]
    assert 0.6 < area[1] / area[0] < 1.5


def cards(mesh: Mesh) -> float:
    corner = mesh.vertices[of(mesh, "object_type", "vegetation")]
    return float(np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2)


def test_leaf_cards_are_big_enough_and_lit_outwards() -> None:
    mesh = plants.tree(stream(1, "linden"), "linden")
    leaves = of(mesh, "material", "leaves")
    corner = mesh.vertices[leaves]
    side = np.linalg.norm(corner[:, 1] - corner[:, 0], axis=1)
    assert 0.35 < np.median(side) < 0.9
    middle = corner.mean(axis=1)
    heart = np.array([0, 0, np.median(middle[:, 2])])
    out = middle - heart
    assert ((mesh.normals[leaves[:, 0]] * out).sum(axis=1) > 0).mean() > 0.9
    assert mesh.uv[leaves][..., 1].min() >= 0 and mesh.uv[leaves][..., 1].max() <= 1


@pytest.mark.parametrize("material", ["leaves", "needles", "hedge"])
def test_a_leaf_card_holds_its_whole_spray_and_few_holes(material: str) -> None:
    step = (np.arange(-32, 288) + 0.5) / 256
    u, v = (part.ravel() for part in np.meshgrid(step, step))
    which = np.full(u.size, masks()[1][MATERIAL_IDS[material]])
    solid = solid_at(np.stack([u, v], 1), which)
    x, y = 2 * u - 1, 2 * v - 1
    inside = np.ones(u.size, dtype=bool)  # to the left of all four sides
    for (ax, ay), (bx, by) in zip(plants.KITE, np.roll(plants.KITE, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0
    once = (np.abs(x) <= 1) & (np.abs(y) <= 1)
    assert (solid & inside & once).sum() > 0.94 * (solid & once).sum()
    assert not (solid & inside & ~once).any()  # the mask repeats beyond its edge
    assert solid[inside].mean() > 0.5


def test_birch_has_white_bark_and_spruce_needles() -> None:
    assert len(of(plants.tree(stream(1), "birch"), "material", "bark-birch"))
    assert len(of(plants.tree(stream(1), "spruce"), "material", "needles"))


@pytest.mark.parametrize("name", furniture.SIGNS)
def test_signs_face_x(name: str) -> None:
    mesh = furniture.sign(stream(1, name), name)
    normals = face_normals(mesh.vertices, mesh.faces)
    plate, back = (mesh.material == MATERIAL_IDS[material] for material in ("sign", "sign-back"))
    assert normals[plate][0, 0] > 0.99
    assert normals[back][0, 0] < -0.99


def test_one_light_is_on() -> None:
    for seed in range(6):
        mesh = furniture.traffic_light(stream(seed, "light"))
        lens = mesh.vertices[
            mesh.faces[np.isin(mesh.material, [MATERIAL_IDS[f"light-{c}"] for c in ("red", "yellow", "green")])]
        ]
        assert len(lens) and lens[..., 2].min() > 2.0


@pytest.mark.parametrize("name", BARRIERS)
def test_barriers_follow_the_ground(name: str) -> None:
    _, object_type, least, most = BARRIERS[name]
    for seed in SEEDS:
        mesh = made(name, seed)
        assert OBJECT_TYPE_IDS[object_type] in mesh.object_type
        x, z = mesh.vertices[:, 0], mesh.vertices[:, 2]
        assert x.min() == pytest.approx(0, abs=0.2) and x.max() == pytest.approx(17, abs=0.2)
        high = []
        for place in np.linspace(0, 17, round(17 / PIECES.get(name, 2.0)) + 1):
            near = np.abs(x - place) < 0.3
            above = z[near] - slope(x[near])
            high.append(above.max())
            assert above.min() < 0.05, "it floats"
        assert least - 0.05 <= min(high) and max(high) <= most + 0.15
        assert max(high) - min(high) < 0.25


@pytest.mark.parametrize("name", BARRIERS)
def test_posts_stand_on_the_ground_within_5_cm(name: str) -> None:
    level, sloped = (BARRIERS[name][0](stream(5, name), 16.0, ground) for ground in (lambda x: 0 * x, slope))
    assert len(level.vertices) == len(sloped.vertices)
    lifted = sloped.vertices[:, 2] - level.vertices[:, 2]
    piece = 16.0 / round(16.0 / PIECES.get(name, 2.0))
    post = np.round(sloped.vertices[:, 0] / piece) * piece
    near = np.abs(sloped.vertices[:, 0] - post) < 0.2
    assert near.sum() > 10
    assert np.abs(lifted - slope(post))[near].max() < 0.05


def test_barriers_look_outwards() -> None:
    """A closed body has a positive volume where its faces run counter-clockwise from outside."""
    for name in ("wall", "noise barrier"):
        mesh = made(name, 1)
        a, b, c = (mesh.vertices[mesh.faces[:, corner]] - (8, 0, 1) for corner in range(3))
        assert (a * np.cross(b, c)).sum() / 6 > 1.0


def test_masks_are_half_open_and_closed_to_their_cards_rim() -> None:
    stack, index = masks()
    assert stack.shape[1:] == (SIZE, SIZE)
    for material in ("leaves", "needles"):
        mask = stack[index[MATERIAL_IDS[material]]]
        assert 0.25 < mask.mean() < 0.6
        assert not mask[:, [0, -1]].any() and not mask[-1].any(), "leaves are cut at the card's rim"
