"""Weights that the authors of the networks published: their torch checkpoints as state dicts of our networks.

Our networks carry the published names, so nothing is renamed; but every tensor of the file must be used up. Only
weights are read: nothing in the file is executed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.images import Normalisation
from lidar2pano.labels import COMMON14, SEMANTIC_KITTI
from lidar2pano.models import build
from lidar2pano.models.card import Card, mismatch
from lidar2pano.sensors import VIEWS


@dataclass(frozen=True, kw_only=True)
class Published:
    """Where users find a network's published weights (`upstream`, an address) and on which terms (`licence`).

    view    name in VIEWS of the range image that the network reads.
    labels  name of the label set that the output channels speak; None for scores.
    """

    upstream: str
    licence: str
    view: str
    labels: str | None


_TITAN = Published(
    upstream="https://github.com/TiagoCortinhal/TITAN-NET",
    licence="none stated for the weights; trained on SemanticKITTI (CC BY-NC-SA 4.0)",
    view="titan-front",
    labels=COMMON14.name,
)
PUBLISHED: dict[str, Published] = {
    "salsanext": Published(
        upstream="https://github.com/TiagoCortinhal/SalsaNext",
        licence="MIT for the code; trained on SemanticKITTI (CC BY-NC-SA 4.0)",
        view="hdl64e",
        labels=SEMANTIC_KITTI.name,
    ),
    "titan": _TITAN,
    "titan-critic": replace(_TITAN, labels=None),
}


class _Bystander:
    """Stands for an object in a checkpoint that is no weight: takes whatever it is given and keeps none of it."""

    def __new__(cls, *_: object) -> _Bystander:
        return object.__new__(cls)

    def __init__(self, *_: object) -> None:
        """Keep nothing."""

    def __setstate__(self, state: object) -> None:
        """Keep nothing."""


class _PlainDict(_Bystander):
    def __new__(cls, *_: object) -> dict:
        return {}


def _stand_in(name: str, kind: type[_Bystander] = _Bystander) -> type:
    module, _, last = name.rpartition(".")
    return type(last, (kind,), {"__module__": module, "__qualname__": last})


# SalsaNext's checkpoints hold the whole warm-up scheduler (common/warmupLR.py) and, through it, the optimizer. Torch
# refuses such a file because of these five names; each is read as an object without content.
_BYSTANDERS: list[Callable | tuple[Callable, str]] = [
    _stand_in("torch.optim.lr_scheduler.CyclicLR"),
    _stand_in("torch.optim.sgd.SGD"),
    _stand_in("builtins.getattr"),  # of a bound method, scheduler.scale_fn
    _stand_in("builtins.dict"),  # the factory of the next
    _stand_in("collections.defaultdict", _PlainDict),
]


def import_published(path: Path | str, network: str) -> dict[str, Tensor]:
    """The state dict, float32 on the CPU, of a published checkpoint for build(network).

    path     torch file: a state dict, or a dict with one under "state_dict"; keys may begin with "module.".
    network  name in PUBLISHED.
    A file that is absent, damaged, hostile or of another network raises InputError; nothing in it is executed.
    """
    if network not in PUBLISHED:
        raise InputError(f"no published weights for network {network!r}{closest(network, PUBLISHED)}")
    state = _read(path)
    state = state.get("state_dict", state)
    if not isinstance(state, Mapping) or not all(isinstance(key, str) for key in state):
        raise InputError(
            f"{path} has no table of weights; give the checkpoint file that {network!r}'s authors published"
        )
    ours = {key.removeprefix("module."): value for key, value in state.items()}
    if len(ours) < len(state):
        raise InputError(f"{path} has the same weights twice, with and without 'module.'; give the authors' file")
    with torch.device("meta"):
        blank = build(network).state_dict()
    if wrong := mismatch(ours, blank):
        raise InputError(f"{path} does not fit the published network {network!r}: {wrong}; give the authors' file")
    return {key: ours[key].detach().to(blank[key].dtype).contiguous() for key in blank}


def published_card(network: str, file: str) -> Card:
    """The card of published weights; `network` in PUBLISHED, `file`: name of the checkpoint they come from."""
    published, normalise = PUBLISHED[network], Normalisation()
    return Card(
        network=network,
        labels=published.labels,
        views={"input": VIEWS[published.view].as_dict()},
        normalisation={"mean": list(normalise.mean), "deviation": list(normalise.deviation)},
        recipe=f"published ({file})",
        data="SemanticKITTI",
        licence=published.licence,
        upstream=published.upstream,
    )


def _read(path: Path | str) -> Mapping:
    if not Path(path).is_file():
        raise InputError(f"no checkpoint file {path}; check the path")
    try:
        with torch.serialization.safe_globals(_BYSTANDERS):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # a broken or hostile file can break torch's restricted reader anywhere
        raise InputError(
            f"{path} cannot be read as weights: it is cut off, no torch checkpoint, or holds more than weights; "
            "fetch it anew from its authors"
        ) from None
    if not isinstance(content, Mapping):
        raise InputError(f"{path} has no table of weights; give the checkpoint file that the authors published")
    return content
