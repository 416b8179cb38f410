"""Masks as numbers choose exactly what torch.where chooses."""

from __future__ import annotations

import torch

from lidar2pano.geometry.masks import as_float, either


def test_either_is_where():
    yes, no = torch.randn(2, 3, 50, generator=torch.Generator().manual_seed(5)) * torch.tensor([[[1e-6, 1.0, 1e6]]]).mT
    mask = yes > no
    assert torch.equal(either(mask, yes, no), torch.where(mask, yes, no))
    assert torch.equal(either(mask, yes[:, :1], no), torch.where(mask, yes[:, :1], no))
    assert torch.equal(as_float(mask), mask.float()) and torch.equal(as_float(mask.T), mask.T.float())
