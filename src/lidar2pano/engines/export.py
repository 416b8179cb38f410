"""Export of a pipeline's networks as ONNX graphs, compared with torch before any file appears."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor, nn

from lidar2pano.engines import missing_extra
from lidar2pano.engines.runtimes import OPSET, graph, session
from lidar2pano.engines.signatures import SIGNATURES, as_tuple
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.progress import working

TOLERANCE = 1e-4  # of the difference between graph and torch; relative where an output is greater than 1
README = "README.md"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exportable:
    """A network to export.

    model   its name in SIGNATURES;  card: of its weights, as JSON.
    inputs  of a batch of one, on which graph and torch are compared.
    """

    network: nn.Module
    model: str
    card: str
    inputs: tuple[Tensor, ...]


def export(parts: Mapping[str, Exportable], folder: Path) -> list[Path]:
    """Write ROLE.onnx for each part and a README with all tensors into a folder; return their paths.

    Raises InputError without the extra, for a network that cannot be exported, where a graph's outputs differ from
    torch's by more than TOLERANCE, and where a file cannot be written; in all cases but the last no file is written.
    """
    check_exportable({role: part.model for role, part in parts.items()})
    contents: dict[str, bytes] = {}
    differences: dict[str, float] = {}
    with working(f"exporting {len(parts)} graphs and comparing them with torch", len(parts)) as advance:
        for role, part in parts.items():
            inputs = tuple(torch.cat([tensor, _turned(tensor)]) for tensor in part.inputs)
            proto = graph(part.network, part.model, inputs, {"card": part.card, "role": role})
            contents[f"{role}.onnx"] = compiled = proto.SerializeToString()
            differences[role] = compare(compiled, part, inputs)
            advance()
    contents[README] = readme(parts, differences).encode()
    return [
        write_whole(folder / name, lambda path, data=data: path.write_bytes(data)) for name, data in contents.items()
    ]


def check_exportable(models: Mapping[str, str]) -> None:
    """Raise InputError without the extra, or for a network (name in models.MODELS, by role) that cannot be exported."""
    if extra := missing_extra("onnx"):
        raise InputError(f"the export needs the extra {extra!r}: pip install 'lidar2pano[{extra}]'")
    for role, model in models.items():
        if model not in SIGNATURES:
            names = ", ".join(SIGNATURES)
            raise InputError(f"the {role} is a {model!r}, which cannot be exported; name weights of {names}")


def _turned(x: Tensor) -> Tensor:
    """Return another input of the same sort: rasters turned by a quarter in azimuth."""
    return x.roll(x.shape[-1] // 4, -1) if x.ndim > 2 else x


@torch.inference_mode()
def compare(compiled: bytes, part: Exportable, inputs: tuple[Tensor, ...]) -> float:
    """Return the greatest difference between a graph and torch in float32, for a batch and for its first alone.

    Raises InputError if it is above TOLERANCE.
    """
    opened, signature = session(compiled, keeps=False), SIGNATURES[part.model]
    greatest = 0.0
    for batch in (inputs, tuple(tensor[:1] for tensor in inputs)):
        arrays = (tensor.float().contiguous().numpy() for tensor in batch)
        outputs = opened.run(None, dict(zip(signature.inputs, arrays, strict=True)))
        with torch.autocast("cpu", enabled=False):
            expected = as_tuple(part.network(*batch))
        for name, output, reference in zip(signature.outputs, map(torch.from_numpy, outputs), expected, strict=True):
            difference = float(((output - reference).abs() / reference.abs().clamp(min=1)).max())
            if not difference <= TOLERANCE:
                raise InputError(
                    f"the graph of the {part.model!r} differs from torch by {difference:.1e} in {name!r}; nothing was"
                    " written; update torch, onnx and onnxruntime"
                )
            greatest = max(greatest, difference)
    return greatest


def readme(parts: Mapping[str, Exportable], differences: Mapping[str, float]) -> str:
    """Return the folder's README: the graphs, a row for each of their tensors, and how inputs are made of a scan."""
    graphs = [f"| `{role}.onnx` | {part.model} | {differences[role]:.0e} |" for role, part in parts.items()]
    tensors = [row for role, part in parts.items() for row in _tensor_rows(role, part)]
    text = (files("lidar2pano.engines") / "onnx_readme.md").read_text(encoding="utf-8")
    for name, value in (("graphs", "\n".join(graphs)), ("tensors", "\n".join(tensors)), ("opset", str(OPSET))):
        text = text.replace(f"{{{name}}}", value)
    return text


def _tensor_rows(role: str, part: Exportable) -> Iterator[str]:
    """Yield a table's row for each input and output of a graph."""
    signature = SIGNATURES[part.model]
    with torch.inference_mode():
        outputs = as_tuple(part.network(*part.inputs))
    for kind, contents, tensors in (
        ("input", signature.inputs, part.inputs),
        ("output", signature.outputs, outputs),
    ):
        for (name, content), tensor in zip(contents.items(), tensors, strict=True):
            shape = ", ".join(["batch", *map(str, tensor.shape[1:])])
            yield f"| `{role}.onnx` | `{name}` | {kind} | ({shape}) | {content} |"
