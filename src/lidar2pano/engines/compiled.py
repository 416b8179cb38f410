"""A network's `forward`, computed by another engine: compiled per shape of inputs, checked once, kept on disk."""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from lidar2pano.engines import disk_cache
from lidar2pano.engines.agreement import agrees
from lidar2pano.engines.signatures import SIGNATURES, Shape
from lidar2pano.errors import InputError

MOST_SHAPES = 4  # that are held in memory for one network
REFUSED = b""  # stands on disk for a network whose outputs did not agree
DISAGREES = "its outputs are farther from float32's than torch's are"
MODELS = Path(__file__).parent.parent / "models"
Run = Callable[[tuple[Tensor, ...]], tuple[Tensor, ...]]


class Engine(Protocol):
    """What compiles a network for inputs of one shape, and runs what it compiled."""

    name: str

    def conditions(self) -> str:
        """What a compiled network depends on besides the network: versions, the processor, the arithmetic."""
        ...

    def build(self, network: nn.Module, model: str, shapes: tuple[Shape, ...]) -> bytes:
        """The network, compiled."""
        ...

    def open(self, compiled: bytes, device: torch.device) -> Run:
        """A compiled network, ready to run."""
        ...


class UnfitError(Exception):
    """An engine cannot compute a network, or not as exactly as torch does."""


class CompiledForward:
    """Computes `forward` of a network by an engine.

    It takes what the network takes, and gives class scores in
    the engine's arithmetic, all else in float32.

    network   as torch runs it;  model: its name in SIGNATURES;  weights: their checksum, "" to keep nothing on disk.
    optional  whether torch computes what was not compiled before, since compiling takes half a minute that one scan
              does not earn back, or where the engine did not do as well. Otherwise it is compiled now, and what the
              engine cannot do is an InputError.
    """

    def __init__(self, network: nn.Module, model: str, weights: str, engine: Engine, *, optional: bool) -> None:
        self.network, self.model, self.weights = network, model, weights
        self.engine, self.optional = engine, optional
        self._runs: OrderedDict[tuple[Shape, ...], Run | None] = OrderedDict()
        self._lock = threading.Lock()  # what an engine compiled serves one call at a time

    def __call__(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """As the network's own `forward`."""
        shapes = tuple(tuple(each.shape) for each in inputs)
        with self._lock:
            if shapes not in self._runs:
                self._runs[shapes] = self._run_for(inputs, shapes)
            self._runs.move_to_end(shapes)
            if len(self._runs) > MOST_SHAPES:
                self._runs.popitem(last=False)
            run = self._runs[shapes]
            if run is not None:
                return self._as_forward(run(inputs))
        return self.network(*inputs)

    def _as_forward(self, outputs: tuple[Tensor, ...]) -> Tensor | tuple[Tensor, ...]:
        signature = SIGNATURES[self.model]
        named = zip(signature.outputs, outputs, strict=True)
        outputs = tuple(each if name in signature.classes else each.float() for name, each in named)
        return outputs[0] if len(outputs) == 1 else outputs

    def _run_for(self, inputs: tuple[Tensor, ...], shapes: tuple[Shape, ...]) -> Run | None:
        if self.optional and disk_cache.is_empty():  # which asks no engine: importing one takes a fifth of a second
            return None
        parts = [self.engine.name, self.engine.conditions(), self.model, self.weights, shapes, _sources()]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest() if self.weights else ""
        try:
            stored = self._stored(key, inputs[0].device)
            return stored if stored or self.optional else self._compiled(key, inputs, shapes)
        except UnfitError as unfit:
            if self.optional:
                return None
            name = f"engine {self.engine.name}, network {self.model!r}"
            raise InputError(f"{name}: {unfit}; use --engine torch") from unfit

    def _stored(self, key: str, device: torch.device) -> Run | None:
        stored = disk_cache.fetch(key) if key else None
        if stored is None:
            return None
        if stored == REFUSED:
            raise UnfitError(DISAGREES)
        try:
            return self.engine.open(stored, device)
        except Exception:  # noqa: BLE001 whatever it is: it is compiled again
            return None

    def _compiled(self, key: str, inputs: tuple[Tensor, ...], shapes: tuple[Shape, ...]) -> Run:
        try:
            compiled = self.engine.build(self.network, self.model, shapes)
            run = self.engine.open(compiled, inputs[0].device)
            outputs = run(inputs)
        except Exception as error:  # noqa: BLE001 an engine's own
            self.network(*inputs)  # where the inputs are wrong, this says so
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise UnfitError(f"cannot be compiled ({reason})") from error
        fits = agrees(self.network, self.model, inputs, outputs)
        if key:
            disk_cache.store(key, compiled if fits else REFUSED)
        if not fits:
            raise UnfitError(DISAGREES)
        return run


@cache
def _sources() -> str:
    """Checksum of the networks' code: weights alone do not say what is computed."""
    digest = hashlib.sha256()
    for file in sorted(MODELS.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
