"""Deviations of points from lines between their neighbours: walls are even and foliage is rough."""

from __future__ import annotations

import numpy as np
import torch

from lidar2pano.geometry import projection as module
from lidar2pano.geometry.projection import deviations, directions
from lidar2pano.scene.surfaces import slopes
from lidar2pano.views import View

ROWS, COLUMNS = 16, 96
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.2, down=-0.2, kind="cylinder")


def channels_of(radius_m: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """Channels (1, 5, H, W) of horizontal distances (H, W), measured where `measured` (H, W) says."""
    points = directions(VIEW) * (radius_m * torch.sqrt(1 + slopes(VIEW)[:, None].square()))[..., None]
    return torch.cat([points.norm(dim=2)[None], points.movedim(2, 0), radius_m[None]])[None] * measured


def scene(deviation_m: float = 0.2, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances of a wall askew in the first half of the columns, of foliage in the second, and the measured pixels."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = torch.linspace(0.5, -0.5, COLUMNS)
    radius_m = (8 / torch.cos(azimuth - 0.4)).expand(ROWS, COLUMNS).clone()
    rough = deviation_m * torch.randn(ROWS, COLUMNS // 2, generator=generator)
    radius_m[:, COLUMNS // 2 :] = 9 + rough
    measured = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    measured[4::3] = True
    measured[:, :: COLUMNS // 4] = False
    return radius_m, measured


def test_deviations_agree_with_their_definition():
    channels = channels_of(*scene())
    channels[..., 20:60] = 0  # columns without any point
    flat = torch.hypot(channels[0, 1], channels[0, 2]).double().numpy()
    total, count = np.zeros((ROWS, COLUMNS)), np.zeros((ROWS, COLUMNS))
    for row in range(ROWS):
        for column in range(COLUMNS):
            for step in module.NEIGHBOURS_PX:
                middle, left, right = (flat[row, at % COLUMNS] for at in (column, column - step, column + step))
                if middle and left and right:
                    off = abs((1 / left + 1 / right) / 2 - 1 / middle) * middle**2
                    total[row, column] += np.log(min(off + module.LEAST_DEVIATION_M, module.MOST_DEVIATION_M))
                    count[row, column] += 1
    sums, counts = deviations(channels)
    assert np.array_equal(counts[0], count) and np.allclose(sums[0], total, atol=1e-2)


def test_a_wall_is_even_however_it_stands_and_foliage_is_as_rough_as_it_is():
    total, count = deviations(channels_of(*scene()))
    wall, leaves = slice(16, COLUMNS // 2 - 16), slice(COLUMNS // 2 + 16, -16)
    means = [(total[..., part].sum() / count[..., part].sum()).exp() for part in (wall, leaves)]
    assert means[0] < 0.01 and 0.05 < means[1] < 0.3
