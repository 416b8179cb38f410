"""The contract between the training loop and a task, and pieces shared by tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.data.cache import PredictedLabels
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import LabelSet
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.models import build
from lidar2pano.models.card import load, read_card
from lidar2pano.models.salsanext import IMAGE_SIZE
from lidar2pano.pipeline import Segmenter
from lidar2pano.pipeline import load_segmenter as load_fast_segmenter
from lidar2pano.progress import working
from lidar2pano.scan import Scan
from lidar2pano.train.recipe import Network, Recipe
from lidar2pano.views import View


class Task(Protocol):
    """One way to train networks; the loop uses nothing else.

    networks  name -> network, each with the recipe's optimiser of the same name. The loop puts
              them on the device and replaces the entries by wrapped ones, so look them up here whenever they are
              called, and call nothing but the networks themselves (their `forward`, and methods that an attribute
              `methods` names).
    released  names of the networks for weight files; averaged over steps if the recipe says so.
    dataset   training samples, map-style: `dataset[SampleIndex(index, seed)]` is a NamedTuple that default collation
              can stack, augmented by a generator of that seed.
    logs      other numbers worth a curve, as of the last step (float or tensor with one element).

    What else the next step depends on is a module in an attribute `memory`, whose state is kept in checkpoints; of
    several processes, that of the first.
    """

    networks: dict[str, nn.Module]
    released: tuple[str, ...]
    dataset: Any
    logs: dict[str, float | Tensor]

    def updates(self, batch: Any) -> Iterator[tuple[str, Tensor]]:  # noqa: ANN401
        """Yield (network name, loss to descend); between two yields the named network's weights are updated.

        A loss is a mean over samples. Gradients of a loss in other networks are discarded. The same names
        must come in the same order for every batch.
        """
        ...

    def preview(self) -> dict[str, np.ndarray]:
        """Images of the current output, name -> (H, W, 3) uint8. Networks are averaged and in evaluation mode."""
        ...

    def validate(self) -> dict[str, float]:
        """Scores on the validation split; "score" decides the best weights (larger is better)."""
        ...

    def card(self, network: str) -> dict[str, Any]:
        """Fields of the weight card known to the task alone: labels, views, normalisation, licence."""
        ...


def with_starts(recipe: Recipe) -> Recipe:
    """Return the recipe whose networks have the settings of the files that they start from; its own go before."""
    networks = dict(recipe.networks)
    for name, spec in recipe.networks.items():
        card = read_card(spec.start) if spec.start else None
        if card is not None and card.network == spec.model:
            networks[name] = replace(spec, settings={**card.settings, **spec.settings})
    return replace(recipe, networks=networks)


def build_networks(recipe: Recipe) -> dict[str, nn.Module]:
    """The recipe's networks by name: fresh ones, or those of the weight file `start`.

    Impossible settings, a weight file of another network, and a share of none or without averages raise InputError.
    """
    for name, spec in recipe.networks.items():
        if spec.start_share and not (spec.start and recipe.training.ema):
            raise InputError(
                f"networks.{name}.start_share is a share of the weights to start from in averaged ones; say"
                f" networks.{name}.start=FILE, and training.ema above 0"
            )
    return {name: _built(name, spec) for name, spec in recipe.networks.items()}


def _built(name: str, spec: Network) -> nn.Module:
    network = build(spec.model, **spec.settings)
    if spec.start:
        started, _ = load(spec.start, expect=spec.model)
        try:
            network.load_state_dict(started.state_dict())
        except RuntimeError:
            raise InputError(
                f"networks.{name}.start: {spec.start} was trained with other settings than "
                f"{dict(spec.settings)}; change one of them"
            ) from None
    return network


class Teacher:
    """A trained network whose predictions another learns: a function of the same inputs, without gradients.

    It is no part of the task's networks, hence neither trained nor saved by the loop.
    """

    def __init__(self, file: str, model: str) -> None:
        network = load(Path(file), expect=model)[0].requires_grad_(False)
        self.network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def __call__(self, *inputs: Tensor) -> Any:  # noqa: ANN401 the network's own output
        """Apply the network, on the device of the inputs."""
        device = inputs[0].device
        self.network.to(device)
        with torch.no_grad(), fast_arithmetic(device):
            return self.network(*inputs)


def device_of(network: nn.Module) -> torch.device:
    """The device of a network's weights."""
    return next(network.parameters()).device


def image_size(network: nn.Module) -> tuple[int, int]:
    """Rows and columns of the predicted image of a network of the paper's setting: its setting `size`, or KITTI's."""
    rows, columns = getattr(network, "size", None) or IMAGE_SIZE
    return int(rows), int(columns)


def segmentation_scores(
    pairs: Iterable[tuple[Tensor, Tensor | np.ndarray]], classes: int | LabelSet, unscored: tuple[int, ...] = ()
) -> dict[str, float]:
    """MIoU (the score) and accuracy of (predicted ids, target ids) over all frames together."""
    metric = MeanIoU(classes, unscored=unscored)
    for number, (predicted, target) in enumerate(pairs):
        metric.update(predicted, target, str(number))
    values = metric.values()
    return {"score": values["mIoU"], "miou": values["mIoU"], "accuracy": values["accuracy"]}


def label_preview(labels: LabelSet, pairs: Iterable[Iterable[Tensor]]) -> dict[str, np.ndarray]:
    """Return images of ids (h, w), those of a pair one above the other, and pair under pair, (H, W, 3) uint8."""
    return {"segments": np.concatenate([labels.paint(ids.numpy()) for pair in pairs for ids in pair])}


def range_view_card(view: View, tallest: View | None = None, normalise: Normalisation | None = None) -> dict[str, Any]:
    """Fields of the card of a network on normalised range images of `view`, as far as `tallest` (Segmenter)."""
    normalisation = (normalise or Normalisation()).as_dict()
    views = {"input": view, **({"tallest input": tallest} if tallest else {})}
    return {"views": {role: raster.as_dict() for role, raster in views.items()}, "normalisation": normalisation}


def load_segmenter(file: str) -> Callable[[Scan], Tensor]:
    """Read a LiDAR segmenter's weight file: scan -> labels (N,) of SEMANTIC_KITTI."""
    return LabelPoints(load_fast_segmenter(Path(file), torch.device("cpu"))[0])


class LabelPoints:
    """A segmenter as a function of scans, on a movable device."""

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter = segmenter

    def __call__(self, scan: Scan) -> Tensor:
        """Labels (N,) of SEMANTIC_KITTI."""
        return self.segmenter.points(scan, device_of(self.segmenter.network))

    def move(self, device: torch.device) -> None:
        """Compute there from now on."""
        self.segmenter.network.to(device)


def predict_all(task: Task, device: torch.device, rank: int = 0, world: int = 1) -> None:
    """Label the frames of the task's data sets that need a segmenter's labels, each process its share.

    Labels on disk are not made again; a list noted as complete is not even read again.
    """
    for samples in (task.dataset, getattr(task, "validation", None)):
        predicted = getattr(samples, "predicted", None)
        frames: FrameList[Frame] | None = getattr(samples, "frames", None)
        if isinstance(predicted, PredictedLabels) and frames is not None and not predicted.complete(frames):
            share, label_points = frames[rank::world], cast("LabelPoints", predicted.label_points)
            title = f"labelling {len(share)} scans on {device}, once: the labels are kept on disk"
            label_points.move(device)
            with working(title, len(share)) if rank == 0 else nullcontext(lambda: None) as advance:
                for frame in share:
                    predicted.of(frame)
                    advance()
            label_points.move(torch.device("cpu"))  # processes for samples have no GPU
            if world == 1:
                predicted.note_complete(frames)
