"""Recording a network as a graph, whatever contexts the caller is in."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from lidar2pano.engines.signatures import Shape


@contextmanager
def recording() -> Iterator[None]:
    """Prepare the recording of networks: float32, with gradients, without warnings of exporters.

    With gradients, because the circular convolution writes in place without them (models.blocks).
    """
    plain = (torch.inference_mode(False), torch.enable_grad(), torch.autocast("cpu", enabled=False))
    with plain[0], plain[1], plain[2], warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def example(shapes: tuple[Shape, ...]) -> tuple[Tensor, ...]:
    """Return tensors of ones of these shapes, for recording."""
    with recording():
        return tuple(torch.ones(shape) for shape in shapes)


def recordable(network: nn.Module, inputs: Sequence[Tensor]) -> nn.Module:
    """Return a copy of a network on the CPU for recording, wherever the original was made.

    It is run once: values computed only once must exist before recording begins.
    """
    with recording():
        own = copy.deepcopy(network).cpu()
        own(*inputs)
    return own
