"""What a cloud's numbers mean is found out; what needs no change is not changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano.cli import main
from lidar2pano.cli.inspect import described
from lidar2pano.errors import InputError
from lidar2pano.formats import sensor_placement
from lidar2pano.formats.beams import Beams, find_beams, horizontal_centre, sharpest_origin
from lidar2pano.formats.ground_plane import blind_radii, fit_ground
from lidar2pano.formats.interpretation import STAND_IN, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud, cloud_of_columns
from lidar2pano.formats.readers import interpreted, read
from lidar2pano.formats.sensor_placement import LEVELLED, SENSOR_HEIGHT_M
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, columns_between

XYZ, RING = made.street()
FORMS = made.remission(len(XYZ))


def cloud(xyz: np.ndarray = XYZ, intensity: np.ndarray | None = FORMS, **more) -> PointCloud:
    return PointCloud(xyz=xyz, intensity=intensity, format="made up", fields=("x", "y", "z"), **more)


def turned(xyz: np.ndarray, degrees: float) -> np.ndarray:
    """Counter-clockwise."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, z = xyz.T.astype(np.float64)
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])


def test_a_sensors_cloud_keeps_its_numbers():
    scan, found = interpret(cloud())
    assert scan.xyz.tobytes() == XYZ.tobytes() and scan.remission.tobytes() == FORMS.tobytes()
    assert (found.forward, found.viewpoint_m, found.unit_m, found.gaps_deg) == ("x", (0, 0, 0), 1.0, ())
    assert found.ground_m == pytest.approx(1.8, abs=0.05) and found.tilt_deg < 0.3


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_a_scan_has_arrays_of_its_own(columns):
    """Clouds may be views of what they were read from, which a driver uses again for the next sweep."""
    buffer = np.random.default_rng(1).uniform(2, 9, (5000, columns)).astype(np.float32)
    scan = read(buffer)
    before = scan.xyz.copy(), scan.remission.copy()
    buffer[:] = 0
    assert np.array_equal(scan.xyz, before[0]) and np.array_equal(scan.remission, before[1])
    assert scan.xyz.flags.c_contiguous and scan.xyz.flags.writeable and scan.xyz.flags.owndata


def test_every_scan_of_kitti_keeps_its_numbers(kitti_mini: Path):
    for file in sorted(kitti_mini.glob("sequences/*/velodyne/*.bin"))[::8]:
        scan, found = interpreted(file)
        values = np.fromfile(file, "<f4").reshape(-1, 4)
        assert scan.xyz.tobytes() == np.ascontiguousarray(values[:, :3]).tobytes(), file
        assert scan.remission.tobytes() == np.ascontiguousarray(values[:, 3]).tobytes(), file
        assert not scan.gaps_deg and found.ground_m == pytest.approx(1.73, abs=0.35), file


# --- remission --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "scale", "full"),
    [
        (FORMS, "0-1", 1),
        (FORMS * 235, "0-255", 255),
        (np.floor(FORMS * 255).astype(np.uint8), "0-255", 255),
        (np.floor(FORMS * 1.9).astype(np.uint8), "0-255", 255),
        (np.floor(FORMS * 165).astype(np.uint16), "0-255", 255),
        (np.floor(FORMS * 65000).astype(np.uint16), "0-65535", 65535),
        (FORMS.astype(np.float16), "0-1", 1),
        (FORMS.astype(np.float64), "0-1", 1),
    ],
)
def test_scales_of_remission(values, scale, full):
    scan, found = interpret(cloud(intensity=values))
    assert (found.remission, found.remission_full) == (scale, full)
    np.testing.assert_allclose(scan.remission, values.astype(np.float64) / full, rtol=1e-6)
    assert scan.remission.dtype == np.float32


def test_counts_of_photons_and_negative_remissions_fill_the_scale():
    scan, found = interpret(cloud(intensity=np.floor(FORMS * 3000).astype(np.uint16)))
    assert found.remission == "0-99th percentile" and scan.remission.max() == 1 and np.mean(scan.remission == 1) < 0.02
    scan, found = interpret(cloud(intensity=FORMS * 4095 - 2048))
    assert found.remission == "min-max" and (scan.remission.min(), scan.remission.max()) == (0, 1)


@pytest.mark.parametrize("values", [None, np.zeros(len(XYZ)), np.full(len(XYZ), 7, np.uint8)])
def test_a_constant_stands_in_for_no_remission(values):
    scan, found = interpret(cloud(intensity=values))
    assert (found.remission, found.remission_full) == ("none", None)
    assert (scan.remission == np.float32(STAND_IN)).all()


def test_remission_can_be_overridden():
    scan, found = interpret(cloud(), Overrides(remission="none"))
    assert found.remission == "none" and (scan.remission == np.float32(STAND_IN)).all()
    scan, found = interpret(cloud(), Overrides(remission="255"))
    np.testing.assert_allclose(scan.remission, FORMS / 255, rtol=1e-6)


# --- axes, frames, units ----------------------------------------------------------------------------------------------


def test_y_forward_is_found_by_what_the_car_hides():
    scan, found = interpret(cloud(turned(XYZ, 90).astype(np.float32)))
    assert found.forward == "y" and "hides" in found.forward_by
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-4)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 0), ("y", 90), ("-x", 180), ("-y", -90)])
def test_forward_can_be_overridden(axis, degrees):
    scan, found = interpret(cloud(turned(XYZ, degrees)), Overrides(forward=axis))
    assert found.forward == axis and found.forward_by == "--forward"
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-4)


def test_a_vehicles_frame_is_left_for_the_sensors():
    mount = np.array([1.2, 0.0, 1.45])
    scan, found = interpret(cloud((XYZ + mount).astype(np.float16)))
    assert "vehicle's frame" in found.viewpoint_by
    np.testing.assert_allclose(found.viewpoint_m, mount, atol=0.1)
    assert found.ground_m == pytest.approx(1.8, abs=0.1)
    scan, found = interpret(cloud(XYZ + mount), Overrides(sensor_height_m=2.5))
    assert found.ground_m == pytest.approx(2.5, abs=0.05) and found.viewpoint_by == "--sensor-height"
    np.testing.assert_allclose(scan.xyz[:, 2].min(), -2.5, atol=0.05)


def test_what_is_assumed_of_a_merged_cloud_is_said(tmp_path, capsys, random_weights):
    """Two sensors in a vehicle's frame: no point of the vehicle is one from which the beams are sharp."""
    blur = np.random.default_rng(0).normal(0, 0.1, XYZ.shape)  # motion was compensated
    merged = np.concatenate([XYZ[::2] + (1.8, 0.4, 1.8), XYZ[1::2] + (-1.2, -0.5, 1.8)]) + blur
    _, found = interpret(cloud(merged))
    assert found.assumed_height_m == SENSOR_HEIGHT_M
    assert found.viewpoint_by.startswith("assumed 1.73 m above the ground")
    assert found.ground_m == pytest.approx(SENSOR_HEIGHT_M, abs=0.01)
    assert interpret(cloud(merged), None, found)[1].assumed_height_m == SENSOR_HEIGHT_M
    _, named = interpret(cloud(merged), Overrides(sensor_height_m=1.9))
    assert named.assumed_height_m is None and named.ground_m == pytest.approx(1.9, abs=0.01)
    assert interpret(cloud())[1].assumed_height_m is None
    np.save(tmp_path / "merged.npy", np.column_stack([merged, FORMS]).astype(np.float32))
    assert main(["inspect", str(tmp_path / "merged.npy")]) == 0
    assert "1.73 m below it (assumed; name the height with --sensor-height)" in capsys.readouterr().out
    options = [
        str(tmp_path / "merged.npy"),
        "--out",
        str(tmp_path),
        "--weights",
        str(random_weights),
        "--device",
        "cpu",
    ]
    assert main(["translate", *options]) == 0
    warning = "merged.npy: the sensor is assumed 1.73 m above the ground, since its place cannot be found"
    assert capsys.readouterr().err.count(warning) == 1
    assert main(["translate", *options, "--sensor-height", "1.9", "--json"]) == 0
    captured = capsys.readouterr()
    assert "is assumed" not in captured.err and '"assumed_height_m": null' in captured.out


def test_no_sensor_is_on_the_ground(monkeypatch):
    monkeypatch.setattr(sensor_placement, "sharpest_origin", lambda _, start: start - (0, 0, 1.5))
    _, found = interpret(cloud(XYZ + (1.2, 0.0, 1.45)))
    assert found.assumed_height_m == SENSOR_HEIGHT_M and found.ground_m == SENSOR_HEIGHT_M


def test_coordinates_with_an_offset_come_back():
    offset = np.array([455123.4, 5412987.6, 110.5])
    scan, found = interpret(cloud(XYZ.astype(np.float64) + offset))
    np.testing.assert_allclose(np.array(found.viewpoint_m) - offset, 0, atol=0.15)
    assert "offset" in found.viewpoint_by
    (doubt,) = found.doubts
    assert "its coordinates are a map's" in doubt and "--forward" in doubt
    assert not interpret(cloud(XYZ.astype(np.float64) + offset), Overrides(forward="x"))[1].doubts
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.2)


def test_millimetres_become_metres():
    scan, found = interpret(cloud((XYZ * 1000).astype(np.int32).astype(np.float64)))
    assert found.unit_m == 1e-3
    np.testing.assert_allclose(scan.xyz, XYZ, atol=0.002)


def test_no_returns_are_counted_and_moved_nowhere():
    holes = XYZ.astype(np.float64).copy()
    holes[::10], holes[5::10] = 0, np.nan
    scan, found = interpret(cloud(holes))
    assert found.no_returns == len(holes[::10]) + len(holes[5::10])
    assert (scan.xyz[::10] == 0).all() and np.isnan(scan.xyz[5::10]).all()
    scan, _ = interpret(cloud(holes), Overrides(forward="y"))
    assert np.isnan(scan.xyz[::10]).all() and len(scan) == len(XYZ)


def test_scans_of_one_stream_are_read_alike():
    first = interpret(cloud(turned(XYZ, 90).astype(np.float32)))[1]
    later = turned(XYZ, 135)  # neither the road nor the car's shadow lies along an axis
    assert interpret(cloud(later, made.remission(len(later))))[1].forward == "x"
    assert interpret(cloud(later, made.remission(len(later))), like=first)[1].forward == "y"
    another = replace(cloud(), format="another")
    assert interpret(another, like=first)[1].forward == "x"


# --- field of view, and what is no sweep ------------------------------------------------------------------------------


def test_the_field_of_view_is_what_has_points():
    azimuth = np.degrees(np.arctan2(XYZ[:, 1], XYZ[:, 0]))
    for inside, gaps in (
        (np.abs(azimuth) < 50, [(-50, -310)]),
        (np.abs(azimuth) > 60, [(60, -60)]),
        ((azimuth < 170) & (azimuth > -150) & (np.abs(azimuth) > 20), [(20, -20), (-150, -190)]),
    ):
        scan, found = interpret(cloud(XYZ[inside], FORMS[inside]))
        np.testing.assert_allclose(sorted(found.gaps_deg, reverse=True), gaps, atol=1.1)
        assert scan.gaps_deg == found.gaps_deg
        scan, found = interpret(cloud(XYZ[inside], FORMS[inside]), Overrides(invent=True))
        assert scan.gaps_deg == () and found.gaps_deg and found.invented


def test_columns_of_a_sector():
    view = replace(VIEWS["panorama"], rows=2, columns=8)  # centres at 157.5, 112.5, ... -157.5
    assert columns_between(view, 20, -70) == [4, 5]
    assert columns_between(view, -100, -260) == [0, 1, 6, 7]  # across the seam
    assert columns_between(view, 180, -180) == list(range(8))


def test_a_narrow_view_is_refused_unless_invented():
    narrow = np.abs(np.degrees(np.arctan2(XYZ[:, 1], XYZ[:, 0]))) < 25
    xyz, forms = np.repeat(XYZ[narrow], 3, 0), np.repeat(FORMS[narrow], 3)
    with pytest.raises(InputError, match=r"only 49 of 360 degrees hold points; --invent"):
        interpret(cloud(xyz, forms))
    assert interpret(cloud(xyz, forms), Overrides(invent=True))[0].gaps_deg == ()


def test_maps_and_airborne_scans_are_refused():
    generator = np.random.default_rng(0)
    flat = generator.uniform(-250, 250, (60_000, 2))
    roofs = np.where(np.floor(flat / 30).sum(1) % 3 == 0, 12.0, 0.0) - 1.7
    airborne = np.column_stack([flat, roofs])
    along = generator.uniform(-300, 300, 60_000)
    corridor = np.column_stack([along, generator.uniform(-8, 8, 60_000), generator.choice([-1.7, 0, 2, 5], 60_000)])
    for xyz in (airborne, airborne + [4e5, 5e6, 300], corridor, corridor + [300, 0, 0]):
        with pytest.raises(InputError, match="is no sweep of a LiDAR"):
            interpret(cloud(xyz, None))
    hall = XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True) * 40  # every wall as far: flat, but a sweep
    assert interpret(cloud(hall.astype(np.float32)))[1].unit_m == 1


@pytest.mark.parametrize("wrong", [{"forward": "z"}, {"remission": "100"}, {"sensor_height_m": -1.0}])
def test_overrides_that_are_none(wrong):
    with pytest.raises(InputError, match="--"):
        Overrides(**wrong)


def test_a_few_points_decide_nothing():
    few = np.array([[1e5, 0, 0], [0, 2000, 0]], np.float32)
    scan, found = interpret(cloud(few, np.zeros(2, np.float32)))
    assert (scan.xyz == few).all() and (scan.remission == 0).all() and found.gaps_deg == ()


# --- parts ------------------------------------------------------------------------------------------------------------


def test_the_ground_is_fitted():
    generator = np.random.default_rng(0)
    flat = generator.uniform(-20, 20, (5000, 2))
    slope = np.array([0.03, -0.02])
    z = flat @ slope - 1.6 + generator.normal(0, 0.02, 5000) + generator.choice([0, 0, 0, 1.5], 5000)
    ground = fit_ground(np.column_stack([flat, z]))
    assert ground is not None and ground.height_m == pytest.approx(-1.6, abs=0.06)
    np.testing.assert_allclose(ground.slope, slope, atol=0.01)
    assert fit_ground(generator.uniform(-20, 20, (5000, 3)) + [0, 0, 100]) is None


def test_what_the_car_hides():
    ground = fit_ground(XYZ.astype(np.float64))
    assert ground is not None
    along, across = blind_radii(XYZ.astype(np.float64), ground)
    assert along == pytest.approx((5.6, 5.6), abs=0.5) and across == pytest.approx((4.0, 4.0), abs=0.5)


def test_the_viewpoint_is_found_by_beams():
    there = np.array([0.4, -0.3, 0.2])
    moved = XYZ.astype(np.float64) + there
    standing = moved[XYZ[:, 2] > -1.5]
    np.testing.assert_allclose(sharpest_origin(standing, np.zeros(3)), there, atol=0.08)
    far = horizontal_centre(moved + [1e5, -1e6, 0])[:2]
    np.testing.assert_allclose(far, there[:2] + [1e5, -1e6], atol=1.0)


def test_beams_are_found():
    elevations = np.linspace(10, -25, 32)
    shuffled = np.random.default_rng(0).permutation(len(XYZ))
    by_ring, by_order, by_peaks = find_beams(XYZ, RING), find_beams(XYZ), find_beams(XYZ[shuffled])
    assert by_ring and by_order and by_peaks
    assert (by_ring.found_by, by_order.found_by, by_peaks.found_by) == ("ring", "file order", "peaks")
    for beams in (by_ring, by_order, by_peaks):
        np.testing.assert_allclose(beams.elevations_deg, elevations, atol=0.05)
    assert (
        by_ring.sensor() == "" and find_beams(XYZ[:10]) is None and find_beams(XYZ, np.arange(len(XYZ)) // 19) is None
    )


def test_sensors_are_named_by_their_beams():
    xyz, ring = made.street(beams=16, lowest_deg=-15.0)
    assert find_beams(xyz, ring).sensor() == ""
    beams = find_beams(xyz, ring)
    assert beams is not None
    vlp16 = replace(beams, elevations_deg=tuple(np.linspace(15, -15, 16)))
    assert "Velodyne VLP-16" in vlp16.sensor()


def test_beams_begin_above_the_origin_and_away_from_x():
    """The lenses of KITTI's HDL-64E lie .2 m above the origin: near walls raise its beams by degrees."""
    elevations = np.linspace(10, -25, 32)
    quarter = XYZ[:, [1, 0, 2]] * (1, -1, 1)  # its beams start to the right
    for points in (XYZ + (0, 0, 0.2), XYZ[::-1] + (0, 0, 0.2), quarter.astype(np.float32)):
        beams = find_beams(points)
        assert beams is not None and beams.found_by == "file order"
        np.testing.assert_allclose(beams.elevations_deg, elevations, atol=0.05)
    swapped = np.random.default_rng(0).permutation(32)
    shuffled = np.concatenate([XYZ[ring == RING][np.argsort(XYZ[ring == RING][:, 2])] for ring in swapped])
    assert (beams := find_beams(shuffled)) is None or beams.found_by != "file order"


@pytest.mark.parametrize("turned", ["sensor", "points"])
def test_beams_of_a_tilted_scan_are_found(turned: str):
    """A tilted sensor's beams are cones about its own axis, those of points turned afterwards about the plumb line."""
    if turned == "points":
        xyz = XYZ @ np.array([[np.cos(0.14), 0, -np.sin(0.14)], [0, 1, 0], [np.sin(0.14), 0, np.cos(0.14)]])
    else:
        elevation, azimuth = np.radians(np.linspace(10, -25, 32))[:, None], np.radians(np.arange(0, 360, 0.5))[None]
        ray = np.stack(np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                                           np.sin(elevation)), -1).reshape(-1, 3)  # fmt: skip
        ground = 1.8 / np.maximum(-ray @ (0.14, 0, 1), 1e-9)
        xyz = ray * np.minimum(np.minimum(ground, 9 / np.maximum(np.abs(ray[:, 1]), 1e-9)), 60)[:, None]
    record = described(*interpret(cloud(xyz.astype(np.float32), None)))
    assert record["turn_by"] == LEVELLED
    np.testing.assert_allclose(record["elevations_deg"], np.linspace(10, -25, 32), atol=0.1)


def test_a_sensor_is_known_though_the_sky_and_the_vehicle_hide_its_outermost_beams():
    whole = Beams(
        elevations_deg=(15, 11, 8, 5, 3, *np.linspace(2, -6, 49), *range(-7, -15, -1), -19, -25), found_by="ring"
    )
    assert whole.sensor() == "Hesai Pandar64"
    assert replace(whole, elevations_deg=whole.elevations_deg[1:-1]).sensor() == "Hesai Pandar64"
    assert replace(whole, elevations_deg=whole.elevations_deg[5:-1]).sensor() == ""


def test_beams_of_real_drives_are_found(kitti_mini: Path):
    scans = sorted(kitti_mini.glob("sequences/*/velodyne/*.bin"))[::7]
    found = [find_beams(read(file).xyz) for file in scans]
    assert [(file, beams) for file, beams in zip(scans, found, strict=True) if beams is None] == []
    assert {(len(beams.elevations_deg), beams.sensor()) for beams in found if beams} == {(64, "Velodyne HDL-64E")}


def test_a_scan_takes_beams_and_times():
    scan = Scan(xyz=XYZ, remission=FORMS, ring=RING, time_s=np.zeros(len(XYZ)))
    assert scan.ring is RING
    with pytest.raises(ValueError, match=r"Scan.ring must be"):
        Scan(xyz=XYZ, remission=FORMS, ring=RING[:5])


# --- real files -------------------------------------------------------------------------------------------------------


def test_pandaset_has_y_forward(pandaset_mini: Path):
    for file in sorted(next(pandaset_mini.glob("sequences/*/velodyne")).iterdir())[:2]:
        _, found = interpreted(file)
        assert found.forward == "y" and "vehicle's frame" in found.viewpoint_by


@pytest.mark.parametrize("name", ["ambient", "near_ir", "NIR", "scalar_near_infrared"])
def test_near_infrared_light_is_found_by_its_names(name):
    generator = np.random.default_rng(1)
    columns = {axis: generator.uniform(2, 9, 50) for axis in "xyz"} | {name: np.arange(50, dtype=">u2")}
    scan, _ = interpret(cloud_of_columns(columns, format="test", name="a"))
    assert scan.near_infrared is not None and scan.near_infrared.dtype == np.float32
    assert scan.near_infrared.tolist() == list(range(50))
    odd = {**columns, name: np.where(np.arange(50) % 2, np.inf, 5.0)}
    scan, _ = interpret(cloud_of_columns(odd, format="test", name="a"))
    assert scan.near_infrared is not None and sorted(set(scan.near_infrared.tolist())) == [0, 5]


@pytest.mark.parametrize(("most", "said"), [(1, "0-1 (as it is)"), (255, "0-255 (255 becomes 1)")])
def test_inspect_says_how_remission_is_scaled(tmp_path, capsys, most, said):
    xyz, _ = made.street(columns=180)
    rows = np.column_stack([xyz, made.remission(len(xyz)) * most]).astype(np.float32)
    np.save(path := tmp_path / "a.npy", rows)
    assert main(["inspect", str(path)]) == 0
    assert f"remission  {said}" in capsys.readouterr().out
