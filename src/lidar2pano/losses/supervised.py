"""Supervised losses: class weights, cross-entropy over labelled pixels, a teacher's predictions, Lovasz-Softmax.

Lovasz-Softmax is exact, and fast on the CPU.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import cross_entropy, kl_div


def class_weights(counts: np.ndarray, exponent: float, *, least: float, most: float) -> Tensor:
    """Weights (K,) float32 of classes seen `counts` (K,) times: share ** -exponent, their mean without class 0 at 1.

    Shares below `least` count as that; weights are at most `most`.
    """
    weights = np.maximum(counts / counts.sum(), least) ** -exponent
    return torch.from_numpy(np.minimum(weights / weights[1:].mean(), most)).float()


def labelled_cross_entropy(logits: Tensor, labels: Tensor, ignore: int, weight: Tensor | None = None) -> Tensor:
    """Mean cross-entropy of logits (B, K, H, W) over the pixels of labels (B, H, W) unlike `ignore`; 0 without any.

    weight  (K,) of the classes, as torch's own (NaN without such pixels).
    """
    total = cross_entropy(logits.float(), labels, weight, ignore_index=ignore, reduction="sum")
    counted = labels != ignore
    if weight is None:
        return total / counted.sum().clamp(min=1)
    weights = weight[torch.where(counted, labels, 0)] * counted
    return total / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def distillation(logits: Tensor, taught: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean Kullback-Leibler divergence from a teacher's classes (Hinton, Vinyals, Dean 2015, temperature 1).

    logits, taught  (B, K, H, W), of the network and of its teacher;  counted: (B, H, W) bool, counted pixels.
    """
    gap = kl_div(logits.float().log_softmax(1), taught.float().log_softmax(1), reduction="none", log_target=True).sum(1)
    return gap.mean() if counted is None else (gap * counted).sum() / counted.sum().clamp(min=1)


POSITIVE_INFINITY = 0x7F800000  # the bits of float32 +inf: above those of every finite positive number
TINIEST = np.float32(np.finfo(np.float32).smallest_subnormal)


def lovasz_softmax(probabilities: Tensor, target: Tensor, *, ignore: int | None = None) -> Tensor:
    """A convex surrogate of 1 - IoU of a batch, averaged over the classes with a pixel.

    Berman, Triki, Blaschko 2018 (arXiv:1705.08790), equations 8, 9 and 11; computed in float32 under autocast too.

    probabilities  (B, C, H, W) float in [0, 1], after the softmax; float32, bfloat16 or float16.
    target         (B, H, W) integer; pixels whose id is `ignore` or outside [0, C) are left out altogether.
    Returns a scalar; zero, with a graph, if every pixel is left out.

    Raises ValueError for shapes of different images and, on the CPU, for values beyond probabilities.
    """
    if probabilities.ndim != 4 or target.shape != probabilities.shape[:1] + probabilities.shape[2:]:
        raise ValueError(
            f"probabilities must be (B, C, H, W) and target (B, H, W), "
            f"got {tuple(probabilities.shape)} and {tuple(target.shape)}"
        )
    target = target.long()
    left_out = (target < 0) | (target >= probabilities.shape[1])
    if ignore is not None:
        left_out |= target == ignore
    return _LovaszSoftmax.apply(probabilities.float(), target.masked_fill(left_out, -1))


class _LovaszSoftmax(torch.autograd.Function):
    """The loss and, from the same sort, its gradient: the Lovasz extension is linear in a fixed order."""

    @staticmethod
    def forward(ctx, probabilities: Tensor, owner: Tensor) -> Tensor:
        kernel = _on_cpu if probabilities.device.type == "cpu" else _on_device
        loss, slope = kernel(probabilities, owner)
        ctx.save_for_backward(slope)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * gradient, None


def _on_cpu(probabilities: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Loss () and slope (B, C, H, W) by one numpy sort of 64-bit integers per class, classes shared out to threads.

    numpy sorts integers with vector instructions; torch's sort of floats with their indices took ten times as long.
    """
    lowest, highest = probabilities.aminmax()
    if lowest < 0 or highest > 1.001:  # NaN passes, and makes the loss NaN
        raise ValueError(f"Lovasz-Softmax takes probabilities, got {lowest:.3g} to {highest:.3g}: apply softmax first")
    values, count = probabilities.detach().numpy(), probabilities.shape[1]
    owner_P = owner.flatten().numpy()
    sizes = np.bincount(owner_P + 1, minlength=count + 1)
    chosen = [c for c in range(count) if sizes[c + 1]]
    left_out_P = owner_P < 0 if sizes[0] else None
    slope = np.zeros(values.shape, np.float32)

    def one(c: int) -> float:
        loss, slope_P = _class_on_cpu(np.array(values[:, c]).ravel(), owner_P == c, left_out_P)
        np.divide(slope_P.reshape(slope[:, c].shape), len(chosen), out=slope[:, c])
        return loss

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        losses = list(pool.map(one, chosen))
    return torch.tensor(sum(losses) / max(len(chosen), 1), dtype=torch.float32), torch.from_numpy(slope)


def _class_on_cpu(error_P: np.ndarray, owned_P: np.ndarray, left_out_P: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Loss of one class and its slope (P,) by probability.

    error_P     (P,) float32: the class's probabilities; overwritten.
    owned_P      (P,) bool: pixels of the class.
    left_out_P  (P,) bool or None: uncounted pixels.

    With n pixels of the class, f of them and b others among the largest errors, the Jaccard loss of the set is
    1 - (n - f) / (n + b), so the next pixel adds 1 / (n + b) when it is one of the class,
    and (n - f) / ((n + b) (n + b - 1)), b counting it, when it is not: nothing once f = n. Other classes' pixels below
    the smallest error of this class are therefore not sorted at all, nor are errors of exactly zero.
    """
    slope_P = np.zeros_like(error_P)
    owned = np.flatnonzero(owned_P)
    error_P[owned] = np.maximum(1 - error_P[owned], 0)
    if left_out_P is not None:
        error_P[left_out_P] = 0
    floor = np.maximum(error_P[owned].min(), TINIEST)
    kept = np.flatnonzero(~(error_P < floor))  # not >=, so that NaN stays and shows in the loss
    # positive floats order like their bits: the error, upside down, above the pixel's index, above "of the class"
    bits = error_P.size.bit_length() + 1
    key = POSITIVE_INFINITY - error_P.view(np.int32)[kept].astype(np.int64)
    key <<= bits
    key |= kept << 1
    key |= owned_P[kept]
    key.sort()
    error = (POSITIVE_INFINITY - (key >> bits)).astype(np.int32).view(np.float32)
    hit = (key & 1).astype(bool)
    key >>= 1
    key &= (1 << bits - 1) - 1
    hits = np.cumsum(hit, dtype=np.int32)
    union = np.arange(len(owned) + 1, len(owned) + 1 + len(key), dtype=np.int32) - hits
    union = union.astype(np.float32)
    rise = (len(owned) - hits).astype(np.float32) / union
    rise /= union - ~hit
    rise[hit] = -1 / union[hit]
    slope_P[key] = rise
    error *= rise
    return float(np.abs(error, out=error).sum(dtype=np.float64)), slope_P


def _on_device(probabilities: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """The same as `_on_cpu` in tensor operations without waits for the device; class by class to spare its memory."""
    owner_P, slope, losses, sizes = owner.flatten(), torch.empty_like(probabilities), [], []
    counted_P = owner_P >= 0
    for c in range(probabilities.shape[1]):
        owned_P = owner_P == c
        value_P = probabilities[:, c].flatten()
        error_P = torch.where(owned_P, 1 - value_P, value_P).clamp(min=0).masked_fill(~counted_P, 0)
        error, order = error_P.sort(descending=True)
        hit, size = owned_P[order], owned_P.sum()
        hits = hit.cumsum(0)
        misses = counted_P[order].cumsum(0) - hits
        union = size + misses
        rise = torch.where(hit, 1 / union, (size - hits) / union / (union - 1))
        rise = rise.where((error > 0) & (size > 0), 0)
        slope_P = torch.empty_like(rise).scatter_(0, order, torch.where(hit, -rise, rise))
        slope[:, c] = slope_P.view_as(slope[:, c])
        losses.append((rise * error).sum())
        sizes.append(size)
    share = torch.stack(sizes) > 0
    share = share / share.sum().clamp(min=1)
    return torch.dot(torch.stack(losses), share), slope * share.view(1, -1, 1, 1)
