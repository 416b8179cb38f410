"""The scan itself decides where a sensor stands, what is up and what is forward; a file's claims are tried by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano.cli import main
from lidar2pano.drives.drive_motion import T_scan_cloud
from lidar2pano.formats import pcd
from lidar2pano.formats.ground_plane import fit_ground, fit_tilted_ground
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import interpreted
from lidar2pano.scan import Scan

XYZ, RING = made.street(beams=32, columns=720)
FORMS = made.remission(len(XYZ))


def rotation(axis: str, degrees: float) -> np.ndarray:
    """Counter-clockwise about an axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[[first, first, second, second], [first, second, first, second]] = cosine, -sine, sine, cosine
    return turn


def read(xyz: np.ndarray, like: Interpretation | None = None, **more) -> tuple[Scan, Interpretation]:
    whole = {"intensity": FORMS, "format": "made up", "fields": ("x", "y", "z")} | more
    return interpret(PointCloud(xyz=xyz.astype(np.float32), **whole), None, like)


# --- tilt -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("degrees", [-25, -10, 6, 15, 25])
def test_a_tilted_sensor_is_levelled_by_its_ground_and_said_so(axis, degrees):
    scan, found = read(XYZ @ rotation(axis, degrees).T)
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.6)  # 60 m away
    assert found.turn_by == "levelled by the ground" and found.tilt_deg == pytest.approx(0, abs=0.5)
    assert found.ground_m == pytest.approx(1.8, abs=0.05)
    assert f"tilted by {abs(degrees)} degrees; its points were levelled" in found.doubts[0]
    T = T_scan_cloud(found)
    np.testing.assert_allclose(scan.xyz, (XYZ @ rotation(axis, degrees).T) @ T[:3, :3].T + T[:3, 3], atol=1e-3)


def test_a_road_that_bends_is_no_tilt():
    scan, found = read(XYZ @ rotation("y", 3).T)
    assert scan.xyz.tobytes() == (XYZ @ rotation("y", 3).T).astype(np.float32).tobytes()
    assert not found.turn_by and not found.doubts


def test_no_plane_is_found_where_there_is_none():
    generator = np.random.default_rng(0)
    assert fit_tilted_ground(generator.normal(0, 10, (20_000, 3))) is None
    assert fit_tilted_ground(XYZ[:10].astype(np.float64)) is None


def test_inspect_shows_how_a_scan_was_turned(tmp_path, capsys):
    from lidar2pano.cli import main

    path = made.write(tmp_path, "a.bin", made.rows(XYZ @ rotation("y", 12).T, FORMS))
    assert main(["inspect", str(path)]) == 0
    assert "turned     levelled by the ground" in capsys.readouterr().out


# --- other axes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("turn", "says"),
    [
        (np.diag([1.0, -1, -1]), "z seems to point down"),
        (np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), "a camera's (z forward, y down)"),
        (np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), "y seems to point up"),
    ],
)
@pytest.mark.parametrize("pitch_deg", [0, 10])
def test_other_axes_are_turned_and_doubted(turn, says, pitch_deg):
    scan, found = read(XYZ @ (turn @ rotation("y", pitch_deg)).T)
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.6)
    assert says in found.doubts[0] and says in found.turn_by
    assert ("a left-handed frame stays mirrored" in found.doubts[0]) == (says == "y seems to point up")


# --- the viewpoint of a PCD -------------------------------------------------------------------------------------------


def pcd_of(xyz: np.ndarray, viewpoint: str) -> PointCloud:
    content = made.pcd(xyz.astype(np.float32), FORMS).replace(
        b"VIEWPOINT 0 0 0 1 0 0 0", f"VIEWPOINT {viewpoint}".encode()
    )
    return pcd.decode(content, Path("a.pcd"))


HALF = np.sqrt(0.5)
Y_UP = XYZ @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T  # x forward, y up, z right


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_viewpoint_turns_a_scan_that_is_plausible_only_so(sign):
    scan, found = interpret(pcd_of(Y_UP, f"0 0 0 {HALF} {sign * HALF} 0 0"))
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-4)
    assert found.turn_by == "the file's VIEWPOINT" and not [text for text in found.doubts if "ring" not in text]


def test_a_viewpoint_is_the_origin_if_the_beams_are_sharper_there():
    yaw = rotation("z", 40)
    half = np.radians(20)
    scan, found = interpret(pcd_of(XYZ @ yaw.T + (30, -12, 1), f"30 -12 1 {np.cos(half)} 0 0 {np.sin(half)}"))
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-3)
    assert found.viewpoint_m == (30, -12, 1) and found.viewpoint_by == "the file's VIEWPOINT"


def test_scans_of_a_stream_have_viewpoints_of_their_own():
    first = None
    for step in range(3):
        half = np.radians(10 + 45 * step)
        moved = XYZ @ rotation("z", 20 + 90 * step).T + (30 + 5 * step, -12, 1)
        cloud = pcd_of(moved, f"{30 + 5 * step} -12 1 {np.cos(half)} 0 0 {np.sin(half)}")
        scan, found = interpret(cloud, None, first)
        np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-3)
        first = first or found
        assert not [text for text in found.doubts if "rings" not in text]


@pytest.mark.parametrize("viewpoint", ["7 2 0.3 1 0 0 0", f"0 0 0 {HALF} {HALF} 0 0", "0 0 0 0.966 0 0.259 0"])
def test_a_viewpoint_that_does_not_fit_is_not_used_and_said_so(viewpoint):
    scan, found = interpret(pcd_of(XYZ, viewpoint))
    assert scan.xyz.tobytes() == XYZ.tobytes()
    assert (
        found.viewpoint_by == "the cloud's origin; the file's VIEWPOINT is not used: the scan is plausible without it"
    )


def test_a_viewpoint_far_away_is_the_origin_of_points_around_it():
    utm = np.array([500123.4, 5412345.6, 312.3])
    half, dtype = np.radians(20), [(axis, "<f8") for axis in "xyz"]
    header = f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH {len(XYZ)}\nHEIGHT 1\nVIEWPOINT "
    header += f"500123.4 5412345.6 312.3 {np.cos(half)} 0 0 {np.sin(half)}\nPOINTS {len(XYZ)}\nDATA binary\n"
    places = XYZ.astype(np.float64) @ rotation("z", 40).T + utm
    rows = np.array([tuple(place) for place in places.tolist()], dtype)
    scan, found = interpret(pcd.decode(header.encode() + rows.tobytes(), Path("a.pcd")))
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-3)
    assert found.viewpoint_by == "the file's VIEWPOINT"


def test_a_viewpoint_that_looks_back_is_doubted():
    scan, found = interpret(pcd_of(XYZ, "0 0 0 0 0 0 1"))
    assert scan.xyz.tobytes() == XYZ.tobytes()
    assert "VIEWPOINT turns it by 180 degrees, and is not used; nothing shows which end" in found.doubts[0]


@pytest.mark.parametrize("viewpoint", ["a b c", "0 0 0 0 0 0 0", "1 2", "nan 0 0 1 0 0 0"])
def test_a_viewpoint_that_is_none_condemns_nothing(viewpoint):
    assert pcd_of(XYZ, viewpoint).viewpoint is None


# --- forward ----------------------------------------------------------------------------------------------------------


def rows(tmp_path: Path, xyz: np.ndarray, ring: np.ndarray) -> tuple[Scan, Interpretation]:
    return interpreted(made.write(tmp_path, "a.bin", made.rows(xyz, np.floor(FORMS[: len(xyz)] * 255), ring)))


def test_five_columns_fix_no_forward_axis(tmp_path):
    scan, found = rows(tmp_path, XYZ, RING)
    assert found.format == "float32 rows, nuScenes" and found.forward == "x"
    assert len(found.doubts) == 1 and "which end is ahead, name it with --forward" in found.doubts[0]
    assert scan.xyz.tobytes() == XYZ.tobytes()
    scan, found = rows(tmp_path, XYZ @ rotation("z", 90).T, RING)
    assert found.forward == "y" and not found.doubts
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-4)


def test_a_forward_axis_that_nothing_shows_is_doubted(tmp_path):
    around = np.hypot(XYZ[:, 0], XYZ[:, 1])
    turned = around[:, None] * np.column_stack([np.cos(PLACE := np.arange(len(XYZ))), np.sin(PLACE)])  # no street
    _, found = rows(tmp_path, np.column_stack([turned, XYZ[:, 2]]), RING)
    assert found.forward == "y" and "name it with --forward" in found.doubts[0]


# --- rings ------------------------------------------------------------------------------------------------------------


def test_rings_that_contradict_the_elevations_are_not_believed():
    assert read(XYZ, ring=RING)[0].ring is RING
    scan, found = read(XYZ, ring=np.arange(len(XYZ)) % 32)
    assert scan.ring is None and found.doubts == (
        "its rings do not follow the elevations of its points; they are not used",
    )
    assert read(XYZ @ rotation("y", 15).T, ring=RING)[0].ring is RING
    lines = np.arange(len(XYZ)) % 4  # of a Livox
    assert read(XYZ, ring=np.random.default_rng(0).permutation(len(XYZ)) // 2)[0].ring is None, (
        "as many rings as points share much by chance"
    )
    assert read(XYZ, ring=lines)[0].ring is None and not read(XYZ, ring=lines)[1].doubts


# --- streams ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (XYZ * 1000, "its unit is not the first scan's"),
        (XYZ @ rotation("y", 12).T, "its ground is tilted by 12 degrees against the first scan's"),
        (XYZ * [1, -1, -1], "z seems to point down, unlike in the first scan"),
        (XYZ @ rotation("z", 90).T, "its forward axis is not the first scan's"),
    ],
)
def test_a_scan_that_contradicts_its_first_one_is_read_by_itself_and_doubted(changed, says):
    first = read(XYZ)[1]
    scan, found = read(changed, like=first)
    assert any(says in text and "read by itself" in text for text in found.doubts), found.doubts
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.6)
    assert not read(XYZ[::-1], like=first)[1].doubts


def test_scales_of_remission_that_differ_in_a_stream_are_said():
    first = read(XYZ)[1]
    assert "full remission" in read(XYZ, like=first, intensity=FORMS * 255)[1].doubts[0]


def test_centimetres_are_told_from_millimetres():
    scan, found = read(XYZ * 100)
    assert found.unit_m == 1e-2 and fit_ground(scan.xyz.astype(np.float64)) is not None
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.01)
    assert read(XYZ * 1000)[1].unit_m == 1e-3


@pytest.mark.parametrize("unit_m", [1e-6, 1e-5, 1e-4])
def test_small_units_are_told_by_the_height_above_the_ground(unit_m, tmp_path, capsys):
    path = made.write(tmp_path, "a.npy", made.npy((XYZ / unit_m).round().astype(np.int32)))
    scan, found = interpreted(path)
    assert found.unit_m == unit_m and not found.doubts
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-3)
    assert main(["inspect", str(path)]) == 0 and "illimetres" in capsys.readouterr().out.replace(
        "crometres", "llimetres"
    )


def test_feet_are_doubted():
    assert "if its unit is feet" in read(XYZ / 0.3048)[1].doubts[0]
    assert not read(XYZ)[1].doubts


def test_named_axes_hold_after_a_turn():
    tilted = PointCloud(xyz=(XYZ @ rotation("y", 12).T).astype(np.float32), intensity=FORMS, format="made up")
    scan, found = interpret(tilted, Overrides(forward="-x"))
    assert found.forward_by == "--forward"
    np.testing.assert_allclose(scan.xyz, XYZ * [-1, -1, 1], atol=0.6)


def test_inspect_reads_as_translate_would(tmp_path, capsys):
    path = made.write(tmp_path, "a.bin", made.rows(XYZ * [-1, -1, 1], np.floor(FORMS * 255), RING))
    assert main(["inspect", str(path), "--forward", "-x", "--remission", "none", "--sensor-height", "2"]) == 0
    out = capsys.readouterr().out
    assert "-x is forward (--forward)" in out and "remission  none" in out and "--sensor-height" in out
    assert main(["inspect", str(path), "--forward", "z"]) == 2


@pytest.mark.parametrize("aside", [1.2, -2.0])
@pytest.mark.parametrize("step", [1, 7])
def test_beams_that_come_from_beside_the_origin_are_doubted(aside, step):
    """Drivers move points to the vehicle's middle or axle; the ground's height does not show it."""
    (doubt,) = read(XYZ[::step] + (aside, 0, 0), intensity=None)[1].doubts
    assert doubt.startswith(f"its beams are far sharper from ({aside:.1f}, ")
    assert read(XYZ[::step], intensity=None)[1].doubts == ()
    assert read(XYZ[::step] + (0.2, 0, 0), intensity=None)[1].doubts == ()


def test_real_sensors_stand_at_their_origins(kitti_mini: Path):
    for file in sorted(kitti_mini.glob("sequences/*/velodyne/*.bin"))[::16]:
        assert not any("sharper" in doubt for doubt in interpreted(file)[1].doubts), file


def test_a_road_along_y_does_not_say_which_end_is_ahead():
    x, y, z = XYZ.T
    for turned in (np.column_stack([y, -x, z]), np.column_stack([-y, x, z])):
        found = read(turned)[1]
        assert found.forward == "y" and any("y, not x, is along the road" in doubt for doubt in found.doubts)
        cloud = PointCloud(xyz=turned.astype(np.float32), format="made up")
        assert interpret(cloud, Overrides(forward="-y"))[1].doubts == ()
