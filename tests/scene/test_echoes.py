"""Images of what a sensor measured."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import project
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import echo_image
from lidar2pano.views import VIEWS

VIEW = VIEWS["panorama"]


def cylinder_of(beams: int, columns: int = 1024, radius_m: float = 12.0) -> Scan:
    """Return the scan of a round room; remission grows from beam to beam, light from column to column."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-13.0, 12.0, beams)), np.linspace(-np.pi, np.pi, columns, endpoint=False), indexing="ij"
    )
    origin = np.array(VIEW.origin)
    xyz = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], -1) * radius_m + origin
    return Scan(
        xyz=xyz.reshape(-1, 3).astype(np.float32),
        remission=np.repeat(np.linspace(0.2, 0.8, beams, dtype=np.float32), columns),
        near_infrared=np.tile(np.arange(1, columns + 1, dtype=np.float32), beams),
    )


@pytest.mark.parametrize("beams", [16, 32, 64])
def test_a_wall_has_no_holes_between_beams(beams):
    scan = cylinder_of(beams)
    image = echo_image(scan, VIEW)
    elevation = np.degrees(np.arctan(VIEW.up - (np.arange(VIEW.rows) + 0.5) / VIEW.rows * (VIEW.up - VIEW.down)))
    inner = torch.from_numpy((elevation > -12.5) & (elevation < 11.5))
    assert (image.range_m[inner] > 0).float().mean() > 0.999
    wanted_m = 12.0 / np.cos(np.radians(elevation[inner]))
    assert image.range_m[inner].median(1).values.numpy() == pytest.approx(wanted_m, rel=0.02)
    wanted = np.interp(elevation[inner], np.linspace(-13, 12, beams), np.linspace(0.2, 0.8, beams))
    assert image.remission[inner].median(1).values.numpy() == pytest.approx(wanted, abs=0.6 / (beams - 1) + 0.02)
    assert not image.range_m[torch.from_numpy(elevation > 12.9)].any()
    light = image.near_infrared
    assert light is not None
    column = np.arange(VIEW.columns)
    expected = (np.pi - (column + 0.5) / VIEW.columns * 2 * np.pi + np.pi) / (2 * np.pi) * 1024 + 1
    away = torch.from_numpy(np.abs(light[200].numpy() - expected))
    assert away.minimum(1024 - away).max() < 8


def test_measured_pixels_stay_and_the_sky_is_empty():
    scan = cylinder_of(64)
    measured, image = project(scan, VIEW), echo_image(scan, VIEW)
    valid = measured.valid
    assert torch.equal(image.range_m[valid], measured.channels[0][valid])
    assert torch.equal(image.remission[valid], measured.channels[4][valid])
    far = Scan(xyz=scan.xyz[:2048], remission=scan.remission[:2048])  # two beams at the bottom
    assert not echo_image(far, VIEW).range_m[:300].any() and echo_image(far, VIEW).near_infrared is None
