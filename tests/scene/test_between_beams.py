"""What is put between the beams of a sparse sensor: walls and roads lie there, and nothing where beams are dense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import RangeImage, directions, project
from lidar2pano.scan import Scan
from lidar2pano.scene import depth as module
from lidar2pano.scene.depth import between_beams
from lidar2pano.scene.surfaces import SAME_SURFACE
from lidar2pano.views import VIEWS, View

VIEW = View(rows=24, columns=60, up=6.0, down=-12.0)
FINE = View(rows=64, columns=512, up=10.0, down=-15.0)
HEIGHT_M = 1.7


def scan_of(view: View, range_m: torch.Tensor, measured: torch.Tensor) -> Scan:
    """The scan of a sensor that measures some pixels' centres (H, W) bool of a raster, at distances (H, W)."""
    points = (directions(view) * range_m[..., None])[measured]
    remission = torch.rand(view.rows, view.columns, generator=torch.Generator().manual_seed(3))[measured]
    return Scan(xyz=points.numpy(), remission=remission.numpy(), name="made up")


def street(view: View) -> torch.Tensor:
    """Distances (H, W) of a flat road between two walls."""
    x, y, z = directions(view).unbind(2)
    road = torch.where(z < 0, -HEIGHT_M / z, torch.inf)
    return torch.minimum(road, torch.where(y > 0, 6 / y, -9 / y)).clamp(max=60)


def beams(view: View, every: int, columns: int = 1) -> torch.Tensor:
    measured = torch.zeros(view.rows, view.columns, dtype=torch.bool)
    measured[1::every, ::columns] = True
    return measured


def along(inverse, remission, index):
    """One pass of the definition, column by column, in place."""
    there = index >= 0
    apart = []
    for column in there.T:
        rows = np.flatnonzero(column)
        apart += [b - a for a, b in zip(rows[:-1], rows[1:], strict=True) if b - a <= module.FAR_PX]
    mean = np.mean(apart) if apart else 1.0
    if mean < module.SPARSE:
        return
    for column in range(there.shape[1]):
        rows = np.flatnonzero(there[:, column])
        for a, b in zip(rows[:-1], rows[1:], strict=True):
            for row in range(a + 1, b) if b - a <= round(module.REACH * mean) else ():
                pair = inverse[[a, b], column]
                share = np.float32(row - a) / np.float32(b - a)
                if max(pair) >= SAME_SURFACE * min(pair):
                    share = float(share > 0.5)
                inverse[row, column] = pair[0] + share * (pair[1] - pair[0])
                remission[row, column] = remission[a, column] + share * (remission[b, column] - remission[a, column])
                index[row, column] = index[a if share <= 0.5 else b, column]


def slowly(image: RangeImage) -> list[tuple[int, int, float, float, int]]:
    """The definition: row, column, inverse distance, remission and neighbour of what is put between."""
    flat = np.hypot(image.channels[1].numpy(), image.channels[2].numpy())
    there = image.valid.numpy()
    inverse = np.where(there, 1 / np.where(there, flat, 1), 0).astype(np.float32)
    remission, index = image.channels[4].numpy().copy(), image.index.numpy().copy()
    spare = module.FAR_PX if image.view.circular else 0
    wide = [np.pad(part, ((0, 0), (spare, spare)), mode="wrap").T.copy() for part in (inverse, remission, index)]
    along(*wide)
    inverse, remission, index = (part.T[:, spare : spare + image.view.columns].copy() for part in wide)
    along(inverse, remission, index)
    rows, columns = np.nonzero((inverse > 0) & ~there)
    return [(r, c, inverse[r, c], remission[r, c], index[r, c]) for r, c in zip(rows, columns, strict=True)]


@pytest.mark.parametrize("view", [VIEW, replace(VIEW, left=80.0, right=-80.0), replace(VIEW, origin=(0.2, 0.1, 0.3))])
@pytest.mark.parametrize("share", [0.15, 0.3, 0.5, 0.9])
def test_is_its_definition(view, share):
    generator = torch.Generator().manual_seed(int(100 * share))
    measured = torch.rand(view.rows, view.columns, generator=generator) < share
    range_m = 10 * torch.rand(view.rows, view.columns, generator=generator).exp()
    image = project(scan_of(view, range_m, measured), view)
    found, expected = between_beams(image), slowly(image)
    if share > 0.7:
        assert found is None and not expected, "measured pixels are near each other"
        return
    assert len(found.xyz) == len(expected)
    rows, columns, inverse, remission, index = (np.array(part) for part in zip(*expected, strict=True))
    ray = directions(view).numpy()[rows, columns]
    away = 1 / (np.hypot(ray[:, 0], ray[:, 1]) * inverse)
    np.testing.assert_allclose(found.xyz.numpy(), ray * away[:, None] + view.origin, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.remission.numpy(), remission, rtol=1e-5, atol=1e-6)
    assert found.source.tolist() == index.tolist()


@pytest.mark.parametrize("every", [3, 4])
def test_walls_and_roads_go_on_between_beams(every):
    """Off a surface by centimetres at 20 m, but for the corners of walls and road."""
    range_m = street(FINE)
    image = project(scan_of(FINE, range_m, beams(FINE, every)), FINE)
    found = between_beams(image)
    assert len(found.xyz) > 0.9 * (every - 1) * len(image.usable)
    between = project(Scan(xyz=found.xyz.numpy(), remission=found.remission.numpy()), FINE)
    off = ((between.channels[0] - range_m).abs() / range_m)[between.valid & (range_m < 20)]
    assert off.median() < 0.002 and off.quantile(0.95) < 0.05


def test_columns_of_a_coarse_sensor_go_on_across_the_seam():
    image = project(scan_of(FINE, street(FINE), beams(FINE, 1, columns=2)), FINE)
    found = between_beams(image)
    between = project(Scan(xyz=found.xyz.numpy(), remission=found.remission.numpy()), FINE)
    assert between.valid[1:, 1::2].all() and not between.valid[:, ::2].any()


def test_a_gap_stays_a_gap():
    """Where several beams in a row have no echo, as through a window or in the sky, nothing is made up."""
    measured = beams(FINE, 2)
    measured[20:40, 100:140] = False
    found = between_beams(project(scan_of(FINE, street(FINE), measured), FINE))
    between = project(Scan(xyz=found.xyz.numpy(), remission=found.remission.numpy()), FINE)
    assert not between.valid[22:38, 100:140].any() and between.valid[22:38:2, :100].all()


def test_nothing_is_put_between_the_beams_of_the_sensor_that_the_raster_was_made_for():
    view = VIEWS["hdl64e"]
    measured = torch.rand(view.rows, view.columns, generator=torch.Generator().manual_seed(1)) < 0.8
    assert between_beams(project(scan_of(view, street(view), measured), view)) is None
