"""KNN clean-up: labels of a raster carried back to the points, by a vote of the neighbours in range.

Milioto et al. 2019 (RangeNet++), section III.D, as SalsaNext and TITAN-Net use it: 5 neighbours, 5 x 5 search,
sigma 1, cut-off 1 m. The window wraps in azimuth on a circular view (published: zero padding), and a point whose
neighbours are all cut off or unlabeled stays unlabeled (published: it becomes class 1).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.images import RangeImage

LABEL_BITS = 8
NOTHING = torch.iinfo(torch.int64).max


def clean_up(
    image: RangeImage, ids: Tensor, *, neighbours: int = 5, search: int = 5, sigma: float = 1.0, cutoff_m: float = 1.0
) -> Tensor:
    """Label every point of the scan by a vote among the pixels around it.

    ids  (H, W) integer class ids on the image's raster, in [0, 255]; only valid pixels vote.
    Returns (N,) int64. Points out of view ask the pixels at the border that they left through; points that could not
    be projected (NaN, Inf, zero range) are 0.
    """
    view = image.view
    centre_row, centre_column = image.row.clamp(0, view.rows - 1), image.column.clamp(0, view.columns - 1)
    ranges = torch.where(image.valid, image.channels[0], torch.inf)
    found = vote(
        ranges,
        ids.to(torch.int32),
        (centre_row, centre_column),
        image.range_m,
        own=image.inside,
        circular=view.circular,
        weights=inverse_gaussian(search, sigma).to(ranges.device),
        limits=(neighbours, cutoff_m),
    )
    return torch.where(image.usable, found, 0)


def inverse_gaussian(search: int, sigma: float) -> Tensor:
    """(search, search) float32: 1 - a Gaussian window of sum 1; it multiplies differences in range."""
    steps = torch.arange(search, dtype=torch.float32) - (search - 1) / 2
    window = torch.exp(-(steps[:, None] ** 2 + steps[None] ** 2) / (2 * sigma**2))
    return 1 - window / window.sum()


def vote(
    ranges: Tensor,
    ids: Tensor,
    centre: tuple[Tensor, Tensor],
    range_m: Tensor,
    *,
    own: Tensor,
    circular: bool,
    weights: Tensor,
    limits: tuple[int, float],
) -> Tensor:
    """The vote itself: (N,) int64 ids for points at raster positions `centre` (rows, columns) with ranges `range_m`.

    ranges (H, W) float32, infinite where empty; ids (H, W) int32; own (N,) bool: the point is nearest to itself, so
    that its own pixel's class always votes; limits: how many neighbours, and the cut-off in metres.
    """
    neighbours, cutoff_m = limits
    reach = len(weights) // 2
    width = ranges.shape[1] + 2 * reach
    ranges, ids = _padded(ranges, reach, circular, torch.inf), _padded(ids, reach, circular, 0)
    flat_ranges, flat_ids = ranges.flatten(), ids.flatten()
    corner = centre[0] * width + centre[1]
    nearest: list[Tensor] = []
    for offset, weight in enumerate(weights.flatten().tolist()):
        step = corner + (offset // len(weights)) * width + offset % len(weights)
        distance = (flat_ranges[step] - range_m).abs() * weight
        if offset == weights.numel() // 2:
            distance = torch.where(own, 0.0, distance)
        label = torch.where(distance <= cutoff_m, flat_ids[step], 0)
        key = (distance.view(torch.int32).long() << LABEL_BITS) | label
        for slot, held in enumerate(nearest):
            nearest[slot], key = torch.minimum(held, key), torch.maximum(held, key)
        if len(nearest) < neighbours:
            nearest.append(key)
    labels = [(key & ((1 << LABEL_BITS) - 1)).to(torch.int32) for key in nearest]
    return _most_named(labels)


def _padded(image: Tensor, reach: int, circular: bool, empty: float) -> Tensor:
    image = image[None, None]
    if circular:
        image = torch.cat([image[..., -reach:], image, image[..., :reach]], dim=3)
    else:
        image = pad(image, (reach, reach), value=empty)
    return pad(image, (0, 0, reach, reach), value=empty)[0, 0]


def _most_named(labels: list[Tensor]) -> Tensor:
    """The class that most of the labels (each (N,)) name, 0 not counted; of equals the one of the lowest id."""
    best = torch.zeros_like(labels[0])
    for label in labels:
        count = torch.zeros_like(label)
        for other in labels:
            count += other == label
        rank = (count << LABEL_BITS) | ((1 << LABEL_BITS) - 1 - label)
        best = torch.maximum(best, torch.where(label > 0, rank, 0))
    return torch.where(best > 0, ((1 << LABEL_BITS) - 1) - (best & ((1 << LABEL_BITS) - 1)), 0).long()
