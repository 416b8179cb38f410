"""Torch files of strangers: their tables of weights, and nothing else. Nothing in them is executed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from lidar2pano.errors import InputError


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


# SalsaNext's checkpoints hold the whole warm-up scheduler (common/warmupLR.py) and, through it, the optimizer; SD-Net's
# hold the score of their epoch as a number of numpy's. Torch refuses such files because of these names; each is read as
# an object without content.
_BYSTANDERS: list[Callable | tuple[Callable, str]] = [
    _stand_in("torch.optim.lr_scheduler.CyclicLR"),
    _stand_in("torch.optim.sgd.SGD"),
    _stand_in("builtins.getattr"),  # of a bound method, scheduler.scale_fn
    _stand_in("builtins.dict"),  # the factory of the next
    _stand_in("collections.defaultdict", _PlainDict),
    _stand_in("numpy.core.multiarray.scalar"),
    _stand_in("numpy._core.multiarray.scalar"),  # its name since numpy 2
    _stand_in("numpy.dtype"),
]


def read_table(path: Path) -> dict[str, object]:
    """The table of weights in a torch file: a state dict, or one under "state_dict"; "module." is taken off its keys.

    Raises InputError for a file that is absent, damaged or hostile, or has no such table; nothing in it is executed.
    """
    table = _content(path)
    table = table.get("state_dict", table)
    if not isinstance(table, Mapping) or not all(isinstance(key, str) for key in table):
        raise InputError(f"{path} has no table of weights; give the checkpoint file that the authors published")
    bare = {key.removeprefix("module."): value for key, value in table.items()}
    if len(bare) < len(table):
        raise InputError(f"{path} has the same weights twice, with and without 'module.'; give the authors' file")
    return bare


def _content(path: Path) -> Mapping:
    if not path.is_file():
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


def scale_files(folder: Path) -> list[Path]:
    """Vid2vid's files of one generator in a folder, "<epoch>_net_G<scale>.pth" per scale; of several, "latest".

    Raises InputError when there is none, or when it is not clear which.
    """
    epochs: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*_net_G[0-9].pth")):
        epochs.setdefault(re.sub(r"_net_G\d\.pth$", "", path.name), []).append(path)
    if not epochs:
        raise InputError(f"{folder}: holds no *_net_G0.pth; name the files of the generator")
    if len(epochs) > 1 and "latest" not in epochs:
        raise InputError(f"{folder}: holds generators of several epochs ({', '.join(epochs)}); name the files of one")
    return epochs["latest"] if "latest" in epochs else next(iter(epochs.values()))
