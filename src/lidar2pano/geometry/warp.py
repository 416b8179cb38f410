"""Warping: a picture seen through a field of backward flow."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample


def warp(picture: Tensor, flow: Tensor, *, closed: bool = False, align_corners: bool = True) -> Tensor:
    """The picture with every pixel fetched from where the flow says it was: out(x, y) = picture(x + u, y + v).

    picture        (B, C, H, W) float.
    flow           (B, 2, H, W) pixels: u to the right, v down.
    closed         the last column meets the first; otherwise what lies beyond an edge is the edge's own pixel.
    align_corners  True: exactly that. False: as published vid2vid code runs since torch 1.3, which stretches a picture
                   of n pixels by n / (n - 1) about its middle (up to half a pixel off at the edges); the closed columns
                   of a panorama have no middle and are always exact.
    Returns (B, C, H, W), bilinear, of the picture's type; computed in float32.
    """
    rows, columns = picture.shape[-2:]
    u, v = flow.float().unbind(1)
    x = torch.arange(columns, device=flow.device) + u
    y = (torch.arange(rows, device=flow.device)[:, None] + v) * _per_pixel(rows) - 1
    source = picture.float()
    if closed:
        source = torch.cat([source, source[..., :1]], 3)
        x = torch.remainder(x, columns)
        x = x * _per_pixel(columns + 1) - 1 if align_corners else (2 * x + 1) / (columns + 1) - 1
    else:
        x = x * _per_pixel(columns) - 1
    grid = torch.stack([x, y], 3)
    warped = grid_sample(source, grid, mode="bilinear", padding_mode="border", align_corners=align_corners)
    return warped.to(picture.dtype)


def _per_pixel(pixels: int) -> float:
    """What one pixel is on torch's scale, on which the centres of the first and the last pixel are -1 and 1."""
    return 2.0 / max(pixels - 1, 1)
