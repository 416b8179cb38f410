"""A run's folder: recipe, last checkpoint and weight files, each complete or not there.

RUN/recipe.json                       every value of the recipe; "files": SHA-256 of the weight files named in it
RUN/weights/<network>.safetensors     the best released weights; <network>.last.safetensors: the last
RUN/checkpoints/<step>/               one folder, the newest
    weights.safetensors               "network/<name>/<key>", "average/<name>/<key>"; of the task's own "memory/<key>"
    optimizers.pt                     name -> state (loads without executing anything)
    state.json                        Progress
"""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

try:
    import fcntl
except ModuleNotFoundError:
    fcntl = None

from lidar2pano import __version__
from lidar2pano.bounded_files import sha256_of
from lidar2pano.data.layouts import locate_split
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_text
from lidar2pano.formats.json_files import read_json, validated
from lidar2pano.formats.torch_files import load_torch, read_tensors
from lidar2pano.models.card import Card
from lidar2pano.train.recipe import Network, Recipe, Training, resolved

FREE = {f"training.{name}" for name in ("workers", "checkpoint_minutes", "preview_minutes", "validate_minutes")}
LIMITS = ("training.steps", "training.epochs", "training.minutes")  # may grow
MOST_NAMED = 12  # differences between recipes
CHECKPOINT = re.compile(r"[0-9]{9,18}(\.old)?")  # names of folders
OURS = re.compile(r"[0-9]{9,18}(\.old|\.part)?")  # and of unfinished ones
BROKEN = (SafetensorError, pickle.UnpicklingError, RuntimeError)  # RecursionError is one, too


@dataclass
class Progress:
    """Progress of a run.

    step       optimiser steps done; seconds: wall clock used, over all sittings.
    validated  the step of the last validation, finished: the step of completion (-1: none yet).
    best       the best score so far, None before the first;  looks: how often the validation splits were scored.
    """

    step: int = 0
    seconds: float = 0.0
    validated: int = -1
    finished: int = -1
    best: float | None = None
    looks: int = 0

    def __post_init__(self) -> None:
        """Refuse negative counts (ValueError)."""
        if min(self.step, self.seconds, self.looks) < 0 or min(self.validated, self.finished) < -1:
            raise ValueError("counts of steps or seconds are negative")

    def share(self, training: Training) -> float:
        """Return the completed share of a budget, 0 to 1 and over."""
        used = self.seconds / (60 * training.minutes) if training.minutes > 0 else 0.0
        return max(self.step / training.steps, used)


def check_recipe(run: Path, recipe: Recipe) -> None:
    """Make the run's folder, or compare the recipe with that of its checkpoint.

    Steps and minutes may grow, and values without effect on the result (FREE) may change; any other difference raises
    InputError and is named, as does a folder without permission to write.
    """
    if run.exists() and not run.is_dir():
        raise InputError(f"{run} is a file; name a folder for the run")
    with writing(run):
        run.mkdir(parents=True, exist_ok=True)
    if not os.access(run, os.W_OK | os.X_OK):
        raise InputError(f"{run}: cannot be written (permission denied); name another folder")
    path = run / "recipe.json"
    if not path.exists() or not newest_checkpoint(run):
        return
    recorded = read_json(path, "repair it or train into another folder")
    if not isinstance(recorded, dict):
        raise InputError(f"{path}: holds no recipe; repair it or train into another folder")
    hashes, now = recorded.pop("files", {}), _flat(resolved(recipe))
    previous = _defaults(recipe) | _flat(recorded)  # recipes had fewer values when the run began
    if isinstance(hashes, dict):  # the same weights may lie elsewhere
        previous |= {name: now[name] for name, digest in _hashes(now).items() if hashes.get(name) == digest}
    if changed := _differences(previous, now):
        named = "; ".join(f"{change:.120}" for change in changed[:MOST_NAMED])
        raise InputError(
            f"{run} holds a run of another recipe ({named}); repeat the command as it was or train into another folder"
        )


@contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Lock the run's folder against other processes of this machine; InputError when it is locked already.

    The folder itself is locked, so that nothing is left of it however a process ends. On a file system without
    locks, a second process is not refused.
    """
    if fcntl is None:  # not on Windows
        yield
        return
    folder = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{run}: another process trains into it; wait for its end, or choose another --out"
            ) from None
        except OSError:
            pass
        yield
    finally:
        os.close(folder)


def write_recipe(run: Path, recipe: Recipe) -> None:
    """Write every value of the recipe to RUN/recipe.json, and the hashes of the weight files named in it."""
    values = resolved(recipe)
    hashes = _hashes(_flat(values))
    text = json.dumps(values | ({"files": hashes} if hashes else {}), indent=2) + "\n"
    write_text(run / "recipe.json", text)


def _hashes(values: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the weight files among a recipe's values, by the values' flat names."""
    files = {name: Path(value) for name, value in values.items() if str(value).endswith(".safetensors")}
    return {name: sha256_of(file) for name, file in files.items() if file.is_file()}


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in tree.items():
        path = f"{prefix}{name}"
        values |= _flat(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return values


def _defaults(recipe: Recipe) -> dict[str, Any]:
    """Default values of a recipe of this task, by their flat names."""
    networks = {name: Network(model=network.model) for name, network in recipe.networks.items()}
    plain = resolved(replace(recipe, networks=networks, training=Training(), options=type(recipe.options)()))
    return _flat({part: plain[part] for part in ("training", "options", "networks")})


def _differences(previous: Mapping[str, Any], present: Mapping[str, Any]) -> list[str]:
    """Differences that keep a run from going on, as "name: old -> new"."""
    changed = []
    for name in sorted(previous.keys() | present.keys()):
        old, new = previous.get(name), present.get(name)
        if name in FREE and old is not None and new is not None:
            continue
        if name in LIMITS and isinstance(old, int | float) and isinstance(new, int | float):
            grown = new == 0 or 0 < old <= new if name == "training.minutes" else new >= old > 0
            if grown:
                continue
        if old != new:
            changed.append(f"{name}: {'absent' if old is None else old} -> {'absent' if new is None else new}")
    return changed


def save_checkpoint(
    run: Path, progress: Progress, weights: Mapping[str, Tensor], optimizers: Mapping[str, dict]
) -> Path:
    """Write a checkpoint of `progress.step` and remove older ones; interrupted anywhere, the last one stays.

    A weight without finite values raises FloatingPointError and changes nothing.
    """
    check_weights(weights, progress.step)
    folder = run / "checkpoints"
    final, part = folder / f"{progress.step:09d}", folder / f"{progress.step:09d}.part"
    shutil.rmtree(part, ignore_errors=True)
    try:
        with writing(part):
            part.mkdir(parents=True)
            ours = {name: value.detach().to("cpu", copy=True).contiguous() for name, value in weights.items()}
            save_file(ours, part / "weights.safetensors")
            torch.save(dict(optimizers), part / "optimizers.pt")
            (part / "state.json").write_text(json.dumps(asdict(progress)), encoding="utf-8")
            for file in part.iterdir():
                with file.open("rb+") as written:
                    os.fsync(written.fileno())
            _exchange(part, final)
    except InputError:
        shutil.rmtree(part, ignore_errors=True)  # a full disk needs the room
        raise
    return final


def _exchange(part: Path, final: Path) -> None:
    """Make `part` the folder `final` and remove every other checkpoint."""
    folder = final.parent
    if final.exists():  # the same step again, with another clock or score
        aside = folder / f"{final.name}.old"
        shutil.rmtree(aside, ignore_errors=True)
        final.replace(aside)
    part.replace(final)
    remove_others(final)


def remove_others(final: Path) -> None:
    """Remove every checkpoint but `final`, finished or not; folders of other names are not ours."""
    for folder in final.parent.iterdir():
        if folder != final and OURS.fullmatch(folder.name):
            shutil.rmtree(folder, ignore_errors=True)


def check_weights(weights: Mapping[str, Tensor], step: int) -> None:
    """Raise FloatingPointError for a weight with NaN or infinity."""
    if broken := [name for name, value in weights.items() if value.is_floating_point() and not value.isfinite().all()]:
        raise FloatingPointError(f"{broken[0]} is not finite after step {step}; the last checkpoint is sound")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn refusals of the system (a full disk, a folder removed by another process) into InputError."""
    try:
        yield
    except (OSError, RuntimeError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        raise InputError(f"{path}: cannot be written ({reason}); mend that and repeat the command to go on") from None


@contextmanager
def reading(checkpoint: Path) -> Iterator[None]:
    """Turn any trouble with a checkpoint's files into InputError."""
    try:
        yield
    except (InputError, OSError, EOFError, ValueError, LookupError, TypeError, FloatingPointError, *BROKEN) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{checkpoint} is damaged ({reason}); remove it to start again") from None


def newest_checkpoint(run: Path) -> Path | None:
    """The folder of the run's last checkpoint, if there is one."""
    folder = run / "checkpoints"
    folders = [path for path in folder.iterdir() if CHECKPOINT.fullmatch(path.name)] if folder.is_dir() else []
    return max(folders, key=lambda path: (int(path.stem), path.suffix == ""), default=None)


def read_progress(run: Path) -> Progress | None:
    """Return the progress of the run's newest checkpoint, None if there is none; InputError if it is damaged."""
    newest = newest_checkpoint(run)
    if newest is None:
        return None
    with reading(newest):
        return validated(Progress, read_json(newest / "state.json", "it was not written whole"), "state.json")


def load_checkpoint(run: Path) -> tuple[Progress, dict[str, Tensor], dict[str, dict]] | None:
    """The run's newest checkpoint (tensors on the CPU), or None; a damaged one raises InputError."""
    newest, progress = newest_checkpoint(run), read_progress(run)
    if newest is None or progress is None:
        return None
    with reading(newest):
        weights = read_tensors(newest / "weights.safetensors", "it cannot be resumed")
        check_weights(weights, progress.step)
        return progress, weights, load_torch(newest / "optimizers.pt")


def make_card(spec: Network, task_fields: Mapping[str, Any], run_fields: Mapping[str, Any]) -> Card:
    """The card of a network built from `spec`: the task's fields, overridden by the run's."""
    settings = {key: list(value) if isinstance(value, tuple) else value for key, value in spec.settings.items()}
    return Card(**{"network": spec.model, "settings": settings, "commit": commit(), **task_fields, **run_fields})


def trained_on(root: Path, splits: Iterable[str]) -> str:
    """Names of the splits' data sets, joined by "+": `root`'s, and those of FOLDER:split."""
    return "+".join(dict.fromkeys(locate_split(root, name)[0].resolve().name for name in splits))


def commit() -> str:
    """The running commit of the project, "-dirty" when files differ from it; the package's version outside of git."""
    folder = Path(__file__).parent
    try:
        git = ["git", "-C", str(folder)]
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], check=True, capture_output=True)
        described = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return __version__
    return described.stdout.strip()
