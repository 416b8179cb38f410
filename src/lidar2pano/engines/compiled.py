"""A network's `forward` by another engine: compiled per shape of inputs, checked once against torch, kept on disk."""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from lidar2pano.engines import disk_cache
from lidar2pano.engines.runtimes import Engine, Run
from lidar2pano.engines.signatures import SIGNATURES, Shape, as_tuple
from lidar2pano.errors import InputError
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.progress import working

MOST_SHAPES = 4  # held in memory for one network
REFUSED = b""  # on disk, for a network whose outputs did not agree
DISAGREES = "its outputs are farther from float32's than torch's are"
# An engine's distance from float32 may be TIMES that of torch in its fast arithmetic, and more by:
TIMES = 1.5
MORE_DISTANCE = 2e-3  # of the output's root mean square
MORE_PIXELS = 2e-3  # of all pixels, whose class is another
MODELS = Path(__file__).parent.parent / "models"


class UnfitError(Exception):
    """An engine cannot compute a network, or not as exactly as torch does."""


class CompiledForward:
    """Compute `forward` of a network by an engine, with the network's inputs.

    network   as torch runs it;  model: its name in SIGNATURES;  weights: their checksum, "" to keep nothing on disk.
    compiles  whether a network is compiled now; else torch computes shapes that were not compiled before: that takes
              half a minute, and one scan does not earn it back.
    optional  whether torch computes networks that the engine fails at, or computes less exactly: else an InputError.
    """

    def __init__(
        self, network: nn.Module, model: str, weights: str, engine: Engine, *, compiles: bool, optional: bool
    ) -> None:
        self.network, self.model, self.weights = network, model, weights
        self.engine, self.compiles, self.optional = engine, compiles, optional
        self._runs: OrderedDict[tuple[Shape, ...], Run | None] = OrderedDict()
        self._lock = threading.Lock()  # a compiled network serves one call at a time

    def __call__(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Compute as the network's own `forward` does."""
        shapes = tuple(tuple(tensor.shape) for tensor in inputs)
        with self._lock:
            if shapes not in self._runs:
                self._runs[shapes] = self._run_for(inputs, shapes)
            self._runs.move_to_end(shapes)
            if len(self._runs) > MOST_SHAPES:
                self._runs.popitem(last=False)
            run = self._runs[shapes]
            if run is not None:
                outputs = run(inputs)
                return outputs[0] if len(outputs) == 1 else outputs
        return self.network(*inputs)

    def _run_for(self, inputs: tuple[Tensor, ...], shapes: tuple[Shape, ...]) -> Run | None:
        if not self.compiles and disk_cache.is_empty():  # no engine is asked: importing it takes a fifth of a second
            return None
        parts = [self.engine.name, self.engine.conditions(), self.model, self.weights, shapes, _sources()]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest() if self.weights else ""
        try:
            stored = self._stored(key, inputs[0].device)
            if stored or not self.compiles:
                return stored
            kept = "; it is kept on disk" if key else ""
            with working(f"compiling the {self.model} for {self.engine.name}, once for scans like this one{kept}"):
                return self._compiled(key, inputs, shapes)
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
        except Exception:  # noqa: BLE001 the network is compiled again
            return None

    def _compiled(self, key: str, inputs: tuple[Tensor, ...], shapes: tuple[Shape, ...]) -> Run:
        try:
            compiled = self.engine.build(self.network, self.model, shapes)
            run = self.engine.open(compiled, inputs[0].device)
            outputs = run(inputs)
        except Exception as error:  # noqa: BLE001 an engine's own
            self.network(*inputs)  # raises the network's own error if the inputs are wrong
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
    """Return a checksum of the networks' code: weights alone do not determine the outputs."""
    digest = hashlib.sha256()
    for file in sorted(MODELS.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


@torch.inference_mode()
def agrees(network: nn.Module, model: str, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> bool:
    """Return whether an engine's outputs are about as near to torch's in float32 as torch's in its fast arithmetic.

    Root mean squares of the differences are compared, and of class scores also the best classes.
    """
    device = inputs[0].device
    with torch.autocast(device.type, enabled=False):
        exact = as_tuple(network(*(tensor.float() for tensor in inputs)))
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
    """Return the root mean square of the difference as a share of the reference's."""
    difference = (x.float() - reference).square().mean().sqrt()
    return float(difference / reference.square().mean().sqrt().clamp(min=1e-12))


def other_classes(x: Tensor, reference: Tensor) -> float:
    """Return the share of pixels whose best class differs; both tensors (B, classes, H, W)."""
    return float((x.float().max(1).indices != reference.max(1).indices).float().mean())
