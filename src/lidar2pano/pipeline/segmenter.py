"""The first network of a pipeline: a scan's points get their classes on a range view, cleaned up by neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import validated
from lidar2pano.geometry.projection import Normalisation, RangeImage, fitted_view, project
from lidar2pano.geometry.rasters import likeliest, pad_azimuth
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.models.card import Card
from lidar2pano.models.salsanext import STRIDE
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import denser
from lidar2pano.views import View

LABEL_BITS = 8
LAST_LABEL = (1 << LABEL_BITS) - 1
# Milioto et al. 2019 (RangeNet++), section III.D, as SalsaNext and TITAN-Net use it.
NEIGHBOURS, SEARCH_PX, SIGMA_PX, CUTOFF_M = 5, 5, 1.0, 1.0


# The window wraps in azimuth on a circular view (published: zero padding), and a point whose neighbours are all cut off
# or unlabeled stays unlabeled (published: it becomes class 1).
def clean_up(image: RangeImage, ids: Tensor) -> Tensor:
    """Label every point of the scan by a vote among the pixels around it.

    ids  (H, W) integer class ids on the image's raster, in [0, 255]; only valid pixels vote.
    Returns (N,) int64. Points out of view ask the pixels at the border that is nearest to them; points that could not
    be projected (NaN, Inf, zero range) are 0.
    """
    view = image.view
    centre = image.row.clamp(0, view.rows - 1), image.column.clamp(0, view.columns - 1)
    ranges = torch.where(image.valid, image.channels[0], torch.inf)
    labels = vote(ranges, ids, centre, image.range_m, own=image.inside, circular=view.circular)
    return torch.where(image.usable, labels, 0)


def inverse_gaussian() -> Tensor:
    """(SEARCH_PX, SEARCH_PX) float32: 1 - a Gaussian window of sum 1; it multiplies differences in range."""
    steps = torch.arange(SEARCH_PX, dtype=torch.float32) - (SEARCH_PX - 1) / 2
    window = torch.exp(-(steps[:, None] ** 2 + steps[None] ** 2) / (2 * SIGMA_PX**2))
    return 1 - window / window.sum()


def vote(
    ranges: Tensor, ids: Tensor, centre: tuple[Tensor, Tensor], range_m: Tensor, *, own: Tensor, circular: bool
) -> Tensor:
    """The vote itself: (N,) int64 ids for points at raster positions `centre` (rows, columns) with ranges `range_m`.

    ranges (H, W) float32, infinite where empty; ids (H, W) integer; own (N,) bool: the point is nearest to itself, so
    that its own pixel's class always votes.
    """
    reach = SEARCH_PX // 2
    metres, classes = _padded(ranges, reach, circular, torch.inf), _padded(ids.int(), reach, circular, 0)
    columns = metres.shape[1]
    steps = torch.arange(SEARCH_PX, device=ids.device)
    window = (steps[:, None] * columns + steps).flatten()
    place = window[:, None] + centre[0] * columns + centre[1]
    distance = metres.take(place).sub_(range_m).abs_().mul_(inverse_gaussian().to(metres).view(-1, 1))
    distance[len(window) // 2].masked_fill_(own, 0)
    keys = (distance.view(torch.int32).long() << 32) | classes.take(place)  # ordered by metres, then by class
    least = keys.topk(NEIGHBOURS, dim=0, largest=False, sorted=False).values
    near = (least >> 32).int().view(torch.float32) <= CUTOFF_M
    return _most_named((least & LAST_LABEL).int() * near)


def _padded(image: Tensor, reach: int, circular: bool, value: float) -> Tensor:
    """The raster (H, W) with `reach` pixels more on each side: of a value, or those from across in a circular view."""
    if circular:
        image = pad_azimuth(image[None, None], reach)[0, 0]
    sides = 0 if circular else reach
    return pad(image, (sides, sides, reach, reach), value=value)


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
