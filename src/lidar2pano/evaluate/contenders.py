"""Weights under evaluation, and what has been counted of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.evaluate.sights import Around, Front, Sight
from lidar2pano.geometry.images import Normalisation
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files
from lidar2pano.models.precision import pick_device
from lidar2pano.pipeline import Pipeline, Stopwatch, card_view, load_part, load_segmenter
from lidar2pano.scan import Scan

UNSCORED = (COMMON15.id_of("unlabeled"), COMMON15.id_of("sky"))


@dataclass(kw_only=True)
class Contender:
    """Weights under evaluation and what has been counted of them.

    name          as the user said it;  sight: what they do.
    networks      per role what its card says of where it comes from.
    camera        the confusion of COMMON15 in the image;  points: of SEMANTIC_KITTI at the points.
    milliseconds  per stage, one entry per frame.
    """

    name: str
    sight: Sight
    networks: dict[str, dict[str, Any]]
    camera: Confusion = field(default_factory=lambda: Confusion(COMMON15, unscored=UNSCORED))
    points: Confusion = field(default_factory=lambda: Confusion(SEMANTIC_KITTI, unscored=(0,)))
    milliseconds: dict[str, list[float]] = field(default_factory=dict)

    def take(self, scan: Scan, calibration: Calibration | None, camera: Tensor | None, points: Tensor | None) -> None:
        """Count one frame; camera (h, w) and points (N,) are the targets, None where nobody labelled them."""
        if calibration is None or camera is None:
            labels = self.sight.segmenter.points(scan, self.sight.device)
        else:
            watch = Stopwatch(self.sight.device)
            ids, labels = self.sight.see(scan, calibration, watch)
            self.camera.update(ids.cpu(), camera)
            for stage, value in watch.milliseconds.items():
                self.milliseconds.setdefault(stage, []).append(value)
        if points is not None:
            self.points.update(labels.cpu(), points)

    def mean_milliseconds(self) -> dict[str, float]:
        """Mean per stage; the first frame, which warms up, is left out where there are several."""
        return {
            stage: sum(warm) / len(warm) for stage, times in self.milliseconds.items() if (warm := times[1:] or times)
        }


def contender(weights: str | Path, device: str = "auto") -> Contender:
    """Weights (a family, a run, a folder or a file; missing roles from the default family), ready to be evaluated.

    Raises InputError when segmenter or translator cannot be had.
    """
    picked, files = pick_device(device), weight_files(weights)
    if missing := [role for role in ("segmenter", "translator") if role not in files]:
        raise InputError(f"{weights}: no weights for the {' and the '.join(missing)}; name a family that has them")
    segmenter = load_segmenter(files["segmenter"], picked)
    translator, card = load_part(files["translator"], picked)
    sight: Sight
    if card.network == "titan":
        normalise = Normalisation(**{name: tuple(values) for name, values in card.normalisation.items()})
        view = card_view(files["translator"], card, "input")
        sight = Front(segmenter=segmenter, translator=translator, view=view, normalise=normalise, device=picked)
    else:
        view = card_view(files["translator"], card, "panorama")
        blank = nn.Identity()  # nothing is painted here
        sight = Around(
            pipeline=Pipeline(segmenter=segmenter, translator=translator, painter=blank, view=view, device=picked)
        )
    cards = {role: read_card(files[role]) for role in ("segmenter", "translator")}
    told = ("network", "recipe", "data", "steps", "hours", "commit", "sha256")
    networks = {role: {name: getattr(one, name) for name in told} for role, one in cards.items()}
    return Contender(name=str(weights), sight=sight, networks=networks)
