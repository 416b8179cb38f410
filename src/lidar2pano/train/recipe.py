"""Recipes: everything that decides a training run, as frozen dataclasses; changes of one value by its name.

No torch is imported here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Generic, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from lidar2pano.errors import InputError, closest
from lidar2pano.views import VIEWS

LARGEST_SIZE = 65_536  # pixels, channels, samples
LARGEST = 1e6  # of weights of losses, degrees, exponents, minutes
NO_LIMIT = 100_000_000  # steps; epochs or minutes end the run
LARGEST_RATE = 10.0  # of learning; the recipes' are below 0.01
MOST_STEPS = 1e9
MOST_WORKERS = 1024
Value = bool | int | float | str | tuple
SWITCH = {"true": True, "false": False}
LARGEST_WHOLE = 2**53  # whole numbers exact in float64


def check_range(owner: str, least: float, most: float, **values: float | tuple[float, ...]) -> None:
    """Raise InputError for the first value (or part of a tuple) outside `least` to `most`."""
    for name, value in values.items():
        for number in value if isinstance(value, tuple) else (value,):
            if not least <= number <= most:
                raise InputError(f"{owner}.{name}={number:g} must be at least {least:g} and at most {most:g}")


@dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Options of one task; numbers lie between 0 and LARGEST, those whose names end in _probability at most at 1.

    task   the task's name in `tasks.TASKS`;  SIZES: names of sizes, 1 to LARGEST_SIZE.
    """

    task: ClassVar[str]
    SIZES: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Refuse values out of range (InputError)."""
        for name in (option.name for option in fields(self)):
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(isinstance(number, int | float) for number in numbers):
                continue
            least, most = (1, LARGEST_SIZE) if name in self.SIZES else (0, LARGEST)
            if name.endswith("_probability"):
                most = 1
            check_range("options", least, most, **{name: numbers})


Options_co = TypeVar("Options_co", bound=TaskOptions, covariant=True)


@dataclass(frozen=True, kw_only=True)
class Optimizer:
    """The optimiser of one network.

    algorithm "sgd" takes the first of `betas` as its momentum.
    schedule  "constant"; "cosine": half a cosine from `rate` to zero over the run; "linear": constant for the first
              half of the run, then linearly to zero; "exponential": `rate` times `final` ** (the completed share).
    warmup    steps of rise from zero.
    clip      largest norm of a step's gradient; 0 = no clipping.
    """

    algorithm: Literal["adam", "adamw", "sgd"] = "adamw"
    rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine", "linear", "exponential"] = "cosine"
    final: float = 0.0
    warmup: int = 0
    clip: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values out of range (InputError)."""
        check_range("optimizer", 0, LARGEST_RATE, rate=self.rate, weight_decay=self.weight_decay, final=self.final)
        check_range("optimizer", 0, MOST_STEPS, warmup=self.warmup, clip=self.clip)
        check_range("optimizer", 0, 1 - 1e-9, betas=self.betas)


@dataclass(frozen=True, kw_only=True)
class Network:
    """A network by its name in MODELS, its settings and its optimiser.

    start        a weight file to start from ("" = fresh);  start_share: the share of its weights in what is released.
    """

    model: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    optimizer: Optimizer = field(default_factory=Optimizer)
    start: str = ""
    start_share: float = 0.0

    def __post_init__(self) -> None:
        """Refuse settings beyond those of any network (InputError); each network checks its own."""
        check_range("networks", 0, 1, start_share=self.start_share)
        for name, value in self.settings.items():
            numbers = tuple(value) if isinstance(value, list | tuple) else (value,)
            if all(isinstance(number, int | float) for number in numbers):
                check_range("settings", -LARGEST, LARGEST_SIZE, **{name: numbers})


@dataclass(frozen=True, kw_only=True)
class Data:
    """Names of the splits to train on and to score on."""

    train: tuple[str, ...] = ("train",)
    val: tuple[str, ...] = ("val",)

    def __post_init__(self) -> None:
        """Refuse a run without data (InputError)."""
        if not self.train or not self.val:
            raise InputError("data.train and data.val must name at least one split each")


@dataclass(frozen=True, kw_only=True)
class Training:
    """The run. Sizes are totals over all devices.

    steps        number of optimiser steps; epochs: passes over the training samples; minutes: wall clock over all
                 sittings together. Whichever comes first ends the run, and learning rates follow whichever is further;
                 0 epochs or minutes are no limit.
    batch        samples per step, in `accumulate` micro-batches.
    workers      processes per device for samples (0 = the training process does).
    precision    "bf16-mixed" or "32-true"; channels_last: layout of convolution weights, but in float32 on a CPU.
    compile      whether torch.compile makes the steps of the released networks: some two minutes before the first step,
                 then up to twice as many steps a minute. Critics are not compiled, nor is validation.
    ema          decay per step of the averaged weights for validation and release; 0 = no averaging.
    *_minutes    from the end of one checkpoint, preview or validation to the next; 0 = at the end only. They are
                 rarer where checkpoints or previews would take more than a twentieth of the time, or validation more
                 than three twentieths.
    """

    steps: int = 100_000
    epochs: float = 0.0
    minutes: float = 0.0
    batch: int = 8
    accumulate: int = 1
    workers: int = 4
    seed: int = 0
    precision: Literal["bf16-mixed", "32-true"] = "bf16-mixed"
    channels_last: bool = True
    compile: bool = False
    ema: float = 0.999
    checkpoint_minutes: float = 1.0
    preview_minutes: float = 5.0
    validate_minutes: float = 10.0

    def __post_init__(self) -> None:
        """Refuse values out of range (InputError); `environment.shared` compares batch and accumulate."""
        check_range("training", 1, MOST_STEPS, steps=self.steps)
        check_range("training", 1, LARGEST_SIZE, batch=self.batch, accumulate=self.accumulate)
        check_range("training", 0, MOST_WORKERS, workers=self.workers)
        check_range("training", 0, 2**53, seed=self.seed)
        check_range("training", 0, 1 - 1e-9, ema=self.ema)
        minutes = ("minutes", "epochs", "checkpoint_minutes", "preview_minutes", "validate_minutes")
        check_range("training", 0, LARGEST, **{name: getattr(self, name) for name in minutes})


@dataclass(frozen=True, kw_only=True)
class Recipe(Generic[Options_co]):
    """One training run; `override` changes a copy, `resolved` writes it down.

    name      as in recipes.RECIPES; goes into the card.
    view      as in VIEWS, on a raster `scale` times as fine.
    networks  name within the task -> Network.
    options   of the task; their class decides the task.
    """

    name: str = ""
    view: str
    scale: float = 1.0
    data: Data = field(default_factory=Data)
    networks: Mapping[str, Network]
    options: Options_co
    training: Training = field(default_factory=Training)

    def __post_init__(self) -> None:
        """Refuse an unknown view and a raster without pixels (InputError)."""
        if self.view not in VIEWS:
            raise InputError(f"no view {self.view!r}{closest(self.view, VIEWS)}")
        check_range("recipe", 1e-3, 64, scale=self.scale)
        try:
            VIEWS[self.view].scaled(self.scale)
        except ValueError:
            raise InputError(f"recipe.scale={self.scale:g} makes no raster of {self.view!r}; choose another") from None

    @property
    def task(self) -> str:
        """The task's name in `tasks.TASKS`."""
        return self.options.task


def resolved(recipe: Recipe) -> dict[str, Any]:
    """Every value of the recipe, nested, as JSON represents them (tuples become lists)."""
    return json.loads(json.dumps({**asdict(replace(recipe, networks=dict(recipe.networks))), "task": recipe.task}))


def override(recipe: Recipe, assignment: str) -> Recipe:
    """A copy with one value changed, e.g. "training.batch=8" or "networks.generator.optimizer.betas=0.5,0.9".

    An unknown name, a value of another type than the field's or one out of its range raises InputError.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise InputError(f"{assignment!r} is not of the form name=value, e.g. training.batch=8")
    return changed(recipe, path.strip().split("."), text.strip(), path.strip())


def vary(
    recipe: Recipe[Options_co], *, options: Mapping[str, Any] | None = None, **settings: Mapping[str, Any]
) -> Recipe:
    """A copy with other options and, by network, other settings: vary(titan(), options={"lovasz": 0}, critic={...})."""
    networks = dict(recipe.networks)
    for role, changes in settings.items():
        networks[role] = replace(networks[role], settings={**networks[role].settings, **changes})
    return replace(recipe, networks=networks, options=replace(recipe.options, **(options or {})))


def with_optimizers(recipe: Recipe[Options_co], *roles: str, **changes: Any) -> Recipe[Options_co]:  # noqa: ANN401
    """A copy with other values of the optimisers of some networks, or of all: with_optimizers(titan(), rate=1e-3)."""
    networks = {
        role: replace(network, optimizer=replace(network.optimizer, **changes))
        if not roles or role in roles
        else network
        for role, network in recipe.networks.items()
    }
    return replace(recipe, networks=networks)


def on_two_cores(
    recipe: Recipe[Options_co],
    *,
    minutes: float,
    batch: int,
    ema: float = 0.998,
    **training: Any,  # noqa: ANN401
) -> Recipe[Options_co]:
    """The recipe as a run of some minutes on two CPU cores, samples included."""
    changes = {"epochs": 0.0, "minutes": minutes, "batch": batch, "accumulate": 1, "workers": 0, "ema": ema, **training}
    return replace(recipe, training=replace(recipe.training, **changes))


def changed(node: Any, steps: list[str], text: str, path: str) -> Any:  # noqa: ANN401
    """A copy of `node` with the value at `steps` below it parsed from `text`; `path` is its full name in messages."""
    name, *rest = steps
    if is_dataclass(node):
        values: Any = {part.name: getattr(node, part.name) for part in fields(node)}
        wanted_type = get_type_hints(type(node)).get(name)
    elif isinstance(node, Mapping):
        values, wanted_type = node, None
    else:
        raise InputError(f"{path}: {type(node).__name__} values have no parts; leave out {'.'.join(steps)!r}")
    if name not in values:
        owner = type(node).__name__ if is_dataclass(node) else "this recipe"
        raise InputError(f"{path}: {owner} has no {name!r}{closest(name, values)}")
    old = values[name]
    if rest:
        new = changed(old, rest, text, path)
    elif is_dataclass(old) or isinstance(old, Mapping):
        inner = [part.name for part in fields(old)] if is_dataclass(old) else list(old)
        raise InputError(f"{path} holds several values; set one of them: {', '.join(inner)}")
    else:
        if isinstance(old, tuple | list) and any(isinstance(part, tuple | list) for part in old):
            raise InputError(
                f"{path} is a table, which --set cannot write; choose a recipe or a start that has another"
            )
        new = _parsed(text, wanted_type or _type_of(old), path)
    return {**node, name: new} if isinstance(node, Mapping) else replace(cast(Any, node), **{name: new})


def _type_of(value: Any) -> Any:  # noqa: ANN401
    """Type to parse for a dictionary's entry: that of its present value."""
    if isinstance(value, tuple | list):
        return tuple[type(value[0]) if value else str, ...]
    return type(value)


def _parsed(text: str, wanted_type: Any, path: str) -> Value:  # noqa: ANN401
    """`text` as a value of `wanted_type`: bool, int, float, str, a Literal of strings, or a tuple of one of them."""
    if get_origin(wanted_type) is Literal:
        if text not in get_args(wanted_type):
            raise InputError(f"{path} cannot be {text!r}{closest(text, get_args(wanted_type))}")
        return text
    if get_origin(wanted_type) is tuple:
        first, *further = get_args(wanted_type)
        parts = [part.strip() for part in text.strip("()[]").split(",") if part.strip()]
        if further and further[-1] is not Ellipsis and len(parts) != len(further) + 1:
            raise InputError(f"{path} wants {len(further) + 1} values with commas between, not {text!r}")
        return tuple(_parsed(part, first, path) for part in parts)
    if wanted_type is str:
        return text
    if wanted_type is bool:
        if text.lower() not in SWITCH:
            raise InputError(f"{path} wants true or false, not {text!r}")
        return SWITCH[text.lower()]
    try:
        number = wanted_type(text)
    except ValueError:  # more digits than Python reads are one, too
        number = math.nan
    if not abs(number) < (LARGEST_WHOLE if wanted_type is int else math.inf):
        kind = "a whole number" if wanted_type is int else "a number"
        raise InputError(f"{path} wants {kind}, not {text[:40]!r}")
    return number
