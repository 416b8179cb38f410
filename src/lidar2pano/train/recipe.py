"""What a recipe is: everything that decides what a training run does, as frozen dataclasses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from lidar2pano.errors import InputError
from lidar2pano.train.overrides import changed


@dataclass(frozen=True, kw_only=True)
class Optimizer:
    """How one network's weights move.

    schedule  "constant", or "cosine": half a cosine from `rate` to zero over the run.
    warmup    steps over which the rate rises from zero.
    clip      largest norm of a step's gradient; 0 leaves it alone.
    """

    kind: Literal["adam", "adamw"] = "adamw"
    rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine"] = "cosine"
    warmup: int = 0
    clip: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Network:
    """A network by its name in MODELS, its settings, its optimiser, and a weight file to start from ("" = fresh)."""

    model: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    optimizer: Optimizer = field(default_factory=Optimizer)
    start: str = ""


@dataclass(frozen=True, kw_only=True)
class Data:
    """Names of the splits to train on and to score on."""

    train: tuple[str, ...] = ("train",)
    val: tuple[str, ...] = ("val",)


@dataclass(frozen=True, kw_only=True)
class Training:
    """The run. Sizes are totals over all devices.

    steps        how many optimiser steps; minutes: wall clock over all sittings together (0 = no limit). Whichever
                 comes first ends the run, and learning rates follow whichever is further.
    batch        samples per step, taken in `accumulate` turns when they do not fit at once.
    workers      processes per device that prepare samples (0 = the training process does).
    precision    "bf16-mixed" or "32-true"; channels_last: layout of convolution weights.
    ema          decay per step of the averaged weights that are validated and released; 0 = no averaging.
    *_minutes    how often to save, to draw pictures, to validate; 0 = at the end only.
    """

    steps: int = 100_000
    minutes: float = 0.0
    batch: int = 8
    accumulate: int = 1
    workers: int = 4
    seed: int = 0
    precision: Literal["bf16-mixed", "32-true"] = "bf16-mixed"
    channels_last: bool = True
    ema: float = 0.999
    checkpoint_minutes: float = 1.0
    preview_minutes: float = 5.0
    validate_minutes: float = 10.0

    def __post_init__(self) -> None:
        """Refuse sizes that cannot be (InputError)."""
        if self.steps < 1 or self.batch < 1 or self.accumulate < 1 or self.workers < 0:
            raise InputError("training.steps, batch and accumulate must be at least 1 and workers at least 0")
        if self.batch % self.accumulate:
            raise InputError(f"training.batch={self.batch} cannot be taken in accumulate={self.accumulate} equal turns")
        if not 0 <= self.ema < 1:
            raise InputError(f"training.ema={self.ema} must be at least 0 and below 1")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """One training run; `override` changes a copy, `resolved` writes it down.

    name      as in recipes.RECIPES; goes into the card.
    task      as in TASKS; options: what that task can be told, name -> value.
    view      as in VIEWS, on a raster `scale` times as fine.
    networks  name within the task -> Network.
    """

    name: str
    task: str
    view: str
    scale: float = 1.0
    data: Data = field(default_factory=Data)
    networks: Mapping[str, Network]
    options: Mapping[str, Any] = field(default_factory=dict)
    training: Training = field(default_factory=Training)


def on_two_cores(training: Training, *, minutes: float, batch: int, ema: float = 0.998) -> Training:
    """A run of some minutes on a CPU that samples are prepared on as well."""
    return replace(training, minutes=minutes, batch=batch, accumulate=1, workers=0, ema=ema)


def resolved(recipe: Recipe) -> dict[str, Any]:
    """Every value of the recipe, nested, as JSON knows them (tuples become lists)."""
    return _plain(asdict(replace(recipe, networks=dict(recipe.networks), options=dict(recipe.options))))


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


def override(recipe: Recipe, assignment: str) -> Recipe:
    """A copy with one value changed, e.g. "training.batch=8" or "networks.generator.optimizer.betas=0.5,0.9".

    A name that is not there, or a value of another type than the field's, raises InputError.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise InputError(f"{assignment!r} is not of the form name=value, e.g. training.batch=8")
    return changed(recipe, path.strip().split("."), text.strip(), path.strip())
