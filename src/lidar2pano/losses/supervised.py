"""Parts of supervised losses: class weights, and cross-entropy over labelled pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy


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
