"""Engines of the networks: torch, torch.compile, ONNX Runtime, OpenVINO; their choice; and export as ONNX graphs."""

from __future__ import annotations

import copy
import importlib.util
import os
from typing import Any

import torch
from torch import nn

from lidar2pano.engines.compiled import CompiledForward
from lidar2pano.engines.runtimes import PROVIDERS, OnnxRuntime, OpenVino
from lidar2pano.engines.signatures import SIGNATURES
from lidar2pano.errors import InputError, closest
from lidar2pano.hardware import has_bfloat16
from lidar2pano.progress import working

ENGINES = ("auto", "torch", "compile", "onnx", "openvino")
VARIABLE = "LIDAR2PANO_ENGINE"  # in the environment: the meaning of "auto"
# engine -> its extra, its modules
BUILDERS = {"onnx": OnnxRuntime, "openvino": OpenVino}
EXTRAS = {"onnx": ("export", ("onnx", "onnxscript", "onnxruntime")), "openvino": ("fast", ("openvino",))}


def pick_engine(name: str, device: torch.device) -> str:
    """Return the engine for a name of ENGINES on a device.

    "auto" is OpenVINO on a CPU with bfloat16 arithmetic, if it is installed, else torch; it compiles nothing.
    Raises InputError if the name is unknown, its extra is missing, or it cannot compute on the device.
    """
    requested = os.environ.get(VARIABLE) or name if name == "auto" else name
    if requested not in ENGINES:
        raise InputError(f"no engine {requested!r}{closest(requested, ENGINES)}")
    if requested == "auto":
        fast = device.type == "cpu" and _is_installed("openvino") and has_bfloat16(device)
        return "openvino" if fast else "torch"
    if extra := missing_extra(requested):
        raise InputError(f"engine {requested} needs the extra {extra!r}: pip install 'lidar2pano[{extra}]'")
    if requested == "onnx" and PROVIDERS[device.type] not in _providers():
        raise InputError("engine onnx: onnxruntime has no CUDA here; install onnxruntime-gpu, or use --device cpu")
    if requested == "openvino" and device.type != "cpu":
        raise InputError(f"engine openvino does not compute on {device.type}; use --device cpu, or --engine torch")
    return requested


def missing_extra(engine: str) -> str:
    """Return the missing extra of an engine; "" if none is missing."""
    extra, modules = EXTRAS.get(engine, ("", ()))
    return "" if all(map(_is_installed, modules)) else extra


def accelerated(network: nn.Module, model: str, weights: str, engine: str, device: torch.device) -> nn.Module:
    """Let an engine compute a network's `forward`; return the network, changed in place.

    model    its name in models.MODELS;  weights: checksum of its weights, "" to keep nothing on disk.
    engine   of ENGINES. With "auto", the engine computes networks compiled before by its name, and torch all else; one
             that VARIABLE names compiles, and leaves to torch what it cannot compute.
    Otherwise it is compiled for each shape of inputs when they first come.
    Raises InputError as `pick_engine`, and for a network that runs in torch only.
    """
    picked = pick_engine(engine, device)
    if picked == "torch":
        return network
    if model not in SIGNATURES:
        if engine == "auto":
            return network
        raise InputError(f"a {model!r} runs with --engine torch only, not with {picked}")
    if picked == "compile":
        network.compile(dynamic=False, mode="reduce-overhead" if device.type == "cuda" else "default")
        _announce_first_call(network, model)
        return network
    plain = copy.copy(network)  # the same weights, and torch's own forward
    optional = engine == "auto"
    compiles = not optional or os.environ.get(VARIABLE, "auto") not in ("", "auto")
    network.forward = CompiledForward(plain, model, weights, BUILDERS[picked](), compiles=compiles, optional=optional)
    return network


def _announce_first_call(network: nn.Module, model: str) -> None:
    """Announce the first call of a network that torch.compile then compiles."""
    compiled: Any = network._compiled_call_impl

    def first_call(*inputs: object) -> object:
        network._compiled_call_impl = compiled
        with working(f"compiling the {model} by torch.compile, anew in each process"):
            return compiled(*inputs)

    network._compiled_call_impl = first_call


def _providers() -> list[str]:
    import onnxruntime

    return onnxruntime.get_available_providers()


def _is_installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None
