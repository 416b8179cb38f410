"""Odds of classes, changed by what a measurement says for one of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


def multiply_odds(logits: Tensor, one: int, others: Sequence[int], factor: Tensor) -> None:
    """Change logits (B, C, H, W) so that the odds of class `one` against `others` are multiplied by exp(factor).

    factor  (B, H, W). What these classes sum to stays, and so do the shares of the others among themselves.
    """
    before = logits[:, others].logsumexp(1)
    both, apart = torch.logaddexp(before, logits[:, one]), logits[:, one] - before + factor
    logits[:, one] = both + logsigmoid(apart)
    logits[:, others] += (both + logsigmoid(-apart) - before)[:, None]
