"""The meanings of columns by their names."""

from __future__ import annotations

import numpy as np
import pytest

import sample_files as made
from lidar2pano.formats.arrays import cloud_of_arrays
from lidar2pano.formats.field_names import INTENSITY, INTENSITY_WORDS, find_named, has_axes, meanings

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
    "name", ["refl", "Intensit\u00e4t", "Signal Photons", "pcloud_attr.reflectance", "scalar_Intensity", "I"]
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
    cloud = cloud_of_arrays(arrays, format="NPZ", name="a", source="a")
    np.testing.assert_array_equal(cloud.xyz, XYZ[: len(cloud)])
    assert cloud.intensity is not None and len(cloud) >= 5000
    np.testing.assert_array_equal(cloud.intensity, FORMS[: len(cloud)])
