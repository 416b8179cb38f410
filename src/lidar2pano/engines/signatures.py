"""Input and output tensors of the networks of a pipeline, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

Shape = tuple[int, ...]
SHARES = "share of each of the card's `looks`; they sum to 1"
COLOUR = "red, green and blue in [-1, 1]; 8 bits are round((colour + 1) * 127.5)"


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
    "latent-mean": Signature(
        inputs={"conditions": "classes, geometry and what is measured (step 5)", "shares": SHARES},
        outputs={"mean": "mean of the latents, on a raster four times coarser than the conditions'"},
    ),
    "latent-flow": Signature(
        inputs={
            "conditions": "as the mean's",
            "shares": SHARES,
            "mean": "the mean's output",
            "noisy": "noise at first, then latents on their way (step 6)",
            "time": "how much of the way is gone, in [0, 1]",
            "moment": "sines and cosines of time, then of the length of the step (step 6)",
            "photograph": "latents that are known and, last, 1 where they are; else 0 (step 6)",
            "style": "means and deviations of the known latents, and 1; 0 if none are",
        },
        outputs={"velocity": "of the latents on their way"},
    ),
    "latent-decoder": Signature(
        inputs={"latents": "at the end of the way (step 7)"},
        outputs={"colour": COLOUR},
    ),
}


def as_tuple(outputs: Tensor | Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return a network's output, one tensor or several, as a tuple."""
    return (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)
