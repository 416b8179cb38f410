"""What the networks of a pipeline take and give, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Signature:
    """The tensors of a network's `forward`, in its order; their first dimension is the batch.

    classes  outputs whose channels (dimension 1) are class scores.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    classes: tuple[str, ...] = ()


# name in models.MODELS -> signature; networks that are not here run in torch only
SIGNATURES: dict[str, Signature] = {
    "salsanext": Signature(inputs=("image",), outputs=("logits",), classes=("logits",)),
    "titan-pano": Signature(inputs=("image", "condition"), outputs=("logits", "depth_m"), classes=("logits",)),
    "scene-painter": Signature(inputs=("inputs", "fine_noise", "shares", "tone"), outputs=("colour",)),
}


def as_tuple(outputs: Tensor | Sequence[Tensor]) -> tuple[Tensor, ...]:
    """What a network gave, one tensor or several, as a tuple."""
    return (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)
