"""What a run leaves on disk to go on from: its recipe and the last checkpoint, each complete or not there.

RUN/recipe.json                       every value of the recipe
RUN/checkpoints/<step>/               one folder, the newest
    weights.safetensors               "network/<name>/<key>" and "average/<name>/<key>"
    optimizers.pt                     name -> state (loads without executing anything)
    state.json                        Progress
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lidar2pano.errors import InputError
from lidar2pano.train.recipe import Recipe, resolved

FREE = {f"training.{name}" for name in ("workers", "checkpoint_minutes", "preview_minutes", "validate_minutes")}
BROKEN = (SafetensorError, pickle.UnpicklingError)


@dataclass
class Progress:
    """How far a run is.

    step       optimiser steps done; seconds: wall clock used, over all sittings.
    validated  the step of the last validation, finished: the step after which the run was complete (-1: none yet).
    best       the best score so far, None before the first.
    """

    step: int = 0
    seconds: float = 0.0
    validated: int = -1
    finished: int = -1
    best: float | None = None


def check_recipe(run: Path, recipe: Recipe) -> None:
    """Compare the recipe with the one that the run's folder holds already.

    More steps or minutes than before, and what does not touch the result (FREE), may change; any other difference
    raises InputError and says what differs.
    """
    if run.exists() and not run.is_dir():
        raise InputError(f"{run} is a file; name a folder for the run")
    path = run / "recipe.json"
    if not path.exists():
        return
    try:
        before = _flat(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, AttributeError):
        raise InputError(f"{path} is damaged; mend it or train into another folder") from None
    if changed := _differences(before, _flat(resolved(recipe))):
        raise InputError(
            f"{run} holds a run of another recipe ({'; '.join(changed)}); "
            "repeat the command as it was or train into another folder"
        )


def write_recipe(run: Path, recipe: Recipe) -> None:
    """Write every value of the recipe to RUN/recipe.json."""
    run.mkdir(parents=True, exist_ok=True)
    beside = run / ".recipe.json"
    beside.write_text(json.dumps(resolved(recipe), indent=2) + "\n", encoding="utf-8")
    beside.replace(run / "recipe.json")


def _flat(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in tree.items():
        path = f"{above}{name}"
        values |= _flat(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return values


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What keeps a run from going on, as "name: old -> new"."""
    changed = []
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name), now.get(name)
        if name in FREE and old is not None and new is not None:
            continue
        if name == "training.steps" and old is not None and new is not None and new >= old:
            continue
        if name == "training.minutes" and old is not None and new is not None and (new == 0 or 0 < old <= new):
            continue
        if old != new:
            changed.append(f"{name}: {'absent' if old is None else old} -> {'absent' if new is None else new}")
    return changed


def save_checkpoint(
    run: Path, progress: Progress, weights: Mapping[str, Tensor], optimizers: Mapping[str, dict]
) -> Path:
    """Write a checkpoint of `progress.step` and remove older ones; interrupted anywhere, the last one stays.

    A weight that is not finite raises FloatingPointError and changes nothing.
    """
    if broken := [name for name, value in weights.items() if value.is_floating_point() and not value.isfinite().all()]:
        raise FloatingPointError(f"{broken[0]} is not finite after step {progress.step}; the last checkpoint is sound")
    folder = run / "checkpoints"
    final, beside = folder / f"{progress.step:09d}", folder / f"{progress.step:09d}.part"
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    save_file({name: value.detach().to("cpu", copy=True).contiguous() for name, value in weights.items()},
              beside / "weights.safetensors")  # fmt: skip
    torch.save(dict(optimizers), beside / "optimizers.pt")
    (beside / "state.json").write_text(json.dumps(asdict(progress)), encoding="utf-8")
    for file in beside.iterdir():
        with file.open("rb+") as written:
            os.fsync(written.fileno())
    if final.exists():  # the same step again, with another clock or score
        aside = folder / f"{final.name}.old"
        shutil.rmtree(aside, ignore_errors=True)
        final.replace(aside)
    beside.replace(final)
    for other in folder.iterdir():
        if other != final:
            shutil.rmtree(other, ignore_errors=True)
    return final


def load_checkpoint(run: Path) -> tuple[Progress, dict[str, Tensor], dict[str, dict]] | None:
    """The run's newest checkpoint (tensors on the CPU), or None; a damaged one raises InputError."""
    folder = run / "checkpoints"
    found = [path for path in folder.glob("[0-9]*") if path.suffix in ("", ".old")] if folder.is_dir() else []
    if not found:
        return None
    newest = max(found, key=lambda path: (int(path.stem), path.suffix == ""))
    try:
        progress = Progress(**json.loads((newest / "state.json").read_text(encoding="utf-8")))
        weights = load_file(newest / "weights.safetensors")
        optimizers = torch.load(newest / "optimizers.pt", map_location="cpu", weights_only=True)
    except (OSError, EOFError, ValueError, LookupError, TypeError, RuntimeError, *BROKEN) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{newest} is damaged ({reason}); remove it to start anew") from None
    return progress, weights, optimizers
