"""Engines: compilers of recorded networks.

OpenVINO      in bfloat16 on CPUs with bfloat16 arithmetic, otherwise in float32.
ONNX Runtime  ONNX graphs, in float32.
"""

from __future__ import annotations

import copy
import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from lidar2pano.engines.signatures import SIGNATURES, Shape
from lidar2pano.errors import hidden
from lidar2pano.hardware import has_bfloat16

OPSET = 20  # of ONNX, 2023: bilinear Resize, AveragePool and all else the networks need, in every current runtime
PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
TELEMETRY = "openvino_telemetry"
Run = Callable[[tuple[Tensor, ...]], tuple[Tensor, ...]]


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
        own = copy.deepcopy(network).cpu().requires_grad_(False)  # or all activations would be kept for gradients
        own(*inputs)
    return own


class OnnxRuntime:
    """Engine of `compiled.CompiledForward`."""

    name = "onnx"

    def conditions(self) -> str:
        """Return the versions of the exporter and of the opset: a graph runs everywhere."""
        import onnxscript

        return json.dumps([torch.__version__, onnxscript.__version__, OPSET])

    def build(self, network: nn.Module, model: str, shapes: tuple[Shape, ...]) -> bytes:
        """Return the network as an ONNX graph for inputs of these shapes, any batch."""
        two = tuple((2, *shape[1:]) for shape in shapes)
        return graph(network, model, example(two)).SerializeToString()

    def open(self, compiled: bytes, device: torch.device) -> Run:
        """Load an ONNX graph; arrays pass through the CPU's memory."""
        opened = session(compiled, device.type)
        names = [tensor.name for tensor in opened.get_inputs()]

        def run(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            arrays = (tensor.float().contiguous().cpu().numpy() for tensor in inputs)
            outputs = opened.run(None, dict(zip(names, arrays, strict=True)))
            return tuple(torch.from_numpy(array).to(device) for array in outputs)

        return run


def graph(network: nn.Module, model: str, inputs: Sequence[Tensor], metadata: Mapping[str, str] | None = None) -> Any:  # noqa: ANN401
    """Return an onnx.ModelProto of a network: names of its signature, a dynamic dimension "batch", weights inside.

    inputs    example inputs with the graph's other dimensions, a batch of two or more: torch.export would fix a batch
              of one.  metadata: text in the file.
    """
    signature = SIGNATURES[model]
    batch = torch.export.Dim("batch", min=1)
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it warns of torchvision's missing operators
    try:
        with recording():
            program = torch.onnx.export(
                recordable(network, inputs),
                tuple(inputs),
                dynamo=True,
                opset_version=OPSET,
                input_names=list(signature.inputs),
                output_names=list(signature.outputs),
                dynamic_shapes=tuple({0: batch} for _ in inputs),
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    if program is None:
        raise RuntimeError("torch.onnx exported nothing")
    proto = program.model_proto
    for name, text in (metadata or {}).items():
        proto.metadata_props.add(key=name, value=text)
    return proto


def session(compiled: bytes | str, device_type: str = "cpu", keeps: bool = True) -> Any:  # noqa: ANN401
    """Return an onnxruntime.InferenceSession with as many threads as torch.

    keeps  memory between calls, which is faster; it is more than a call takes.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3  # errors
    options.enable_cpu_mem_arena = keeps
    return onnxruntime.InferenceSession(compiled, options, providers=[PROVIDERS[device_type]])


class OpenVino:
    """Engine of `compiled.CompiledForward`."""

    name = "openvino"

    def conditions(self) -> str:
        """Return versions, processor and arithmetic; not the number of threads."""
        names = ("FULL_DEVICE_NAME", "OPTIMIZATION_CAPABILITIES")
        processor = [_core().get_property("CPU", name) for name in names]
        return json.dumps([openvino().__version__, torch.__version__, processor, _precision()])

    def build(self, network: nn.Module, model: str, shapes: tuple[Shape, ...]) -> bytes:  # noqa: ARG002
        """Compile the network for inputs of these shapes; return the bytes of OpenVINO's export."""
        with recording():
            inputs = example(shapes)
            program = torch.export.export(recordable(network, inputs), inputs, strict=False)
            graph = openvino().convert_model(program)
        graph.reshape(dict(zip(graph.inputs, map(list, shapes), strict=True)))
        stream = io.BytesIO()
        _core().compile_model(graph, "CPU", _settings()).export_model(stream)
        return stream.getvalue()

    def open(self, compiled: bytes, device: torch.device) -> Run:  # noqa: ARG002 it is the CPU
        """Load a compiled model, whose inputs and outputs are float32."""
        opened = _core().import_model(compiled, "CPU", _settings())

        def run(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            outputs = opened([tensor.float().contiguous().numpy() for tensor in inputs], share_inputs=True)
            return tuple(torch.from_numpy(outputs[port]) for port in opened.outputs)

        return run


Engine = OnnxRuntime | OpenVino


@cache
def _core() -> Any:  # noqa: ANN401
    """Return the compiler of all networks of the process."""
    return openvino().Core()


def _precision() -> str:
    return "bf16" if has_bfloat16(torch.device("cpu")) else "f32"


def _settings() -> dict[str, Any]:
    return {
        "INFERENCE_PRECISION_HINT": _precision(),
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        "ENABLE_CPU_PINNING": False,  # cores may be shared with other processes
    }


@cache
def openvino() -> Any:  # noqa: ANN401
    """Return the module `openvino`, kept from reporting its import over the network."""
    with hidden(TELEMETRY):  # OpenVINO does without
        import openvino as module
    return module
