"""Parts of supervised losses, each against its definition in numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.losses.painting import FRINGE, FRINGE_PX, HUE_PX, POOL, fringes, hue_gap, pooled
from lidar2pano.losses.supervised import class_weights


def test_class_weights_are_a_power_of_the_shares():
    weights = class_weights(np.array([50.0, 40.0, 10.0]), 0.5, least=1e-4, most=9.0)
    rare, common = 0.1**-0.5, 0.4**-0.5
    mean = (rare + common) / 2  # class 0 does not count in the mean
    assert weights.tolist() == pytest.approx([0.5**-0.5 / mean, common / mean, rare / mean])
    assert class_weights(np.array([1.0, 1.0, 2.0]), 0.0, least=1e-4, most=9.0).tolist() == [1, 1, 1]


def test_class_weights_are_bounded():
    weights = class_weights(np.array([0.0, 999.0, 1.0, 0.0]), 1.0, least=1e-2, most=1.25)
    shares = np.array([1e-2, 0.999, 1e-2, 1e-2])  # 0.001 and 0 count as 0.01
    expected = 1 / shares
    assert weights.tolist() == pytest.approx(np.minimum(expected / expected[1:].mean(), 1.25).tolist())
    assert weights.max() == 1.25


def test_pooling_takes_means_over_squares():
    image = torch.rand(3, 2 * POOL, 3 * POOL)
    found = pooled(image)
    assert found.shape == (3, 2, 3)
    assert found[1, 1, 2] == pytest.approx(image[1, POOL:, 2 * POOL :].mean().item(), rel=1e-5)


def test_fringes_are_as_defined():
    image = torch.rand(2, 3, 24, 20, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 2 - 1
    total, reach = 0.0, FRINGE_PX // 2
    red, green, blue = image.unbind(1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    for one in torch.stack([blue - luma, red - luma], 1):
        for row in range(24):
            for column in range(20):
                around = one[:, max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
                total += max(float((one[:, row, column] - around.mean((1, 2))).norm()) - FRINGE, 0)
    assert fringes(image).item() == pytest.approx(total / (2 * 24 * 20), rel=1e-5)


def test_grey_texture_and_even_colours_have_no_fringes():
    grey = torch.rand(1, 1, 40, 40, generator=torch.Generator().manual_seed(4)).expand(1, 3, 40, 40) * 2 - 1
    assert fringes(grey) == 0 and fringes(torch.tensor([1.0, -1, -1])[None, :, None, None].expand(1, 3, 40, 40)) == 0


def test_gaps_of_hue_are_as_defined():
    generator = torch.Generator().manual_seed(5)
    image, expected = torch.rand(2, 1, 3, 2 * HUE_PX, HUE_PX, generator=generator, dtype=torch.float64) * 2 - 1
    share = torch.rand(1, 1, 2 * HUE_PX, HUE_PX, generator=generator, dtype=torch.float64)
    gap, total = hue_gap(image, expected, share)
    assert gap.shape == (1, 3, 2, 1) and total.shape == (1, 1, 2, 1)
    lower = slice(HUE_PX, None)
    weight = share[0, 0, lower]
    colours = [float(((image - expected)[0, n, lower] * weight).sum() / weight.sum()) for n in range(3)]
    assert gap[0, :, 1, 0].tolist() == pytest.approx([colour - sum(colours) / 3 for colour in colours], abs=1e-9)
    assert total[0, 0, 1, 0].item() == pytest.approx(float(weight.mean()))
    assert hue_gap(expected + 0.3, expected, share)[0].abs().max() < 1e-9, "brighter, but of the same hue"
    assert not hue_gap(image, expected, 0 * share)[0].any()
    assert torch.equal(
        hue_gap(image[..., :2, :2], expected[..., :2, :2], share[..., :2, :2], 2)[1][0, 0, 0, 0],
        share[..., :2, :2].mean(),
    )
