"""Parts of supervised losses: class weights, cross-entropy over labelled pixels, a teacher's predictions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, kl_div


def class_weights(counts: np.ndarray, exponent: float, *, least: float, most: float) -> Tensor:
    """Weights (K,) float32 of classes seen `counts` (K,) times: share ** -exponent, their mean without class 0 at 1.

    Shares below `least` count as that; weights are at most `most`.
    """
    weights = np.maximum(counts / counts.sum(), least) ** -exponent
    return torch.from_numpy(np.minimum(weights / weights[1:].mean(), most)).float()


def labelled_cross_entropy(logits: Tensor, labels: Tensor, ignore: int, weight: Tensor | None = None) -> Tensor:
    """Mean cross-entropy of logits (B, K, H, W) over the pixels of labels (B, H, W) unlike `ignore`; 0 without any.

    weight  (K,) of the classes, as torch's own, which gives NaN without such pixels.
    """
    total = cross_entropy(logits.float(), labels, weight, ignore_index=ignore, reduction="sum")
    counted = labels != ignore
    if weight is None:
        return total / counted.sum().clamp(min=1)
    weights = weight[torch.where(counted, labels, 0)] * counted
    return total / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def distillation(logits: Tensor, taught: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean Kullback-Leibler divergence from a teacher's classes (Hinton, Vinyals, Dean 2015, temperature 1).

    logits, taught  (B, K, H, W), of the network and of its teacher;  counted: (B, H, W) bool, pixels that count.
    """
    gap = kl_div(logits.float().log_softmax(1), taught.float().log_softmax(1), reduction="none", log_target=True).sum(1)
    return gap.mean() if counted is None else (gap * counted).sum() / counted.sum().clamp(min=1)
