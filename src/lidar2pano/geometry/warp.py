"""Sampling of images, bilinear or bicubic, and warping by backward flow."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample


def warp(
    image: Tensor, flow: Tensor, *, circular: bool = False, align_corners: bool = True, cubic: bool = False
) -> Tensor:
    """Fetch every pixel from where the flow says it was: out(x, y) = image(x + u, y + v).

    image          (B, C, H, W) float.
    flow           (B, 2, H, W) pixels: u to the right, v down.
    circular       the last column meets the first; otherwise what lies beyond an edge is the edge's own pixel.
    align_corners  True: exactly that. False: as published vid2vid code runs since torch 1.3, which stretches an image
                   of n pixels by n / (n - 1) about its middle (up to half a pixel off at the edges); the columns of a
                   circular panorama have no middle and are always exact.
    cubic          bicubic instead of bilinear: what is warped again and again stays detailed, but goes a little beyond
                   the values that were there.
    Returns (B, C, H, W) of the image's type; computed in float32.
    """
    rows, columns = image.shape[-2:]
    u, v = flow.float().unbind(1)
    x = torch.arange(columns, device=flow.device) + u
    y = torch.arange(rows, device=flow.device)[:, None] + v
    return sample(image.float(), x, y, circular=circular, align_corners=align_corners, cubic=cubic).to(image.dtype)


def sample(
    image: Tensor, x: Tensor, y: Tensor, *, circular: bool, align_corners: bool = True, cubic: bool = False
) -> Tensor:
    """Samples (B, C, h, w) of an image (B, C, H, W) float at x, y (B, h, w), pixel centres at integers.

    circular, align_corners, cubic: see `warp`.
    """
    rows, columns = image.shape[-2:]
    y = y * _per_pixel(rows) - 1
    if circular:
        left, right = (1, 2) if cubic else (0, 1)  # neighbours that a sample between the last and the first needs
        image = torch.cat([image[..., columns - left :], image, image[..., :right]], 3)
        x, columns = torch.remainder(x, columns) + left, columns + left + right
        x = x * _per_pixel(columns) - 1 if align_corners else (2 * x + 1) / columns - 1
    else:
        x = x * _per_pixel(columns) - 1
    grid = torch.stack([x, y], 3).to(image.dtype)
    mode = "bicubic" if cubic else "bilinear"
    return grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=align_corners)


def _per_pixel(pixels: int) -> float:
    """Length of one pixel on torch's scale, on which the centres of the first and the last pixel are -1 and 1."""
    return 2.0 / max(pixels - 1, 1)
