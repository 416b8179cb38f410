"""Distances of textures: sorted by hand, blind to where things are, and lessened by following them."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.losses import texture_distance
from lidar2pano.losses.painting import BANDS, COLOURED, FEWEST, MOST_SORTED

SIZE = 128
LUMA = torch.tensor([0.299, 0.587, 0.114])[:, None, None]  # ITU-R BT.601


def speckle(seed: int, contrast: float = 1.0, size: int = 1, channels: int = 1) -> torch.Tensor:
    """(1, 3, SIZE, SIZE): noise of squares of `size` pixels, grey where of one channel."""
    noise = torch.rand(1, channels, SIZE // size, SIZE // size, generator=torch.Generator().manual_seed(seed)) - 0.5
    large = noise.repeat_interleave(size, 2).repeat_interleave(size, 3)
    return contrast * large.expand(1, 3, SIZE, SIZE)


def whole(label: int = 0) -> torch.Tensor:
    return torch.full((1, SIZE, SIZE), label)


def by_hand(real: torch.Tensor, painted: torch.Tensor, *chosen: torch.Tensor) -> float:
    """The distance of grey images in the pixels of one class, `chosen` in each, whose edges are multiples of 8."""
    distances = []
    for number in range(BANDS):
        size, values = 2**number, []
        for image, where in zip((real, painted), chosen, strict=True):
            luma, found = image[0, 0].double(), []
            for row in range(0, SIZE, size):
                for column in range(0, SIZE, size):
                    top, left = row // (2 * size) * 2 * size, column // (2 * size) * 2 * size
                    if where[row, column]:
                        around = luma[top : top + 2 * size, left : left + 2 * size].mean()
                        found.append(float(luma[row : row + size, column : column + size].mean() - around))
            values.append(sorted(found))
        expected, made = values
        picked = [expected[int((n + 0.5) / len(made) * len(expected))] for n in range(len(made))]
        gap = sum(abs(a - b) for a, b in zip(made, picked, strict=True)) / len(made)
        relative = gap / (sum(map(abs, expected)) / len(expected) + 1e-2)
        distances.append(relative if number < COLOURED else relative / 3)  # two bands of grey have no distance
    return sum(distances) / len(distances)


def test_the_distance_is_as_defined():
    real, painted = speckle(1, 0.8, 2), speckle(2, 0.3)
    labels, others = whole(-1), whole(-1)
    labels[:, 32:96, :96], others[:, :64] = 4, 4
    assert labels[labels > 0].numel() < others[others > 0].numel() <= MOST_SORTED
    expected = by_hand(real, painted, labels[0] == 4, others[0] == 4)
    assert texture_distance(real, painted, labels, others).item() == pytest.approx(expected, rel=1e-4)
    assert expected > 0.3


def test_where_things_are_does_not_matter_but_how_strong_they_are_does():
    real = speckle(1, size=2)
    assert texture_distance(real, real.roll(16, 3), whole(), whole()) == 0
    near, far = (texture_distance(real, share * real.flip(2), whole(), whole()).item() for share in (0.8, 0.4))
    assert 0.05 < near < 0.5 * far


def test_fine_noise_of_colours_does_not_count():
    grey = speckle(1)
    fine, coarse = (speckle(2, 0.5, size, channels=3) for size in (1, 4))
    fine, coarse = (part - (part * LUMA).sum(1, keepdim=True) for part in (fine, coarse))  # leaves the luma
    without = texture_distance(grey, grey, whole(), whole())
    assert without == 0
    assert texture_distance(grey, grey + coarse, whole(), whole()) > 1
    alike = torch.nn.functional.avg_pool2d(fine, 4).repeat_interleave(4, 2).repeat_interleave(4, 3)
    assert texture_distance(grey, grey + fine - alike, whole(), whole()) < 1e-3


def test_classes_are_compared_with_themselves():
    labels = whole(3)
    labels[:, :, SIZE // 2 :] = 5
    real = torch.where(labels[:, None] == 3, speckle(1), 0.2 * speckle(2))
    assert texture_distance(real, real.flip(3), labels, labels.flip(2)) < 1e-6
    assert texture_distance(real, real.flip(3), labels, labels) > 0.5


def test_a_class_that_is_hardly_there_does_not_count():
    labels = whole(-1)
    labels[:, :4, :4] = 2
    assert labels.numel() > FEWEST > 16
    distance = texture_distance(speckle(1), 0.1 * speckle(2), labels, labels)
    assert distance == 0 and torch.equal(distance, texture_distance(speckle(1), speckle(2), whole(-1), whole()))


def test_what_follows_it_gets_its_contrast():
    real, painted = speckle(1, 0.8), (0.2 * speckle(2)).clone().requires_grad_()
    before = texture_distance(real, painted, whole(), whole())
    optimizer = torch.optim.Adam([painted], 0.02)
    for _ in range(150):
        optimizer.zero_grad()
        loss = texture_distance(real, painted, whole(), whole())
        loss.backward()
        optimizer.step()
    assert loss < 0.2 * before
    luma = (painted.detach() * LUMA).sum(1)
    assert luma.std().item() == pytest.approx(real.std().item(), rel=0.05)  # fine chroma is not compared
