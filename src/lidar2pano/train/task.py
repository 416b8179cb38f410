"""What the loop needs to know about a task: its networks, who is updated by which loss, and how good they are."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from lidar2pano.data.sequences import Draw
from lidar2pano.errors import InputError, closest

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor, nn

    from lidar2pano.train.recipe import Recipe

# name -> module of this package and class in it, made as Class(recipe, root); imported on first use
TASKS: dict[str, str] = {
    "segmentation": "segmentation:Segmentation",
    "front": "front:FrontTranslation",
    "front-depth": "front_depth:FrontDepthTranslation",
    "direct": "direct:DirectColour",
    "pix2pix-segments": "pix2pix:Pix2PixSegments",
    "pix2pix-colours": "pix2pix:Pix2PixColours",
    "panorama": "panorama:PanoramaTranslation",
    "painting": "painting:Painting",
    "scene-painting": "scene_painting:ScenePainting",
    "camera-segmentation": "camera_segmentation:CameraSegmentation",
    "video": "video:VideoPainting",
}


class Samples(Protocol):
    """A map-style data set: `samples[Draw(index, seed)]` is a NamedTuple that the default collation can stack."""

    def __len__(self) -> int:
        """How many samples there are."""
        ...

    def __getitem__(self, draw: Draw) -> Any:  # noqa: ANN401 a NamedTuple of the task's own
        """Sample `draw.index`, augmented by the generator that starts from `draw.seed`."""
        ...


class Task(Protocol):
    """One way to train networks; the loop asks nothing else.

    networks  name -> network, each with the optimiser that the recipe gives it under the same name. The loop puts
              them on the device and replaces the entries by wrapped ones, so look them up here whenever they are
              called, and call nothing but the networks themselves (their `forward`).
    released  names of the networks that become weight files; these are averaged over steps when the recipe says so.
    dataset   training samples.
    logs      other numbers worth a curve, as of the last step (float or tensor with one element).
    """

    networks: dict[str, nn.Module]
    released: tuple[str, ...]
    dataset: Samples
    logs: dict[str, float | Tensor]

    def updates(self, batch: Any) -> Iterator[tuple[str, Tensor]]:  # noqa: ANN401
        """Yield (network name, loss to descend); between two yields that network's weights have moved.

        A loss is a mean over samples. Gradients that a loss leaves in other networks are thrown away. The same names
        must come in the same order for every batch.
        """
        ...

    def preview(self) -> dict[str, np.ndarray]:
        """Pictures of how it stands, name -> (H, W, 3) uint8. Networks are averaged and in evaluation mode."""
        ...

    def validate(self) -> dict[str, float]:
        """Scores on the validation split; "score" decides which weights are best (larger is better)."""
        ...

    def card(self, network: str) -> dict[str, Any]:
        """Fields of the weight card that only the task knows: labels, views, normalisation, licence."""
        ...


def build_task(recipe: Recipe, root: Path) -> Task:
    """The task that `recipe` names, over the data under `root`; an unknown name raises InputError."""
    if recipe.task not in TASKS:
        raise InputError(f"recipe {recipe.name!r}: no task {recipe.task!r}{closest(recipe.task, TASKS)}")
    module, _, class_name = TASKS[recipe.task].partition(":")
    return getattr(import_module(f"lidar2pano.train.{module}"), class_name)(recipe, root)


def build_networks(recipe: Recipe) -> dict[str, nn.Module]:
    """The recipe's networks by name: fresh ones, or those of the weight file that `start` names."""
    from lidar2pano.models import build
    from lidar2pano.models.card import load

    networks = {}
    for name, spec in recipe.networks.items():
        networks[name] = build(spec.model, **spec.settings)
        if spec.start:
            started, _ = load(spec.start, expect=spec.model)
            try:
                networks[name].load_state_dict(started.state_dict())
            except RuntimeError:
                raise InputError(
                    f"networks.{name}.start: {spec.start} was trained with other settings than "
                    f"{dict(spec.settings)}; change one of them"
                ) from None
    return networks
