"""ONNX graphs of networks, and ONNX Runtime to run them in float32."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lidar2pano.engines.compiled import Run
from lidar2pano.engines.signatures import SIGNATURES, Shape
from lidar2pano.engines.tracing import example, recordable, recording

OPSET = 20  # of ONNX, 2023: bilinear Resize, AveragePool and all else the networks need, in every current runtime
PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}


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


def session(compiled: bytes | str, device_type: str = "cpu") -> Any:  # noqa: ANN401
    """Return an onnxruntime.InferenceSession with as many threads as torch."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3  # errors
    return onnxruntime.InferenceSession(compiled, options, providers=[PROVIDERS[device_type]])
