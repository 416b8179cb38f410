"""An engine that is torch itself, for tests of what surrounds engines: nothing is compiled."""

from __future__ import annotations

import io
from typing import ClassVar

import torch
from torch import Tensor, nn

from lidar2pano.engines.runtimes import example, recordable
from lidar2pano.engines.signatures import as_tuple
from random_weights import PAINTER

# settings that make networks small, by name in MODELS
SLIM = {
    "salsanext": {"widths": (8, 8, 16, 16)},
    "titan-pano": {"widths": (8, 8, 8, 8, 8), "pyramid": 8},
    "latent-painter": PAINTER | {"looks": ("day", "dusk")},
}


class TorchEngine:
    """`builds` counts networks that were built, `error` is added to what comes out, `failure` is raised instead."""

    name = "onnx"
    builds: ClassVar[list[str]] = []

    def __init__(self, error: float = 0.0, failure: str = "") -> None:
        self.error, self.failure = error, failure

    def conditions(self) -> str:
        return "none"

    def build(self, network: nn.Module, model: str, shapes: tuple[tuple[int, ...], ...]) -> bytes:
        if self.failure:
            raise RuntimeError(self.failure)
        self.builds.append(model)
        stream = io.BytesIO()
        torch.save(recordable(network, example(shapes)), stream)
        return stream.getvalue()

    def open(self, compiled: bytes, device: torch.device):
        network = torch.load(io.BytesIO(compiled), weights_only=False)

        def run(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            with torch.autocast("cpu", enabled=False):
                outputs = as_tuple(network(*(each.float() for each in inputs)))
            return tuple(each + self.error * torch.randn(each.shape) for each in outputs)

        return run
