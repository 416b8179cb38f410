"""Losses of painted pictures beside adversarial ones: pooled colours, hues, streaks, textures, patches' statistics.

Patches  The Frechet distance as a loss. Between normal distributions the cheapest transport moves x to m2 + T (x - m1),
         where T = C1^-1/2 (C1^1/2 C2 C1^1/2)^1/2 C1^-1/2 (Dowson and Landau 1982; Olkin and Pukelsheim 1982), and its
         mean cost is the Frechet distance. Each painted patch is drawn to the transport's goal.
         Mathiasen and Hvilshoj (2020) differentiate the distance itself; with statistics over many batches
         (here moving averages) small batches will do.
Texture  Distributions of bands of frequency, class by class. In one dimension the cheapest transport pairs sorted
         values, whatever their places in the image. Karras et al. (2018) measure images by such
         distances of Laplacian bands; Heitz et al. (2021) learn texture by them.
Streaks  Lines along the rows of a picture, on even surfaces: streaks on a road, slats in a pane.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

PATCH, STRIDE = 8, 4  # of a patch, in pixels of the features' raster
KEPT = 0.99  # of the statistics, from one batch to the next
RIDGE = 1e-2  # of the mean variance, added to every painted one
MOST_STRETCH = 3.0  # largest factor of a deviation
EVERY, FIRST = 10, 40  # steps between two transports; step of the first
FRINGE_PX, FRINGE = 9, 0.3
POOL = 4  # pixels
HUE_PX = 16


def pooled(image: Tensor) -> Tensor:
    """Means over squares of POOL x POOL pixels of (B, C, H, W) or (C, H, W): colours without their fine texture."""
    return avg_pool2d(image, POOL)


def fringes(image: Tensor) -> Tensor:
    """Return the excess of hue differences of single pixels (B, 3, H, W) in [-1, 1] from their surroundings.

    The mean, over pixels, of how far their chroma (blue and red less luma, ITU-R BT.601) is from its mean over a square
    of FRINGE_PX x FRINGE_PX pixels, beyond FRINGE: 99 % of the pixels of KITTI's images are nearer.
    """
    chroma = _luma_and_chroma(image)[:, 1:]
    mean = avg_pool2d(chroma, FRINGE_PX, 1, FRINGE_PX // 2, count_include_pad=False)
    return ((chroma - mean).square().sum(1).add(1e-9).sqrt() - FRINGE).clamp(min=0).mean()


def _luma_and_chroma(image: Tensor) -> Tensor:
    """Luma (ITU-R BT.601), and blue and red less luma, of images (B, 3, H, W): (B, 3, H, W)."""
    red, green, blue = image.unbind(1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    return torch.stack([luma, blue - luma, red - luma], 1)


def hue_gap(image: Tensor, expected: Tensor, share: Tensor, size: int = HUE_PX) -> tuple[Tensor, Tensor]:
    """Return gaps of hues to expected ones, over squares of `size` x `size` pixels; a hue is a colour less its mean.

    image, expected  (B, 3, H, W) in [-1, 1];  share: (B, 1, H, W), how much each pixel counts.
    Returns (B, 3, H / size, W / size) and the mean shares (B, 1, H / size, W / size).
    """
    total = avg_pool2d(share, size)
    gap = avg_pool2d((image - expected) * share, size) / total.clamp(min=1e-3)
    return gap - gap.mean(1, keepdim=True), total


class PatchStatistics:
    """The loss; it remembers means and second moments of the features of patches, of each look.

    looks     their number;  channels: of the features at each depth.
    """

    def __init__(self, looks: int, channels: Sequence[int]) -> None:
        self.looks = [[DistributionLoss(size) for size in channels] for _ in range(looks)]

    def __call__(self, pairs: Sequence[tuple[Tensor, Tensor]], valid: Tensor, looks: Tensor) -> Tensor:
        """Mean squared distance of the painted patches from their goals, over the real ones' variance.

        pairs  real and painted features (B, C, h, w) per depth;  valid: (B, 1, H, W) 1 = known pixel.
        looks  (B,) int64. Only wholly known patches count. 0 without any, and until the statistics are known.
        """
        total, count = valid.new_zeros(()), 0
        for depth, (real, painted) in enumerate(pairs):
            if min(real.shape[-2:]) < PATCH:
                continue
            coverage = adaptive_avg_pool2d(valid, (real.shape[2], real.shape[3]))
            whole = avg_pool2d(coverage, PATCH, STRIDE)[:, 0] > 0.999
            real_patches, painted_patches = (avg_pool2d(part, PATCH, STRIDE).movedim(1, 3) for part in (real, painted))
            for look in looks.unique().tolist():
                chosen = whole & (looks == look)[:, None, None]
                if chosen.sum() >= 2:
                    total = total + self.looks[look][depth](real_patches[chosen], painted_patches[chosen])
                    count += 1
        return total / max(count, 1)


class Distribution:
    """Mean (D,) and covariance (D, D) of recent patches."""

    def __init__(self, size: int) -> None:
        self.weight, self.first, self.second = 0.0, torch.zeros(size), torch.zeros(size, size)

    def update(self, x: Tensor) -> None:
        """Count patches (P, D)."""
        x = x.detach().double()
        self.weight = KEPT * self.weight + len(x)
        share = len(x) / self.weight
        self.first = torch.lerp(self.first.to(x), x.mean(0), share)
        self.second = torch.lerp(self.second.to(x), x.T @ x / len(x), share)

    @property
    def covariance(self) -> Tensor:
        """(D, D) float64."""
        return self.second - torch.outer(self.first, self.first)


class DistributionLoss:
    """The loss of one group of patches at one depth; real and painted ones need neither be as many nor correspond.

    size  D of the features.
    """

    def __init__(self, size: int) -> None:
        self.real, self.painted, self.step = Distribution(size), Distribution(size), 0
        self.transport = torch.eye(size)

    def __call__(self, real: Tensor, painted: Tensor) -> Tensor:
        """Mean squared distance of painted patches (P, D) from their goals, over the variance of real ones.

        real      (R, D), R may be 0 after earlier ones.
        Returns 0 without painted ones, and until the statistics are known.
        """
        if len(real):
            self.real.update(real)
        if not len(painted):
            return painted.new_zeros(())
        self.painted.update(painted)
        self.step += bool(self.real.weight)
        if self.step < FIRST:
            return painted.new_zeros(())
        if self.step % EVERY == FIRST % EVERY:
            self.transport = transport(self.painted.covariance, self.real.covariance).to(painted)
        mean = self.painted.first.to(painted)
        goal = self.real.first.to(painted) + (painted.detach() - mean) @ self.transport
        variance = self.real.covariance.trace().to(painted)
        return (painted - goal).square().sum(1).mean() / variance.clamp(min=1e-6)


def transport(source: Tensor, target: Tensor) -> Tensor:
    """Return the matrix T (D, D) from a normal distribution of covariance `source` to one of covariance `target`.

    Variances of `source` have at least RIDGE of their mean, and deviations grow MOST_STRETCH times at most.
    """
    values, vectors = torch.linalg.eigh(source)
    values = values.clamp(min=0) + RIDGE * values.mean().clamp(min=1e-12)
    root, inverse = ((vectors * scale) @ vectors.T for scale in (values.sqrt(), values.rsqrt()))
    middle, axes = torch.linalg.eigh(root @ target @ root)
    linear = inverse @ ((axes * middle.clamp(min=0).sqrt()) @ axes.T) @ inverse
    scales, directions = torch.linalg.eigh((linear + linear.T) / 2)
    return (directions * scales.clamp(0, MOST_STRETCH)) @ directions.T


LENGTH_PX = 17  # of a mean along a row: free of texture, shorter than streaks
STEP_PX = 2  # distance of compared rows
NEARBY_PX = 9  # rows and columns around a painted line for one in the image
EVEN = 0.03  # remaining difference of means in [-1, 1] of mere texture


def streaks(painted: Tensor, image: Tensor, weight: Tensor) -> Tensor:
    """Return the difference of means along rows to those STEP_PX above, beyond the nearby one of an image, and EVEN.

    painted, image  (B, 3, H, W) in [-1, 1]; the mean over colours is compared.
    weight          (B, H, W) in [0, 1] of each pixel. Returns the mean, 0 if nothing counts.
    """
    made, expected = (_changes(part) for part in (painted, image))
    nearby = max_pool2d(expected, NEARBY_PX, 1, NEARBY_PX // 2)
    excess = (made - nearby - EVEN).clamp(min=0)[:, 0]
    share = weight[:, STEP_PX:]
    return (excess * share).sum() / share.sum().clamp(min=1)


def inside(share: Tensor, pixels: int) -> Tensor:
    """Return (B, H, W): 1 if all pixels up to so many rows and columns away have a share of more than a half, else 0.

    share  (B, H, W) in [0, 1]; beyond the edge of the picture nothing is known, and nothing said against.
    """
    outside = (share <= 0.5).to(torch.float32)[:, None]
    return 1 - max_pool2d(outside, 2 * pixels + 1, 1, pixels)[:, 0]


def _changes(image: Tensor) -> Tensor:
    """Return (B, 1, H - STEP_PX, W): distance of the mean along each row from that of the row STEP_PX above."""
    rows = avg_pool2d(image.mean(1, keepdim=True), (1, LENGTH_PX), 1, (0, LENGTH_PX // 2), count_include_pad=False)
    return (rows[:, :, STEP_PX:] - rows[:, :, :-STEP_PX]).abs()


BANDS = 3  # octaves, the finest first
COLOURED = 2  # first band with chroma: in finer ones a camera's is noise
MOST_SORTED = 16384  # sorted pixels: of more, evenly spaced ones
FEWEST = 300  # pixels of a class in a band of an image; fewer say nothing about its distribution


def texture_distance(real: Tensor, painted: Tensor, real_labels: Tensor, painted_labels: Tensor) -> Tensor:
    """Mean distance between the sorted values of bands of real and painted images, over the real ones' mean size.

    real, painted  (B, 3, H, W) in [-1, 1], H and W multiples of 2 ** BANDS.
    real_labels, painted_labels  (B, H, W) int64 class ids, negative for uncounted pixels; a class counts in an image
                   if both show enough of it, bands of luma (ITU-R BT.601) and, if coarse, blue and red less luma.
    Returns 0 if no class counts.
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
                expected, actual = (
                    _sorted(band[image, :layers, where])
                    for band, where in zip((real_band, painted_band), chosen, strict=True)
                )
                pixels = actual.shape[1]
                place = (torch.arange(pixels, device=actual.device) + 0.5) / pixels * expected.shape[1]
                gap = (actual - expected[:, place.long()]).abs().mean(1)
                distances.append((gap / (expected.abs().mean(1) + 1e-2)).mean())
    return torch.stack(distances).mean() if distances else painted.new_zeros(())


def _bands(image: Tensor) -> list[Tensor]:
    """BANDS of an image's luma, and blue and red less luma: (B, 3, H / 2 ** n, W / 2 ** n)."""
    levels = [_luma_and_chroma(image)]
    for _ in range(BANDS):
        levels.append(avg_pool2d(levels[-1], 2))
    return [fine - coarse.repeat_interleave(2, 2).repeat_interleave(2, 3) for fine, coarse in pairwise(levels)]


def _whole(labels: Tensor, number: int) -> Tensor:
    """Return labels of the squares of 2 ** number pixels of one class, -1 of the others."""
    size = 2**number
    squares = labels.unfold(1, size, size).unfold(2, size, size).flatten(3)
    return torch.where((squares == squares[..., :1]).all(3), squares[..., 0], -1)


def _sorted(values: Tensor) -> Tensor:
    """Values (N, P) in order; MOST_SORTED of them at most."""
    return values[:, :: -(-values.shape[1] // MOST_SORTED)].sort(1).values
