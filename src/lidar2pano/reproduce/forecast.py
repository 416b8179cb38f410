"""Forecast of a reproduction: its trainings, their disk, and what it lacks before anything is trained."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import torch

from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.reproduce.run import SEGMENTER, Plan, splits, training_frames
from lidar2pano.train.recipe import Recipe

# Packages of the extra `train` by importing part; "" stands for every part.
PACKAGES = {"": ("lightning_fabric", "tensorboard", "matplotlib"), "vid2vid": ("cv2",)}
PACKAGES["scene-painter"] = ("efficientnet_lite_pytorch",)
IMAGES_ALONE = {"scunet", "pix2pix-rgb", "titan-no-segments"}  # trained on the camera's colours, not on its classes
COPIES = 5  # of a network on disk: its checkpoint with Adam's two moments, its best and its latest weights
GIB = 2**30


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """The training of one part: its recipe, its length in words, minutes if they are limited, bytes of its run."""

    part: str
    recipe: str
    length: str
    minutes: float
    bytes: int
    finished: bool


def missing_packages(plan: Plan) -> list[str]:
    """Return the absent packages of the extra `train` among the imports of the plan's parts."""
    needed = [name for part, names in PACKAGES.items() if not part or part in plan.parts for name in names]
    return [name for name in needed if find_spec(name) is None]


def check_packages(plan: Plan) -> None:
    """Raise InputError before the first training if a later one would lack a package."""
    if missing := missing_packages(plan):
        raise InputError(f"reproduce needs {', '.join(missing)}: pip install 'lidar2pano[train]'")


def trainings(plan: Plan) -> list[Training]:
    """Return the trainings of a plan in their order; InputError for a change of no recipe."""
    return [_training(plan, part) for part in plan.parts]


def _training(plan: Plan, part: str) -> Training:
    recipe = plan.recipe(part, {})
    settings = recipe.training
    length = f"{settings.epochs:g} epochs" if settings.epochs else f"{settings.steps} steps"
    return Training(
        part=part,
        recipe=recipe.name,
        length=f"{settings.minutes:g} min" if settings.minutes else length,
        minutes=settings.minutes,
        bytes=COPIES * _network_bytes(recipe),
        finished=(plan.run(part) / "weights").is_dir(),
    )


def _network_bytes(recipe: Recipe) -> int:
    with torch.device("meta"):
        networks = [build(spec.model, **spec.settings) for spec in recipe.networks.values()]
    return sum(4 * weights.numel() for network in networks for weights in network.parameters())


def missing_data(plan: Plan) -> list[str]:
    """Return a sentence for every kind of file missing from the first frames of training and scoring."""
    scored = frames(plan.data, plan.split)[0]
    train = training_frames(plan)["train"] if splits(plan.data) else []
    first = next(iter(frames(plan.data, "train"))) if train else scored
    lacks = [f"split {plan.split}: {fault}" for fault in _lacking(scored, plan, scoring=True)]
    return lacks + [f"split train: {fault}" for fault in _lacking(first, plan, scoring=False)]


def _lacking(frame: Frame, plan: Plan, *, scoring: bool) -> list[str]:
    prepare = f"lidar2pano prepare {plan.data}"
    faults = []
    if frame.image is None:
        faults.append(f"{frame.name} has no camera image; every row needs one")
    if frame.camera_labels is None and (scoring or set(plan.parts) - IMAGES_ALONE - {SEGMENTER}):
        faults.append(f"{frame.name} has no camera labels: {prepare} --teacher FILE")
    if not scoring and SEGMENTER in plan.parts and frame.point_labels is None:
        faults.append(f"{frame.name} has no point labels: {prepare}, or name a --segmenter")
    return faults


def describe(plan: Plan) -> tuple[list[str], list[str]]:
    """Return the lines of a plan, and of its gaps."""
    planned = trainings(plan)
    lines = [
        f"{item.part:20} {item.recipe:24} {item.length:>14}{'  finished' if item.finished else ''}" for item in planned
    ]
    rest = [item for item in planned if not item.finished]
    minutes = [item.minutes for item in rest]
    total = f"{sum(minutes):g} min" if all(minutes) else "as long as their steps take; --budget limits it"
    lines.append(
        f"{len(rest)} trainings: {total}, and up to {sum(item.bytes for item in planned) / GIB:.1f} GiB in {plan.out}"
    )
    count = len(frames(plan.data, plan.split))
    lines.append(f"{len(plan.rows)} rows scored on {min(plan.frames or count, count)} frames of {plan.split}")
    packages = [f"{name}: pip install 'lidar2pano[train]'" for name in missing_packages(plan)]
    return lines, packages + missing_data(plan)
