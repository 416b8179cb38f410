"""Composition of a panorama: real where a camera sees, invented elsewhere.

A pixel is looked up once, at its own depth. The sky, and what is too far for an echo, has no depth: a camera sees it in
its direction, as if it were infinitely far away. At 100 m, the reach of most LiDARs, the error is
baseline x focal_px / 100 m: 7 pixels for a camera 1 m beside the panorama's origin, none for one in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.rasters import pad_azimuth, upsample_azimuth
from lidar2pano.geometry.stitching import (
    BLACK,
    WHITE,
    Camera,
    Sight,
    hides_nothing,
    homogeneous,
    look,
    seam_weights,
)
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline.colour_transfer import brightened, light_gains
from lidar2pano.scene.surfaces import hides
from lidar2pano.views import View

# Brown and Lowe 2007, "Automatic Panoramic Image Stitching using Invariant Features", section 6: normalised errors of
# intensity and gain. A gain of light is one of coded values, too, whose curve is nearly a power.
INTENSITY_ERROR, GAIN_ERROR = 10.0, 0.1
COARSE_PX = 2  # every so many pixels of each row and column show how far an invention is off
CELL_PX = 4  # on a side of the finest cells of differences, and between the pixels compared for the gains
SMOOTH_PX = 16  # on a side of the cells of images' means, faded over their overlap; details change at its seam
SECTOR_PX = 16  # distance of the pixels tested for a camera's columns


def compose(panorama: Panorama, cameras: Sequence[Camera]) -> Panorama:
    """Return the panorama with the colours of cameras, in the frame of its scan, wherever they see.

    The cameras get a gain each; the invention takes their colours, class by class, and goes over into their pixels at
    its borders.
    """
    sights = sights_of(panorama, cameras)
    layers = [camera.colours(sight) for camera, sight in zip(cameras, sights, strict=True)]
    cameras = brought_together(cameras, sights, layers, panorama)
    layers = [layer * torch.tensor(camera.gain)[:, None] for camera, layer in zip(cameras, layers, strict=True)]
    shown, source = mixed(layers, sights, cameras, panorama.view)
    colour, classes = torch.from_numpy(panorama.colour), torch.from_numpy(panorama.segments)
    gains = light_gains(colour, classes, shown, source)
    offset = continued(shown, brightened(gains, *_coarse(colour, classes)), source > 0)
    hidden = (source == 0).flatten().nonzero()[:, 0]
    invented = brightened(gains, colour.flatten(0, 1)[hidden], classes.flatten()[hidden])
    shown.flatten(1)[:, hidden] = invented.T + offset.flatten(1)[:, hidden]
    return replace(
        panorama,
        colour=shown.round_().clamp_(0, 255).to(torch.uint8).movedim(0, 2).contiguous().numpy(),
        source=source.numpy(),
        cameras=tuple(cameras),
    )


def sights_of(panorama: Panorama, cameras: Sequence[Camera]) -> list[Sight]:
    """Return the pixels, numbered row by row, of a panorama in each camera's sight."""
    view, depth_m = panorama.view, torch.from_numpy(panorama.depth_m)
    ray, depth_m = directions(view), depth_m.where(depth_m > 0, torch.inf)
    sights: list[Sight] = []
    for camera in cameras:
        columns = _sector(camera, ray, depth_m, view)
        points = homogeneous(ray[:, columns], depth_m[:, columns], view.origin)
        sight = look(camera, points.flatten(1), view.focal_px, hides)
        pixel = (torch.arange(view.rows)[:, None] * view.columns + columns).flatten()
        sights.append(sight._replace(surface=pixel[sight.surface]))
    return sights


def _sector(camera: Camera, ray: Tensor, depth_m: Tensor, view: View) -> Tensor:
    """Return the numbers of the columns with something in a camera's image."""
    coarse = slice(SECTOR_PX // 2, None, SECTOR_PX)
    points = homogeneous(ray[coarse, coarse], depth_m[coarse, coarse], view.origin)
    sight = look(camera, points.flatten(1), view.focal_px / SECTOR_PX, hides_nothing)
    cells = torch.zeros(1, 1, 1, points.shape[2])
    cells[..., sight.surface % points.shape[2]] = 1
    wide = max_pool2d(pad_azimuth(cells, 1), (1, 3), 1) if view.circular else max_pool2d(cells, (1, 3), 1, (0, 1))
    return wide.flatten().repeat_interleave(SECTOR_PX).nonzero()[:, 0]


def brought_together(
    cameras: Sequence[Camera], sights: Sequence[Sight], layers: Sequence[Tensor], panorama: Panorama
) -> list[Camera]:
    """Return the cameras with gains per channel, for one exposure and white balance.

    Compared are the panorama's pixels in the sight of two cameras: one in CELL_PX of each row and column, and all with
    a point of the scan, whose place in the images is exact. Brown and Lowe 2007, equation 29.
    """
    count = len(cameras)
    sampled = np.zeros(panorama.depth_m.shape, dtype=bool) if panorama.measured is None else panorama.measured.copy()
    sampled[::CELL_PX, ::CELL_PX] = True
    sampled = torch.from_numpy(sampled).flatten()
    samples: list[tuple[np.ndarray, np.ndarray]] = []
    for sight, layer in zip(sights, layers, strict=True):
        kept = sampled[sight.surface]
        kept &= ((layer >= BLACK) & (layer <= WHITE)).all(0)
        samples.append((sight.surface[kept].numpy(), layer[:, kept].numpy().astype(np.float64)))
    matrix, right = np.zeros((3, count, count)), np.zeros((3, count))
    for i, j in combinations(range(count), 2):
        pixels, first, second = np.intersect1d(samples[i][0], samples[j][0], assume_unique=True, return_indices=True)
        if not len(pixels):
            continue
        for a, b, mean, partner in ((i, j, first, second), (j, i, second, first)):
            own, their = samples[a][1][:, mean].mean(1), samples[b][1][:, partner].mean(1)
            matrix[:, a, a] += len(pixels) * (2 * (own / INTENSITY_ERROR) ** 2 + GAIN_ERROR**-2)
            matrix[:, a, b] -= len(pixels) * 2 * own * their / INTENSITY_ERROR**2
            right[:, a] += len(pixels) * GAIN_ERROR**-2
    unpaired = matrix[0].diagonal() == 0
    matrix[:, unpaired, unpaired], right[:, unpaired] = 1, 1
    gains = np.linalg.solve(matrix, right[..., None])[..., 0].T
    return [replace(camera, gain=tuple(gain)) for camera, gain in zip(cameras, gains.tolist(), strict=True)]


def mixed(
    layers: Sequence[Tensor], sights: Sequence[Sight], cameras: Sequence[Camera], view: View
) -> tuple[Tensor, Tensor]:
    """Return what cameras show together, (3, H, W) float32, and each pixel's camera (H, W) uint8; zero where none sees.

    Cameras are numbered from 1; a pixel's is the one whose axis is nearest in angle. Two bands (Burt and Adelson 1983):
    details change at a seam, means of cells fade over the whole overlap.
    """
    size = view.rows * view.columns
    colour, source = torch.zeros(4, size), torch.zeros(size, dtype=torch.uint8)
    strongest = torch.zeros(size)
    across = -(-view.columns // SMOOTH_PX)
    cell = torch.arange(view.rows)[:, None] // SMOOTH_PX * across + torch.arange(view.columns) // SMOOTH_PX
    cell = cell.flatten()
    cells = [torch.zeros(4, int(cell[-1]) + 1) for _ in range(2)]
    weights = seam_weights(sights, size, view)
    for number, (layer, sight, weight) in enumerate(zip(layers, sights, weights, strict=True), 1):
        surface, counted = sight.surface, torch.cat([layer, torch.ones(1, len(weight))])
        colour.index_add_(1, surface, counted * weight)
        stronger = weight > strongest[surface]
        source[surface[stronger]] = number
        strongest[surface[stronger]] = weight[stronger]
        for sums, share in zip(cells, (weight, _inwards(cameras[number - 1], sight)), strict=True):
            sums.index_add_(1, cell[surface], counted * share)
    colour = (colour[:3] / colour[3].clamp(min=1e-9)).view(3, view.rows, view.columns)
    source = source.view(view.rows, view.columns)
    if len(cameras) > 1:
        narrow, wide = (sums[:3] / sums[3].clamp(min=1e-9) for sums in cells)
        faded = (wide - narrow).view(1, 3, -1, across)
        colour += upsample_azimuth(faded, SMOOTH_PX)[0, :, : view.rows, : view.columns] * (source > 0)
    return colour, source


def _inwards(camera: Camera, sight: Sight) -> Tensor:
    """Return weights (n,), falling to zero at the border of a camera's image."""
    width, height = camera.calibration.size
    row, column = sight.lookup.row / height, sight.lookup.column / width
    return (row * (1 - row) * column * (1 - column)).clamp(min=1e-6)


def _coarse(colour: Tensor, classes: Tensor) -> tuple[Tensor, Tensor]:
    """Return colours (n, 3) and classes (n,) of one in COARSE_PX pixels of each row and column."""
    every = slice(None, None, COARSE_PX)
    return colour[every, every].flatten(0, 1), classes[every, every].flatten()


def continued(shown: Tensor, invented: Tensor, mask: Tensor) -> Tensor:
    """Return differences of a mask's pixels from the invention, continued smoothly into all others: (3, H, W).

    shown     (3, H, W);  invented: (n, 3), of one in COARSE_PX pixels of each row and column;  mask: (H, W) bool.
    Means of ever larger cells, the finest of CELL_PX on a side, fill what is unknown in finer ones (pull and push,
    Gortler et al. 1996, section 3.5); cells without a known neighbour at any size have none.
    """
    if mask.shape[0] % CELL_PX or mask.shape[1] % CELL_PX:
        return torch.zeros_like(shown)
    every = slice(None, None, COARSE_PX)
    coarse, share = shown[:, every, every], mask[every, every].float()
    difference = coarse - invented.T.view_as(coarse)
    cells, share = _cell_means(difference[None], share[None, None], CELL_PX // COARSE_PX)
    return upsample_azimuth(_filled(cells, share), CELL_PX)[0]


def _cell_means(values: Tensor, share: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return means (1, C, h, w) of the known share of square cells, and the share (1, 1, h, w)."""
    total, share = avg_pool2d(values * share, side), avg_pool2d(share, side)
    return total / share.clamp(min=1e-9), share


def _filled(values: Tensor, share: Tensor) -> Tensor:
    """Fill the cells (1, C, h, w) without any known share from cells twice as large."""
    if values.shape[2] % 2 or values.shape[3] % 2:
        return values * (share > 0)
    larger = upsample_azimuth(_filled(*_cell_means(values, (share > 0).float(), 2)), 2)
    return torch.where(share > 0, values, larger)
