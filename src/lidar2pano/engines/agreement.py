"""Whether an engine computes a network as exactly as torch does."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidar2pano.engines.signatures import SIGNATURES, as_tuple
from lidar2pano.hardware import fast_arithmetic

# An engine's distance from float32 may be TIMES that of torch in its fast arithmetic, and more by:
TIMES = 1.5
MORE_DISTANCE = 2e-3  # of the output's root mean square
MORE_PIXELS = 2e-3  # of all pixels, whose class is another


@torch.inference_mode()
def agrees(network: nn.Module, model: str, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> bool:
    """Whether outputs of an engine are about as near to torch's in float32 as torch's in its fast arithmetic are.

    Compared are root mean squares of the differences, and of class scores also which class is the best.
    """
    device = inputs[0].device
    with torch.autocast(device.type, enabled=False):
        exact = as_tuple(network(*(each.float() for each in inputs)))
    with fast_arithmetic(device):
        usual = as_tuple(network(*inputs))
    signature = SIGNATURES[model]
    for name, ours, theirs, reference in zip(signature.outputs, outputs, usual, exact, strict=True):
        if not distance(ours, reference) <= TIMES * distance(theirs, reference) + MORE_DISTANCE:  # NaN is not
            return False
        if name in signature.classes:
            allowed = TIMES * other_classes(theirs, reference) + MORE_PIXELS
            if other_classes(ours, reference) > allowed:
                return False
    return True


def distance(x: Tensor, reference: Tensor) -> float:
    """Root mean square of the difference as a share of the reference's."""
    difference = (x.float() - reference).square().mean().sqrt()
    return float(difference / reference.square().mean().sqrt().clamp(min=1e-12))


def other_classes(x: Tensor, reference: Tensor) -> float:
    """Share of the pixels whose best class is another; both (B, classes, H, W)."""
    return float((x.float().max(1).indices != reference.max(1).indices).float().mean())
