"""OpenVINO: networks in bfloat16 on CPUs with bfloat16 arithmetic, otherwise in float32."""

from __future__ import annotations

import io
import json
import sys
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from lidar2pano.engines.compiled import Run
from lidar2pano.engines.signatures import Shape
from lidar2pano.engines.tracing import example, recordable, recording
from lidar2pano.hardware import has_bfloat16

DTYPES = {"f32": torch.float32, "bf16": torch.bfloat16}  # of what compiled models give
IMAGE = 4  # dimensions of a batch of images
TELEMETRY = "openvino_telemetry"


class OpenVino:
    """Engine of `compiled.CompiledForward`."""

    name = "openvino"

    def conditions(self) -> str:
        """Return versions, processor and arithmetic; not the number of threads."""
        names = ("FULL_DEVICE_NAME", "OPTIMIZATION_CAPABILITIES")
        processor = [_core().get_property("CPU", name) for name in names]
        return json.dumps([openvino().__version__, torch.__version__, processor, _precision(), "channels last"])

    def build(self, network: nn.Module, model: str, shapes: tuple[Shape, ...]) -> bytes:  # noqa: ARG002
        """Compile the network for inputs of these shapes; return the bytes of OpenVINO's export."""
        with recording():
            inputs = example(shapes)
            program = torch.export.export(recordable(network, inputs), inputs, strict=False)
            graph = openvino().convert_model(program)
        graph.reshape(dict(zip(graph.inputs, map(list, shapes), strict=True)))
        graph = _channels_last(graph, shapes)
        stream = io.BytesIO()
        _core().compile_model(graph, "CPU", _settings()).export_model(stream)
        return stream.getvalue()

    def open(self, compiled: bytes, device: torch.device) -> Run:  # noqa: ARG002 it is the CPU
        """Load a compiled model; its outputs are written into tensors of ours."""
        request = _core().import_model(compiled, "CPU", _settings()).create_infer_request()
        dtypes = [DTYPES[port.element_type.to_string()] for port in request.model_inputs]
        results = [(tuple(port.shape), DTYPES[port.element_type.to_string()]) for port in request.model_outputs]

        def run(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            outputs = tuple(torch.empty(shape, dtype=dtype) for shape, dtype in results)
            memory = [_shared(_as_taken(tensor, dtype)) for tensor, dtype in zip(inputs, dtypes, strict=True)]
            for number, tensor in enumerate(memory):
                request.set_input_tensor(number, tensor)
            for number, output in enumerate(outputs):
                request.set_output_tensor(number, _shared(output))
            request.infer()
            return outputs

        return run


@cache
def _core() -> Any:  # noqa: ANN401
    """Return the compiler of all networks of the process."""
    return openvino().Core()


def _channels_last(graph: Any, shapes: tuple[Shape, ...]) -> Any:  # noqa: ANN401
    """Return the graph with inputs as it computes: channels last, in the arithmetic's own numbers."""
    module = openvino()
    wrapped = module.preprocess.PrePostProcessor(graph)
    for number, shape in enumerate(shapes):
        if len(shape) == IMAGE:
            numbers = getattr(module.Type, _precision())
            wrapped.input(number).tensor().set_layout(module.Layout("NHWC")).set_element_type(numbers)
            wrapped.input(number).model().set_layout(module.Layout("NCHW"))
    return wrapped.build()


def _as_taken(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an input in the layout and numbers of `_channels_last`."""
    return (x.movedim(1, 3) if x.dim() == IMAGE else x).to(dtype).contiguous()


def _shared(x: Tensor) -> Any:  # noqa: ANN401
    """Return an openvino.Tensor in a tensor's memory; numpy has no bfloat16: its bits are passed."""
    if x.dtype == torch.bfloat16:
        return openvino().Tensor(x.view(torch.int16).numpy(), x.shape, openvino().Type.bf16)
    return openvino().Tensor(x.numpy(), shared_memory=True)


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
    hidden = TELEMETRY not in sys.modules
    if hidden:
        sys.modules[TELEMETRY] = None  # type: ignore[assignment] an import of it fails, and OpenVINO does without
    try:
        import openvino as module
    finally:
        if hidden:
            del sys.modules[TELEMETRY]
    return module
