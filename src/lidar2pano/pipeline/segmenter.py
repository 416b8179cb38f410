"""The first network of a pipeline: a scan's points get their classes on a range view, cleaned up by neighbours."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.projection import Normalisation, RangeImage, fitted_view, project
from lidar2pano.geometry.rasters import likeliest
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.models.card import Card
from lidar2pano.models.salsanext import STRIDE
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import denser
from lidar2pano.views import View

LABEL_BITS = 8
LAST_LABEL = (1 << LABEL_BITS) - 1
EMPTY = 0x7F800000 << 32  # the key of an empty pixel: infinite metres, class 0
HIGH = 1 if sys.byteorder == "little" else 0  # which half of an int64's two words is the high one


# Milioto et al. 2019 (RangeNet++), section III.D, as SalsaNext and TITAN-Net use it. The window wraps in azimuth on a
# circular view (published: zero padding), and a point whose neighbours are all cut off or unlabeled stays unlabeled
# (published: it becomes class 1).
def clean_up(
    image: RangeImage, ids: Tensor, *, neighbours: int = 5, search: int = 5, sigma: float = 1.0, cutoff_m: float = 1.0
) -> Tensor:
    """Label every point of the scan by a vote among the pixels around it.

    ids  (H, W) integer class ids on the image's raster, in [0, 255]; only valid pixels vote.
    Returns (N,) int64. Points out of view ask the pixels at the border that is nearest to them; points that could not
    be projected (NaN, Inf, zero range) are 0.
    """
    if search % 2 == 0 or neighbours < 1:
        raise ValueError(f"an odd search window and at least one neighbour are needed, got {search}, {neighbours}")
    view = image.view
    centre_row, centre_column = image.row.clamp(0, view.rows - 1), image.column.clamp(0, view.columns - 1)
    ranges = torch.where(image.valid, image.channels[0], torch.inf)
    labels = vote(
        ranges,
        ids.to(torch.int32),
        (centre_row, centre_column),
        image.range_m,
        own=image.inside,
        circular=view.circular,
        weights=inverse_gaussian(search, sigma),
        limits=(neighbours, cutoff_m),
    )
    return torch.where(image.usable, labels, 0)


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
    search = len(weights)
    table = _padded(_keys(ranges, ids), search // 2, circular)
    columns = table.shape[1]
    corner = centre[0] * columns + centre[1]
    windows = (search, search, table.numel() - (search - 1) * (columns + 1))  # of each pixel, without a copy
    keys = table.as_strided(windows, (columns, 1, 1))[:, :, corner].flatten(0, 1)
    distance = keys.view(torch.float32)[:, HIGH::2]  # the neighbours' ranges, in place
    distance.sub_(range_m).abs_().mul_(weights.to(distance).view(-1, 1))
    distance[weights.numel() // 2].masked_fill_(own, 0)
    return _most_named(_class_within(torch.stack(_least(keys, neighbours)), cutoff_m))


def _least(keys: Tensor, number: int) -> list[Tensor]:
    """Return the least `number` of keys (K, N), element by element, in any order.

    Groups are sorted, all at once, and merged: of two sorted lists the least are the smaller of the first of one and
    the last of the other, and so on.
    """
    if len(keys) <= number:
        return list(keys.unbind(0))
    groups = keys[: len(keys) // number * number].unflatten(0, (-1, number))
    least, *others = [list(group.unbind(0)) for group in torch.stack(_sorted(list(groups.unbind(1))), 1)]
    if rest := list(keys[groups.shape[0] * number :].unbind(0)):
        others.append(_sorted(rest))
    for place, group in enumerate(others):
        least = _sorted(least) if place else least
        kept = number - len(group)
        least = least[:kept] + [torch.minimum(*pair) for pair in zip(least[kept:], group[::-1], strict=True)]
    return least


def _sorted(keys: list[Tensor]) -> list[Tensor]:
    """Sort some keys, element by element, by a network of comparators (Knuth 1998, section 5.3.4)."""
    keys = list(keys)
    for first, second in _comparators(len(keys)):
        low, high = keys[first], keys[second]
        keys[first], keys[second] = torch.minimum(low, high), torch.maximum(low, high)
    return keys


def _comparators(number: int) -> list[tuple[int, int]]:
    """Return a sorting network: the shortest for five, else odd-even transposition."""
    if number == 5:
        return [(0, 3), (1, 4), (0, 2), (1, 3), (0, 1), (2, 4), (1, 2), (3, 4), (2, 3)]
    return [(first, first + 1) for step in range(number) for first in range(step % 2, number - 1, 2)]


def _keys(metres: Tensor, ids: Tensor) -> Tensor:
    """One int64 for both: the float's bits in the high half, so that keys order by metres first, the id in the low."""
    return (metres.contiguous().view(torch.int32).long() << 32) | ids


def _class_within(key: Tensor, cutoff_m: float) -> Tensor:
    """The ids (int32) of keys whose metres are within the cut-off, 0 for the others."""
    metres, ids = key.view(torch.float32)[:, HIGH::2], key.view(torch.int32)[:, 1 - HIGH :: 2]
    return ids * (metres <= cutoff_m)


def _padded(keys: Tensor, reach: int, circular: bool) -> Tensor:
    """The raster with `reach` pixels more on each side: empty ones, or those from across in a circular view."""
    rows, columns = keys.shape
    table = keys.new_full((rows + 2 * reach, columns + 2 * reach), EMPTY)
    inner = table[reach : reach + rows]
    inner[:, reach : reach + columns] = keys
    if circular:
        inner[:, :reach] = keys[:, columns - reach :]
        inner[:, reach + columns :] = keys[:, :reach]
    return table


def _most_named(labels: Tensor) -> Tensor:
    """Return the class (N,) that most of the labels (K, N) name, 0 not counted; of equals the one of the lowest id."""
    count = torch.zeros_like(labels)
    for label in labels.unbind(0):
        count += labels == label
    rank = (count << LABEL_BITS) | (LAST_LABEL - labels)
    best = (rank * (labels > 0)).amax(0)
    return (LAST_LABEL - (best & LAST_LABEL)).long() * (best > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmenter:
    """A range-view network with the view and normalisation it was trained on.

    network   (1, 5, H, W) -> (1, classes, H, W) logits.
    tallest   how far rows are added to the view for sensors that see more (fitted_view); None: none are.
    """

    network: nn.Module
    view: View
    normalise: Normalisation
    tallest: View | None = None

    @classmethod
    def from_card(cls, network: nn.Module, card: Card) -> Segmenter:
        """The segmenter that a weight file holds: `network, card = load(path)`."""
        normalise = validated(Normalisation, card.normalisation, "the card's normalisation")
        views = {role: validated(View, view, "the card's view") for role, view in card.views.items()}
        for view in views.values():
            if view.rows % STRIDE or view.columns < STRIDE:
                raise InputError(
                    f"the card's view of {view.rows} x {view.columns} pixels is no segmenter's: its rows must divide by"
                    f" {STRIDE}, and it has as many columns at least; fetch or make the file again"
                )
        return cls(network=network, view=views["input"], normalise=normalise, tallest=views.get("tallest input"))

    def at(self, view: View) -> Segmenter:
        """The segmenter on another view, whatever the scan."""
        return replace(self, view=view, tallest=None)

    def project(self, scan: Scan, device: str | torch.device = "cpu") -> RangeImage:
        """The range image that the network labels."""
        return project(scan, fitted_view(scan, self.view, self.tallest), device=device)

    @torch.inference_mode()
    def raster(self, image: RangeImage) -> Tensor:
        """Class ids (H, W) uint8 of a range image; raises InputError unless its rows divide by STRIDE."""
        x = self.normalise(image)[None]
        columns = x.shape[3]
        if spare := -columns % STRIDE:  # Pandar64's 1800 columns do not divide: go on beyond the seam, or empty
            beyond = x[..., :spare] if image.view.circular else x.new_zeros(*x.shape[:3], spare)
            x = torch.cat([x, beyond], dim=3)
        with fast_arithmetic(x.device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last))
        return likeliest(logits[..., :columns])[0]

    def label(self, image: RangeImage, timer: Timer) -> Tensor:
        """Class ids (N,) int64 of the points of a range image on `view`: the network, then the KNN clean-up."""
        with timer("segment"):
            ids = self.raster(image)
        with timer("clean_up"):
            return clean_up(image, ids)

    def points(self, scan: Scan, device: str | torch.device = "cpu") -> Tensor:
        """Class ids (N,) int64 of a scan's points."""
        _, image, _ = denser(scan, self.project(scan, device))
        return self.label(image, Timer(torch.device(device)))[: len(scan)]
