"""The meanings of columns by their names."""

from __future__ import annotations

import numpy as np
import pytest

import sample_files as made
from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import cloud_of_arrays
from lidar2pano.formats.field_names import INTENSITY, INTENSITY_WORDS, find_named, has_axes, meanings
from lidar2pano.formats.point_cloud import cloud_of_columns
from lidar2pano.formats.readers import interpreted

XYZ, RING = made.street(beams=16)
FORMS = made.remission(len(XYZ))


@pytest.mark.parametrize("prefix", ["n", "normal_", "v", "vel_", "acc", "g", "Ori_", "angular_velocity."])
def test_other_vectors_are_no_places(prefix):
    assert not has_axes([f"{prefix}{axis}" for axis in "xyz"])
    assert [name for name, _ in meanings([f"{prefix}x", "lidar_x", f"{prefix}y", "lidar_y", "lidar_z", f"{prefix}z"])][
        1::2
    ] == ["x", "y", f"{prefix}z"]


def test_more_than_three_alike_are_no_axes():
    assert not has_axes(["scan_0", "scan_1", "scan_2", "scan_3"])


@pytest.mark.parametrize(
    "name",
    [
        "refl",
        "Inten-sity",
        "Intensit\u00e4t",
        "Signal Photons",
        "pcloud_attr.reflectance",
        "scalar_Intensity",
        "I",
        "\u53cd\u5c04\u7387",
        "\u5f3a\u5ea6(0-255)",
        "\u53cd\u5c04\u5f37\u5ea6",
        "\ubc18\uc0ac\uac15\ub3c4",
        "\u0418\u043d\u0442\u0435\u043d\u0441\u0438\u0432\u043d\u043e\u0441\u0442\u044c",
    ],  # fmt: skip
)
def test_names_of_remission(name):
    assert find_named(["x", "range", name, "vertical_angle"], INTENSITY, INTENSITY_WORDS) == [name]


@pytest.mark.parametrize(
    "arrays",
    [
        {"pcloud_points": XYZ, "pcloud_attr.reflectance": FORMS},  # A2D2
        {"points": XYZ, "refl": FORMS, "image": np.zeros((90, 120, 3), np.uint8)},
        {"": np.rec.fromarrays([XYZ, FORMS], dtype=[("xyz", "f4", 3), ("intensity", "f4")])},
        {"": np.column_stack([XYZ, FORMS]).ravel()},
        {"": np.moveaxis(np.column_stack([XYZ, FORMS])[:5000].reshape(50, 100, 4), 2, 0)},
        {"scan": np.column_stack([XYZ, FORMS]), "boxes": np.zeros((20_000, 7))},
        {"position_x": XYZ[:, 0], "position_y": XYZ[:, 1], "position_z": XYZ[:, 2], "remissions": FORMS},
    ],
)
def test_points_are_found_among_arrays(arrays):
    cloud = cloud_of_arrays(arrays, format="NPZ", name="a")
    np.testing.assert_array_equal(cloud.xyz, XYZ[: len(cloud)])
    assert cloud.intensity is not None and len(cloud) >= 5000
    np.testing.assert_array_equal(cloud.intensity, FORMS[: len(cloud)])


R_M = np.linalg.norm(XYZ.astype(np.float64), axis=1)
AZIMUTH, ELEVATION = np.arctan2(XYZ[:, 1], XYZ[:, 0]).astype(np.float64), np.arcsin(XYZ[:, 2] / R_M)
POLAR = {
    "radians": ("Range (m)", R_M, "Azimuth (rad)", AZIMUTH, "Elevation (rad)", ELEVATION),
    "degrees": ("distance", R_M, "azimuth", np.degrees(AZIMUTH) % 360, "vertical_angle", np.degrees(ELEVATION)),
    "hundredths": ("distance_mm", R_M * 1e3, "azimuth", np.degrees(AZIMUTH) % 360 * 100, "elev", np.degrees(ELEVATION)),
}


POLAR_FILES = [
    ("csv", "hundredths"),
    *((form, unit) for form in ("csv", "npz", "npy", "bin") for unit in list(POLAR)[:2]),
]


@pytest.mark.parametrize(("form", "unit"), POLAR_FILES)
def test_ranges_and_angles_are_places(tmp_path, form, unit):
    names, columns = POLAR[unit][::2], POLAR[unit][1::2]
    if form == "csv":
        lines = "".join(",".join(f"{value:.7f}" for value in row) + "\n" for row in zip(*columns, FORMS, strict=True))
        content = (",".join((*names, "intensity")) + "\n" + lines).encode()
    elif form == "npz":
        content = made.npz(**dict(zip((*names, "intensity"), (*columns, FORMS), strict=True)))
    else:
        table = np.column_stack([*columns, FORMS]).astype(np.float32)
        content = made.npy(table) if form == "npy" else table.tobytes()
    scan, found = interpreted(made.write(tmp_path, f"a.{form}", content))
    np.testing.assert_allclose(scan.xyz, XYZ, atol=2e-3)
    np.testing.assert_allclose(scan.remission, FORMS, atol=1e-3)
    assert any("azimuth is taken as counter-clockwise" in doubt for doubt in found.doubts)


def test_names_of_cloudcompare():
    columns = {
        "x": XYZ[:, 0],
        "y": XYZ[:, 1],
        "z": XYZ[:, 2],
        "Scalar_field": FORMS,
        "scalar_GpsTime": AZIMUTH / 60 + 9,
    }
    cloud = cloud_of_columns(columns, format="text", name="a")
    assert cloud.intensity is not None and (cloud.intensity == FORMS).all()
    assert cloud.time_s is not None and np.ptp(cloud.time_s) == pytest.approx(np.ptp(AZIMUTH) / 60, rel=1e-3)


def test_a_table_of_lists_is_named(tmp_path):
    from pyarrow import BufferOutputStream, parquet, table

    stream = BufferOutputStream()
    parquet.write_table(table({"[LiDARComponent].range_image_return1.values": [[1.0, 2.0]]}), stream)
    path = made.write(tmp_path, "a.parquet", stream.getvalue().to_pybytes())
    with pytest.raises(InputError, match="has no columns of numbers, one a point; write x, y, z"):
        interpreted(path)
