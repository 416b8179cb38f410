"""Viewpoints in a map: ranges against ray casting, axes, every form of file, blocks, and places that cannot be."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the extra 'formats' brings it")

from scipy.spatial import cKDTree

from lidar2pano.drives import viewpoints
from lidar2pano.drives.reading import ReadingOptions
from lidar2pano.drives.viewpoints import Place, Surroundings, parse_places, place_readings, scans_at, sensor_model
from lidar2pano.errors import InputError
from lidar2pano.formats import map_blocks
from lidar2pano.formats.image_files import write_text
from lidar2pano.formats.ply import write_ply
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.scan import Scan
from map_street import street_points, true_ranges, write_las
from miniature import street

EYE, SPACING_M = np.array([-4.0, 2.0, 1.8]), 0.2
ORIGIN = np.array([512_000.0, 5_403_000.0, 410.0])  # of a map in UTM


@pytest.fixture(scope="module")
def street_map(tmp_path_factory) -> Path:
    xyz, number = street_points(SPACING_M, noise_m=0.01)
    path = tmp_path_factory.mktemp("map") / "street.ply"
    write_ply(
        path, dict(zip("xyz", xyz.T.astype(np.float32), strict=True)) | {"intensity": (20 * number).astype(np.uint8)}
    )
    return path


@pytest.fixture(scope="module")
def seen(street_map) -> Scan:
    (scan,) = scans_at(street_map, Place(position_m=tuple(EYE)), "vlp16")
    return scan


def test_ranges_are_those_of_ray_casting(seen):
    """The lorry hides the street behind it and the facade its yard; few rays pass edges, none a wall."""
    range_m = np.linalg.norm(seen.xyz, axis=1)
    true_m = true_ranges(EYE, seen.xyz.astype(float) / range_m[:, None])
    error_m = np.abs(range_m - true_m)
    assert len(seen) > 20_000 and np.median(error_m) < 0.01 and np.percentile(error_m, 98) < SPACING_M
    assert np.mean(range_m > true_m + 1) < 2e-3


def test_a_ray_that_meets_something_has_a_point(seen):
    model = sensor_model("vlp16")
    rays = Surroundings(Place(position_m=tuple(EYE)), model).rays
    direction = rays.directions(*np.indices((16, model.firings)).reshape(2, -1))
    within = true_ranges(EYE, direction) < 30
    assert len(seen) > 0.99 * np.count_nonzero(within)
    assert np.array_equal(np.unique(seen.ring), np.unique(np.flatnonzero(within) // model.firings))


def test_the_heading_turns_the_scan_and_no_more(street_map, seen):
    """90 degrees: ahead is along the map's y axis, where the facade is 6 m away; left is against its x axis."""
    (turned,) = scans_at(street_map, Place(position_m=tuple(EYE), heading_deg=90), "vlp16")
    ahead = turned.xyz[np.abs(turned.xyz[:, 1]) < 0.3]
    assert np.median(ahead[ahead[:, 0] > 0, 0]) == pytest.approx(8 - EYE[1], abs=0.05)
    T = Place(position_m=(0, 0, 0), heading_deg=90).T_map_sensor
    np.testing.assert_allclose(T[:3, :3] @ (1, 0, 0), (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ (0, 1, 0), (-1, 0, 0), atol=1e-12)
    apart_m, _ = cKDTree(seen.xyz).query(turned.xyz @ T[:3, :3].T)
    assert np.percentile(apart_m, 99) < 0.1


def test_remission_is_that_of_the_surface_in_front(seen):
    """The lorry's rectangles have 100 to 180 of 255, the street's others less: of three surfaces the first one's."""
    range_m = np.linalg.norm(seen.xyz, axis=1)
    on_lorry = (np.abs(seen.xyz[:, 0] - 24) < 0.1) & (np.abs(seen.xyz[:, 1] + 2) < 2.5) & (seen.xyz[:, 2] > -1)
    assert on_lorry.sum() > 100 and np.median(seen.remission[on_lorry]) == pytest.approx(100 / 255, abs=0.02)
    assert range_m.max() < 100


def e57(path: Path, xyz: np.ndarray) -> None:
    """Two scans, each half of the points in the frame of its own scanner."""
    pye57 = pytest.importorskip("pye57", reason="the extra 'formats', where pye57 installs")
    file = pye57.E57(str(path), mode="w")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for half, shift in ((xyz[::2], (1.0, 2, 3)), (xyz[1::2], (-5.0, 0, 1))):
        own = (half - shift) @ turn  # T_world_scan is the turn, then the shift
        axes = {f"cartesian{axis}": own[:, column].copy() for column, axis in enumerate("XYZ")}
        file.write_scan_raw(axes, rotation=np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]), translation=np.array(shift))
    file.close()


def lines_of(xyz: np.ndarray) -> str:
    return "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in xyz)


def text_ply(path: Path, xyz: np.ndarray) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n" + "".join(f"property double {a}\n" for a in "xyz")
    write_text(path, head + "end_header\n" + lines_of(xyz), "--out")


def pcd(form: str, path: Path, xyz: np.ndarray) -> None:
    head = "VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
    head += f"WIDTH {len(xyz)}\nHEIGHT 1\nPOINTS {len(xyz)}\nDATA {form}\n"
    lines = lines_of(xyz).encode()
    path.write_bytes(head.encode() + (xyz.tobytes() if form == "binary" else lines))


FORMS = {
    "a.las": write_las,
    "a.laz": write_las,
    "a.e57": e57,
    "text.ply": text_ply,
    "binary.pcd": lambda path, xyz: pcd("binary", path, xyz),
    "text.pcd": lambda path, xyz: pcd("ascii", path, xyz),
    "a.npy": np.save,
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_gives_its_points_in_blocks(tmp_path, monkeypatch, name):
    xyz = np.round(np.random.default_rng(0).uniform(-40, 40, (3000, 3)) + ORIGIN, 3)
    FORMS[name](tmp_path / name, xyz)
    for module in (map_blocks, map_blocks.las, map_blocks.e57):
        monkeypatch.setattr(module, "BLOCK_POINTS", 500)
    monkeypatch.setattr(map_blocks.delimited_text, "BLOCK_BYTES", 20_000)
    clouds = list(map_blocks.map_blocks(tmp_path / name))
    assert len(clouds) >= (6 if name != "a.npy" else 1)
    points = np.concatenate([cloud.xyz for cloud in clouds])
    order, wanted = np.lexsort(points.T.round(3)), np.lexsort(xyz.T)
    np.testing.assert_allclose(points[order], xyz[wanted], atol=2e-3)
    near = map_blocks.NearBlocks(tmp_path / name, ORIGIN[None], 20.0)
    block = near.following()
    inside = np.linalg.norm(xyz - ORIGIN, axis=1) <= 20
    assert block and near.following() is None and len(block.xyz) == pytest.approx(inside.sum(), abs=2)
    np.testing.assert_allclose((block.low, block.high), (xyz.min(0), xyz.max(0)), atol=2e-3)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="elsewhere pye57 opens the map by its path")
def test_a_map_is_the_file_whose_xml_was_checked(tmp_path, monkeypatch):
    pye57 = pytest.importorskip("pye57", reason="the extra 'formats', where pye57 installs")
    xyz = np.random.default_rng(0).uniform(-40, 40, (300, 3))
    e57(path := tmp_path / "a.e57", xyz)
    opened = pye57.E57

    def replace_and_open(name: str) -> object:
        path.unlink()
        os.mkfifo(path)  # who opened this one would wait for ever
        descriptor = os.open(path, os.O_RDWR)  # fails the test instead
        try:
            return opened(name)
        finally:
            os.close(descriptor)

    monkeypatch.setattr(pye57, "E57", replace_and_open)
    assert sum(len(cloud.xyz) for cloud in map_blocks.map_blocks(path)) == 300


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.e57", "text.ply", "binary.pcd", "text.pcd"])
def test_a_map_cut_off_is_one_line(tmp_path, name):
    xyz = np.random.default_rng(0).uniform(-40, 40, (3000, 3))
    FORMS[name](tmp_path / name, xyz)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match=name.replace(".", r"\.")) as caught:
        list(map_blocks.map_blocks(tmp_path / name))
    assert "\n" not in str(caught.value)


def test_more_points_than_a_scan_has_are_read(tmp_path):
    """2**24 + 1 points of a sparse file, which no reader of scans takes; those in reach are none."""
    count = (1 << 24) + 1
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n" + "".join(
        f"property float {a}\n" for a in "xyz"
    )
    path = tmp_path / "long.ply"
    path.write_bytes(f"{head}end_header\n".encode())
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size + 12 * count)
    blocks, points = map_blocks.NearBlocks(path, np.full((1, 3), 500.0), 10.0), 0
    while (block := blocks.following()) is not None:
        points += block.points
        assert block.points <= map_blocks.READ_POINTS and not len(block.xyz)
    assert points == count


def test_points_that_are_held_do_not_grow_with_the_map(monkeypatch):
    """The same surfaces four times as dense where cells are full already: they bound what is kept."""
    monkeypatch.setattr(viewpoints, "MOST_HELD", 20_000)
    held = []
    for spacing_m in (0.06, 0.03):
        around = Surroundings(Place(position_m=tuple(EYE)), sensor_model("vlp16"))
        most = 0
        xyz, _ = street_points(spacing_m)
        for part in np.array_split(xyz, 40):
            around.add(map_blocks.Block(part, None, part.min(0), part.max(0), len(part)))
            most = max(most, sum(map(len, around._xyz)))
        held.append(most)
    assert held[1] < 1.7 * held[0] and held[1] < len(xyz) / 10


def write_places(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_places_of_an_option_and_of_files(tmp_path):
    assert parse_places("1,-2.5,3e1", 45) == [Place(position_m=(1, -2.5, 30), heading_deg=45)]
    plain = parse_places(write_places(tmp_path / "a.csv", "# metres\n1,2,3\n\n4, 5, 6, 90, gate\n"), 10)
    assert [(place.position_m, place.heading_deg, place.name) for place in plain] == [
        ((1, 2, 3), 10, ""),
        ((4, 5, 6), 90, "gate"),
    ]
    named = parse_places(write_places(tmp_path / "b.csv", "name;z;y;x\nold town;3;2;1\n"))
    assert named == [Place(position_m=(1, 2, 3), name="old town")]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1,2", "is not of the form X,Y,Z"),
        ("1,2,3,4", "is not of the form X,Y,Z"),
        ("1,2,nan", "finite numbers"),
        ("inf,2,3", "finite numbers"),
        ("here.csv", "nor a file with the columns"),
        ("", "is not of the form X,Y,Z"),
    ],
)
def test_places_that_are_none(text, reason):
    with pytest.raises(InputError, match=reason):
        parse_places(text)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "holds no places"),
        ("x,y,z\n", "holds no places"),
        ("lat,lon,height\n1,2,3\n", "its columns are lat, lon, height"),
        ("1,2\n", "place 1 is '1,2'"),
        ("x,y,z\n1,2,3\n1,b,3\n", "place 2 is '1,b,3'"),
        ("1,2,3,north\n", "the heading 'north' is no number"),
        ("1,2,3,0,a/b\n", "'a/b' names no file"),
        ("1,2,3,0,..\n", "'..' names no file"),
        ("1,2,3,0,a\n4,5,6,0,a\n", "two places are called 'a'"),
        ("1,2,3,0,a,b\n", "place 1 is"),
    ],
)
def test_files_of_places_that_are_none(tmp_path, content, reason):
    with pytest.raises(InputError, match=reason):
        parse_places(write_places(tmp_path / "a.csv", content))


def test_places_outside_and_out_of_reach_cost_themselves_alone(street_map):
    places = [
        Place(position_m=(500, 0, 1.8)),
        Place(position_m=(0, 0, 900)),
        Place(position_m=tuple(EYE), name="in the street"),
    ]
    outside, above, good = place_readings([street_map], places, "vlp16", ReadingOptions())
    assert "street.ply at 500,0,1.8: the place is outside of the map (x -60" in str(outside.error)
    assert "street.ply at 0,0,900: only 0 points of the map are in view" in str(above.error)
    assert good.error is None and good.scan is not None and good.source.stem == "in the street"
    assert [reading.source.stem for reading in (outside, above)] == ["street-000000", "street-000001"]
    assert good.interpretation and good.interpretation.ground_m == pytest.approx(1.8, abs=0.05)
    assert not good.interpretation.doubts


def test_a_single_sweep_is_no_map(tmp_path):
    write_bin(tmp_path / "a.bin", street(0, 20_000))
    with pytest.raises(InputError, match=r"a\.bin: is a single sweep, seen from its own place, and no map"):
        next(scans_at(tmp_path / "a.bin", Place(position_m=(0, 0, 0))))
    with pytest.raises(InputError, match="no sensor 'hdl65e'"):
        next(scans_at(tmp_path / "a.bin", Place(position_m=(0, 0, 0)), "hdl65e"))
    with pytest.raises(InputError, match="does not exist"):
        next(scans_at(tmp_path / "b.las", Place(position_m=(0, 0, 0))))
