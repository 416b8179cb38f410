"""Weight files: a network's tensors and their card, in one safetensors file.

The card is JSON in the file's metadata under "card". Loading is strict and executes nothing: the network comes from
MODELS by name, every key and shape must fit, and a checksum over the tensors must agree with the card.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import torch.nn.init
from safetensors.torch import save as serialise
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import write_text, write_whole
from lidar2pano.formats.json_files import parse_json, read_json, validated
from lidar2pano.formats.torch_files import read_weights
from lidar2pano.labels import LABEL_SETS
from lidar2pano.models import MODELS, build
from lidar2pano.views import MOST_PIXELS

SCORES = "scores.json"  # beside weight files, so that measuring leaves them alone: scores by checksum of the tensors
# Most calls of torch's functions while a network is built; ours make 4 to 33 calls a tensor.
MOST_CALLS, CALLS_PER_TENSOR = 2000, 40


@dataclass(frozen=True, kw_only=True)
class Card:
    """Contents and origin of a weight file; `from_json` checks the types of fields.

    network        name in MODELS
    settings       keyword arguments of build(network, ...)
    labels         name of the label set of the output channels; None for pictures and scores
    views          View.as_dict() of each image the network takes or gives, by its role
    normalisation  of the input, e.g. {"mean": [...], "std": [...]}
    recipe         name of the training recipe; commit of this project at the time
    data           training data; steps: number of batches; device; hours of training
    score          measured quality, by name, with the split it was measured on; that of SCORES beside the file, if any
    licence        of the weights; upstream: address of its publisher
    sha256         checksum of the tensors; `save` fills it in
    """

    network: str
    settings: dict = field(default_factory=dict)
    labels: str | None = None
    views: dict[str, dict] = field(default_factory=dict)
    normalisation: dict = field(default_factory=dict)
    recipe: str = ""
    commit: str = ""
    data: str = ""
    steps: int = 0
    device: str = ""
    hours: float = 0.0
    score: dict = field(default_factory=dict)
    licence: str = ""
    upstream: str = ""
    sha256: str = ""

    def to_json(self) -> str:
        """The card as one JSON object; NaN and infinity raise ValueError."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Card:
        """The card in `text`; broken JSON, unknown or missing fields and wrong types raise InputError."""
        mend = "fetch or make the file again"
        card = validated(cls, parse_json(text, "its card", mend), "its card", mend)
        if card.labels is not None and card.labels not in LABEL_SETS:
            raise InputError(f"its card: no label set {card.labels!r}{closest(card.labels, LABEL_SETS)}; {mend}")
        for role, view in card.views.items():
            sizes = [view.get("rows"), view.get("columns")]
            if not all(type(size) is int and 0 < size <= MOST_PIXELS for size in sizes):
                raise InputError(f"its card: its view {role!r} needs rows and columns, a whole number each; {mend}")
        return card


def save(path: Path | str, model: nn.Module, card: Card, dtype: torch.dtype = torch.float16) -> Card:
    """Write `model` and `card` to `path` and return the card with its checksum.

    dtype  float16 or float32 for convolution and matrix weights. Vectors (biases, norms and their statistics) stay
           float32, and so does a weight beyond float16: they are small and some leave its range.
    The file appears complete or not at all. A card of another model, or weights with NaN or infinity, raise ValueError.
    """
    path = Path(path)
    if dtype not in (torch.float16, torch.float32):
        raise ValueError(f"weights are stored as float16 or float32, not {dtype}")
    tensors = {key: _stored(key, tensor, dtype) for key, tensor in model.state_dict().items()}
    if wrong := mismatch(tensors, _blank(card, len(tensors)).state_dict()):
        raise ValueError(f"the card's network {card.network!r} does not describe the model: {wrong}")
    text = replace(card, sha256=_checksum(tensors)).to_json()
    write_whole(path, lambda part: part.write_bytes(serialise(tensors, metadata={"format": "pt", "card": text})))
    return Card.from_json(text)


def load(path: Path | str, device: torch.device | str = "cpu", expect: str | None = None) -> tuple[nn.Module, Card]:
    """The network in `path`, in evaluation mode with float32 weights, and its card.

    expect  name of the required network, if any.
    Anything wrong with the file raises InputError.
    """
    card, tensors = _read(path)
    if expect is not None and card.network != expect:
        raise InputError(f"{path} has weights of another network: {card.network!r} instead of {expect!r}")
    try:
        model = _blank(card, len(tensors))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if wrong := mismatch(tensors, model.state_dict()):
        raise InputError(f"{path} does not fit network {card.network!r}: {wrong}; fetch or make the file again")
    if broken := next((key for key, tensor in tensors.items() if not tensor.isfinite().all()), None):
        raise InputError(f"{path}: {broken!r} has values that are not finite; fetch or make the file again")
    if card.sha256 != _checksum(tensors):
        raise InputError(f"{path} was changed or damaged: its checksum is wrong; fetch or make the file again")
    model.load_state_dict({key: _own(tensor) for key, tensor in tensors.items()}, assign=True)
    return model.to(device).eval(), card


def read_card(path: Path | str) -> Card:
    """The card of a weight file, without its tensors; anything wrong with file or card raises InputError."""
    return _read(path, with_tensors=False)[0]


def _read(path: Path | str, with_tensors: bool = True) -> tuple[Card, dict[str, Tensor]]:
    if not Path(path).is_file():
        raise InputError(f"no weight file {path}; check the path")
    tensors, texts = read_weights(Path(path), with_tensors=with_tensors)
    text = texts.get("card")
    if not isinstance(text, str):
        raise InputError(f"{path} has no card, so lidar2pano did not write it; fetch or make it again")
    try:
        card = Card.from_json(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return replace(card, score=_scores_beside(Path(path)).get(card.sha256, card.score)), tensors


@dataclass(frozen=True, kw_only=True)
class _Scores:
    scores: dict[str, dict]  # by checksum


def write_scores(folder: Path, cards: Iterable[Card]) -> None:
    """Write the scores of cards into a folder's file SCORES, where `read_card` and `load` find them."""
    content = asdict(_Scores(scores={card.sha256: card.score for card in cards if card.score}))
    write_text(folder / SCORES, json.dumps(content, indent=1, allow_nan=False) + "\n", "folder")


def _scores_beside(path: Path) -> dict[str, dict]:
    """Return the scores in the file SCORES beside a weight file, by the checksum of the tensors; none without it."""
    if not (file := path.with_name(SCORES)).is_file():
        return {}
    mend = "remove it, or fetch it again"
    return validated(_Scores, read_json(file, mend), str(file), mend).scores


class _Uninitialised(TorchFunctionMode):
    """A context for building networks without random numbers: those of a file follow.

    Drawing takes long; on the device "meta" it can import torch's compiler, the longest of all.
    tensors  of the network: a multiple of calls of torch's functions raises InputError, against settings of a
             network without end.
    """

    def __init__(self, tensors: int) -> None:
        super().__init__()
        self._calls_left = MOST_CALLS + CALLS_PER_TENSOR * tensors

    def __torch_function__(self, func, types, args=(), kwargs=None):  # noqa: ANN001, ANN204, ARG002 as torch calls it
        self._calls_left -= 1
        if self._calls_left < 0:
            raise InputError("its settings are those of a far larger network; fetch or make the file again")
        if getattr(func, "__module__", "") == torch.nn.init.__name__:
            return args[0] if args else (kwargs or {})["tensor"]
        return func(*args, **(kwargs or {}))


def _blank(card: Card, tensors: int) -> nn.Module:
    """The card's network without memory for its tensors, on the device "meta"; a wrong card raises InputError."""
    if card.network not in MODELS:
        raise InputError(f"no network {card.network!r}{closest(card.network, MODELS)}; update lidar2pano")
    with torch.device("meta"), _Uninitialised(tensors):  # settings must not be able to fill the memory
        return build(card.network, **card.settings)


def _own(tensor: Tensor) -> Tensor:
    """A file's tensor in memory of its own; float32 for floating point, as in networks."""
    return tensor.to(torch.float32 if tensor.is_floating_point() else tensor.dtype, copy=True)


def mismatch(tensors: Mapping[str, object], blank: Mapping[str, Tensor]) -> str:
    """Describe the first misfit of `tensors` as the state of a network like `blank`; empty if all fits.

    Keys and shapes must be equal; floating point may be float16 or float32, every other type must be equal.
    """
    if missing := sorted(blank.keys() - tensors.keys()):
        return f"{len(missing)} tensors are missing, the first is {missing[0]!r}"
    if extra := sorted(tensors.keys() - blank.keys()):
        return f"{len(extra)} tensors are unexpected, the first is {extra[0]!r}"
    for key, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or tensor.is_meta:
            return f"{key!r} is no plain tensor"
        if tensor.shape != blank[key].shape:
            return f"{key!r} has shape {list(tensor.shape)}, expected {list(blank[key].shape)}"
        good = {torch.float16, torch.float32} if blank[key].is_floating_point() else {blank[key].dtype}
        if tensor.dtype not in good:
            return f"{key!r} is of type {tensor.dtype}"
    return ""


def _stored(key: str, tensor: Tensor, dtype: torch.dtype) -> Tensor:
    tensor = tensor.detach().to("cpu", copy=True).contiguous()
    if not tensor.is_floating_point():
        return tensor
    if not tensor.isfinite().all():
        raise ValueError(f"{key!r} has values that are not finite; the training has diverged")
    fits = tensor.ndim > 1 and tensor.abs().max() <= torch.finfo(dtype).max
    return tensor.to(dtype if fits else torch.float32)


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over name, type, shape and bytes of every tensor, in the order of their names."""
    digest = hashlib.sha256()
    for key in sorted(tensors):
        tensor = tensors[key].contiguous()
        digest.update(f"{key} {tensor.dtype} {list(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
