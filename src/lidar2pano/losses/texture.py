"""How far the texture of what is painted is from an image's: distributions of bands of frequency, class by class.

In one dimension the cheapest transport pairs sorted values, so that nothing has to be where the image has it. Karras et
al. (2018) measure images by such distances of Laplacian bands; Heitz et al. (2021) learn texture by them.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

BANDS = 3  # octaves, the finest first
COLOURED = 2  # the first band that has chroma: in finer ones a camera's is noise
MOST = 16384  # pixels that are sorted: of more, evenly spaced ones
FEWEST = 300  # pixels of a class in a band of an image; fewer say nothing about its distribution


def texture_distance(real: Tensor, painted: Tensor, real_labels: Tensor, painted_labels: Tensor) -> Tensor:
    """Mean distance between the sorted values of bands of real and painted images, over the real ones' mean size.

    real, painted  (B, 3, H, W) in [-1, 1], H and W multiples of 2 ** BANDS.
    real_labels, painted_labels  (B, H, W) int64 class ids, negative where nothing counts; a class counts in an image
                   where both show enough of it, bands of luma (ITU-R BT.601) and, if coarse, blue and red less luma.
    Returns 0 where no class counts.
    """
    distances = []
    for number, (real_band, painted_band) in enumerate(zip(_bands(real), _bands(painted), strict=True)):
        layers = 3 if number >= COLOURED else 1
        ids = [_whole(labels, number) for labels in (real_labels, painted_labels)]
        for image, pair in enumerate(zip(*ids, strict=True)):
            for label in pair[1].unique().tolist():
                chosen = [part == label for part in pair]
                if label < 0 or min(int(part.sum()) for part in chosen) < FEWEST:
                    continue
                expected, found = (
                    _sorted(band[image, :layers, where])
                    for band, where in zip((real_band, painted_band), chosen, strict=True)
                )
                at = (torch.arange(found.shape[1], device=found.device) + 0.5) / found.shape[1] * expected.shape[1]
                gap = (found - expected[:, at.long()]).abs().mean(1)
                distances.append((gap / (expected.abs().mean(1) + 1e-2)).mean())
    return torch.stack(distances).mean() if distances else painted.new_zeros(())


def _bands(image: Tensor) -> list[Tensor]:
    """BANDS of an image's luma, and blue and red less luma: (B, 3, H / 2 ** n, W / 2 ** n)."""
    red, green, blue = image.unbind(1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    levels = [torch.stack([luma, blue - luma, red - luma], 1)]
    for _ in range(BANDS):
        levels.append(avg_pool2d(levels[-1], 2))
    return [fine - coarse.repeat_interleave(2, 2).repeat_interleave(2, 3) for fine, coarse in pairwise(levels)]


def _whole(labels: Tensor, number: int) -> Tensor:
    """Labels of the squares of 2 ** number pixels that are of one class, -1 of the others."""
    size = 2**number
    squares = labels.unfold(1, size, size).unfold(2, size, size).flatten(3)
    return torch.where((squares == squares[..., :1]).all(3), squares[..., 0], -1)


def _sorted(values: Tensor) -> Tensor:
    """Values (N, P) in order; MOST of them at most."""
    return values[:, :: -(-values.shape[1] // MOST)].sort(1).values
