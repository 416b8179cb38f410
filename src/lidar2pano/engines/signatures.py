"""Input and output tensors of the networks of a pipeline, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Signature:
    """The tensors of a network's `forward`, in its order; their first dimension is the batch.

    inputs, outputs  name -> content, with units: the rows of the table that `export` writes.
    classes  outputs whose channels (dimension 1) are class scores.
    """

    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    classes: tuple[str, ...] = ()


# name in models.MODELS -> signature; other networks run in torch only
SIGNATURES: dict[str, Signature] = {
    "salsanext": Signature(
        inputs={
            "image": "range, x, y, z (metres), remission in [0, 1] and, if the card's normalisation has six numbers, "
            "log roughness; (value - mean) / deviation of the card, 0 at pixels without a point (step 1)"
        },
        outputs={"logits": "scores of SemanticKITTI's 20 classes"},
        classes=("logits",),
    ),
    "titan-pano": Signature(
        inputs={
            "image": "range, x, y, z (metres), remission in [0, 1]; 0 at pixels without a point (step 3)",
            "condition": "one-hot class of each point, 1 in channel 0 at pixels without a point (step 3)",
        },
        outputs={
            "logits": "scores of unlabeled and common-15",
            "depth_m": "distance from the viewpoint along the pixel's ray, metres",
        },
        classes=("logits",),
    ),
    "scene-painter": Signature(
        inputs={
            "inputs": "classes, depth and what is invented, framed (steps 5 and 6)",
            "fine_noise": "solid noise on the picture's raster, wavelengths 0.0625, 0.125 and 0.5 m, framed (step 6)",
            "shares": "share of each of the card's `looks`; they sum to 1",
            "tone": "brightness in red, green and blue, in [-1, 1]; 0 for the mean of the look",
        },
        outputs={"colour": "red, green and blue in [-1, 1]; 8 bits are round((colour + 1) * 127.5)"},
    ),
}


def as_tuple(outputs: Tensor | Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return a network's output, one tensor or several, as a tuple."""
    return (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)
