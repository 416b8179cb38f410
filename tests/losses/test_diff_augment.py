"""DiffAugment that critics see pictures with, against their definition pixel by pixel."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from lidar2pano.losses.adversarial import DiffAugment

ROWS, COLUMNS = 16, 24


@pytest.fixture
def images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    colours = torch.rand(2, 3, ROWS, COLUMNS, generator=generator) * 2 - 1
    return colours, torch.rand(2, 4, ROWS, COLUMNS, generator=generator)


def augment(**given: tuple[float, float]) -> DiffAugment:
    """Parameters that are not given change nothing."""
    nothing = dict.fromkeys(("brightness", "down", "right"), torch.zeros(2))
    nothing |= dict.fromkeys(("saturation", "contrast"), torch.ones(2))
    nothing |= dict.fromkeys(("cut_row", "cut_column"), torch.full((2,), torch.nan))
    return DiffAugment(**nothing | {name: torch.tensor(values) for name, values in given.items()})


def test_without_augmentation_the_input_is_colours_and_their_condition(images):
    colours, condition = images
    torch.testing.assert_close(augment().apply(colours, condition), torch.cat([colours, condition], 1))
    torch.testing.assert_close(DiffAugment.drawn(2, 0.0).apply(colours, condition), torch.cat([colours, condition], 1))


def test_colours_are_brighter_greyer_and_flatter(images):
    colours, condition = images
    augmented = augment(brightness=(0.3, 0), saturation=(0.5, 1), contrast=(1.5, 1)).apply(colours, condition)
    bright = colours[0] + 0.3
    grey = (bright[0] + bright[1] + bright[2]) / 3
    faded = torch.stack([0.5 * grey + 0.5 * channel for channel in bright])
    flat = 1.5 * faded - 0.5 * faded.mean()
    torch.testing.assert_close(augmented[0, :3], flat)
    torch.testing.assert_close(augmented[:, 3:], condition)
    torch.testing.assert_close(augmented[1, :3], colours[1])


def test_an_image_moves_down_and_right_with_what_it_was_painted_from(images):
    colours, condition = images
    augmented = augment(down=(2 / ROWS, 0), right=(-3 / COLUMNS, 0)).apply(colours, condition)
    still = torch.cat([colours, condition], 1)
    expected = torch.zeros_like(still[0])
    for row in range(2, ROWS):
        for column in range(COLUMNS - 3):
            expected[:, row, column] = still[0, :, row - 2, column + 3]
    torch.testing.assert_close(augmented, torch.stack([expected, still[1]]))


def test_a_cutout_is_half_as_high_and_wide_and_cut_off_at_the_border(images):
    colours, condition = images
    condition = condition + 1  # nothing is zero but the cutout
    augmented = augment(cut_row=(0.5, torch.nan), cut_column=(0.0, torch.nan)).apply(colours, condition)
    cutouts = augmented[:, 3] == 0
    rows, columns = torch.linspace(0, 1, ROWS), torch.linspace(0, 1, COLUMNS)
    expected = ((rows - 0.5).abs() <= 0.25)[:, None] & (columns <= 0.25)
    assert torch.equal(cutouts[0], expected)
    assert not cutouts[1].any()
    assert torch.equal(augmented[0, 0] == 0, expected)


def test_draws_stay_within_their_bounds_and_come_as_often_as_requested():
    torch.manual_seed(0)
    drawn = DiffAugment.drawn(4000, 0.3)
    assert float(drawn.brightness.abs().max()) <= 0.5
    assert abs(float(drawn.brightness.mean())) < 0.02 and abs(float(drawn.down.mean())) < 0.005
    assert drawn.saturation.min() >= 0 and drawn.saturation.max() <= 2
    assert drawn.contrast.min() >= 0.5 and drawn.contrast.max() <= 1.5
    assert max(float(drawn.down.abs().max()), float(drawn.right.abs().max())) <= 1 / 8
    assert torch.equal(drawn.cut_row.isnan(), drawn.cut_column.isnan())
    for happened in (drawn.brightness != 0, drawn.down != 0, ~drawn.cut_row.isnan()):
        assert float(happened.float().mean()) == pytest.approx(0.3, abs=0.03)
    assert float(drawn.brightness.abs().max()) > 0.45 and float(drawn.right.abs().max()) > 0.11


def test_gradients_reach_what_was_painted_and_only_what_is_visible(images):
    colours, condition = images
    colours.requires_grad_()
    augment(down=(4 / ROWS, 0), cut_row=(torch.nan, 0.5), cut_column=(torch.nan, 0.5)).apply(
        colours, condition
    ).sum().backward()
    reached = colours.grad != 0
    assert reached[0, 0, : ROWS - 4].all()  # the rest has left the picture
    assert not reached[0, 0, ROWS - 4 :].any()
    assert not reached[1, :, ROWS // 2, COLUMNS // 2].any()


def test_every_number_is_one_an_image():
    drawn = DiffAugment.drawn(3, 1.0)
    assert {tuple(getattr(drawn, field.name).shape) for field in fields(drawn)} == {(3,)}
    assert replace(drawn, down=torch.zeros(3)).apply(torch.ones(3, 3, 8, 8), torch.ones(3, 1, 8, 8)).shape == (
        3,
        4,
        8,
        8,
    )
