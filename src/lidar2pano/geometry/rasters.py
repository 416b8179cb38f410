"""Operations on rasters: masks, classes, neighbours in a column, images that close in azimuth, sampling and warping.

On CPUs most of the first take a fraction of the time of torch's own.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, pad


def as_float(mask: Tensor) -> Tensor:
    """Convert a mask to float32 of its shape: 1 where it is true, else 0."""
    return mask.view(torch.uint8).float()


def select(mask: Tensor, if_true: Tensor, if_false: Tensor) -> Tensor:
    """Compute `torch.where` for finite float32, in a tenth of its time."""
    return torch.lerp(if_false, if_true, as_float(mask))


def in_unit(pixels: Tensor) -> Tensor:
    """Return pixels in [0, 255] as float32 in [-1, 1]."""
    return pixels.float() / 127.5 - 1


def as_image(colour: Tensor) -> np.ndarray:
    """Return colours (3, h, w) in [-1, 1] as an image (h, w, 3) uint8."""
    return ((colour.movedim(0, 2) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).cpu().numpy()


def likeliest(scores: Tensor) -> Tensor:
    """Return ids (B, H, W) uint8 of the class with the highest of scores (B, C, H, W); of equal ones the first.

    A third of the time of `max(1).indices`, which on CPUs is itself a tenth of argmax's.
    """
    last = scores.shape[1] - 1
    before_last = torch.arange(last, -1, -1, dtype=torch.uint8, device=scores.device).view(-1, 1, 1)
    highest = (scores == scores.amax(1, keepdim=True)).view(torch.uint8)
    return last - highest.mul_(before_last).amax(1)


def adjacent_rows(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the last row up to each pixel of a mask (..., H, W), and the first from it on, that is set; else -1 and H.

    By maxima over ..., 8, 4, 2 rows: a seventh of cummax's time.
    """
    rows = mask.shape[-2]
    narrow = rows <= torch.iinfo(torch.int16).max and not torch.compiler.is_exporting()  # ONNX Runtime pads no int16
    number = torch.int16 if narrow else torch.int32
    from_top = torch.arange(1, rows + 1, dtype=number, device=mask.device)[:, None]
    latest = torch.stack([mask, mask.flip(-2)]) * from_top  # products: torch.where takes several times as long
    steps = [1 << power for power in reversed(range((rows - 1).bit_length()))]
    latest = pad(latest, (0, 0, sum(steps), 0))
    for step in steps:
        latest = torch.maximum(latest[..., step:, :], latest[..., :-step, :])
    upper_row, lower_row = latest.unbind(0)
    return upper_row.long().sub_(1), lower_row.flip(-2).long().neg_().add_(rows)


def nearest_row(mask: Tensor) -> Tensor:
    """Return the row (..., H, W) of the set pixel nearest to each pixel of a mask in its column.

    Of equally near ones the lower; in columns without any the last row.
    """
    rows = mask.shape[-2]
    upper, lower = adjacent_rows(mask)
    row = torch.arange(rows, device=mask.device)[:, None]
    upwards = (upper >= 0) & ((lower == rows) | (row - upper < lower - row))
    return torch.where(upwards, upper, lower).clamp(max=rows - 1)


def pad_azimuth(x: Tensor, reach: int) -> Tensor:
    """Add `reach` columns of the other end to each side of (B, C, H, W): (B, C, H, W + 2 reach)."""
    if not reach:
        return x
    if x.requires_grad and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        return _PadAzimuth.apply(x, reach)  # pyright: ignore[reportReturnType]
    return torch.cat([x[..., -reach:], x, x[..., :reach]], dim=3)


class _PadAzimuth(torch.autograd.Function):
    """`pad_azimuth` for training: the gradient of each slice would be a whole image, a fifth of a painter's step."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, reach: int) -> Tensor:  # noqa: ANN401
        ctx.reach = reach
        return pad_azimuth(x, reach)  # no gradients are recorded in here

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        (grad,), reach = grads, ctx.reach
        inner = grad[..., reach:-reach].clone()
        inner[..., -reach:] += grad[..., :reach]
        inner[..., :reach] += grad[..., -reach:]
        return inner, None


def upsample_azimuth(x: Tensor, factor: int) -> Tensor:
    """Enlarge (B, C, H, W) bilinearly by a whole factor; columns interpolate across the seam."""
    enlarged = interpolate(pad_azimuth(x, 1), scale_factor=factor, mode="bilinear", align_corners=False)
    return enlarged[..., factor:-factor]


def indices_of(mask: Tensor) -> Tensor:
    """Return the indices of a mask's (n,) true ones; to select by them takes a tenth of the time by the mask itself."""
    return torch.from_numpy(np.flatnonzero(mask.numpy()))


def enlarged_planes(x: Tensor, factor: int) -> Tensor:
    """Compute `upsample_azimuth` of planes (C, H, W) float32, contiguous, in a fifth of its time."""
    planes, height, width = x.shape
    following, _, share = _between_two(factor, x.device)
    phases = list(zip((1 - following).tolist(), share.tolist(), strict=True))
    x = torch.cat([x[..., -1:], x, x[..., :1]], 2)
    wide = x.new_empty(planes, height, width, factor)
    for number, (first, part) in enumerate(phases):
        wide[..., number] = torch.lerp(x[..., first : first + width], x[..., first + 1 : first + 1 + width], part)
    wide = wide.flatten(2)
    wide = torch.cat([wide[:, :1], wide, wide[:, -1:]], 1)
    high = x.new_empty(planes, height, factor, width * factor)
    for number, (first, part) in enumerate(phases):
        high[:, :, number] = torch.lerp(wide[:, first : first + height], wide[:, first + 1 : first + 1 + height], part)
    return high.flatten(1, 2)


def largest_around(x: Tensor) -> Tensor:
    """Compute `max_pool2d(x, 3, 1, 1)` of an image (H, W) in a fraction of its time."""
    upright = x.clone()
    torch.maximum(upright[1:], x[:-1], out=upright[1:])
    torch.maximum(upright[:-1], x[1:], out=upright[:-1])
    largest = upright.clone()
    torch.maximum(largest[:, 1:], upright[:, :-1], out=largest[:, 1:])
    torch.maximum(largest[:, :-1], upright[:, 1:], out=largest[:, :-1])
    return largest


def upsample_classes(scores: Tensor, factor: int, chunk: int = 1 << 16, least: float = 0) -> Tensor:
    """Return the classes (H * factor, W * factor) uint8 of scores (1, C, H, W) enlarged by `upsample_azimuth`.

    Only where a neighbour is of another class are scores enlarged: means of scores that name one class name it, too.
    chunk  pixels that are enlarged at a time, a bound of memory: 17 MB for 16 classes.
    least  not 0: the scores are probabilities, whose logarithms are enlarged, none below that of `least`.
    """
    height, width = scores.shape[2:]
    ids = likeliest(scores)[0]
    ids = torch.cat([ids[:1], ids, ids[-1:]])
    right_ids = ids.roll(-1, 1)
    border = (ids[:-1] != ids[1:]) | (ids[:-1] != right_ids[:-1]) | (ids[:-1] != right_ids[1:])  # between four pixels
    enlarged = ids[:, None, :, None].repeat(1, factor, 1, factor)
    pixels, (following, number, share) = scores[0].flatten(1), _between_two(factor, ids.device)
    lower_share, right_share = share[:, None, None, None], share[:, None, None]
    for row, column in zip(*(part.split(chunk) for part in border.nonzero(as_tuple=True)), strict=True):
        rows = [(row + step).clamp(0, height - 1) * width for step in (-1, 0)]
        columns = torch.stack([column, (column + 1) % width])
        corners = pixels.index_select(1, torch.cat([first + second for first, second in product(rows, columns)]))
        corners = corners.float()
        corners = corners.clamp_(min=least).log_() if least else corners
        upper, lower = corners.unflatten(1, (2, 2, -1)).unbind(1)
        left, right = torch.lerp(upper, lower, lower_share).unbind(2)  # (factor, C, N)
        score = torch.lerp(left[:, None], right[:, None], right_share)  # (factor, factor, C, N)
        place = row + following[:, None, None], number[:, None, None], columns[following], number[:, None]
        enlarged[place] = likeliest(score.flatten(0, 1)[:, :, None]).view(factor, factor, -1)
    return enlarged[1:-1].reshape(height * factor, width * factor)


def _between_two(factor: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return enlarged pixels between the middles of two: their pixel (0, 1), number there, and share of the way."""
    number = torch.arange(factor, device=device)
    share = (number + 0.5) / factor - 0.5  # of the previous pixel (below 0) or the next
    return (share < 0).long(), number, share % 1


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
