"""Our own systems, whose answers are panorama and the camera's look into it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.evaluate.questions import Origin, Question, Seen
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.hardware import Timer
from lidar2pano.models.painter import Scene
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import Memory, Pipeline, Translated

SAME_PLACE_M = 1e-6


class Blank:
    """A painter that paints nothing: where only classes and depths are wanted."""

    def paint(self, past: Any, scene: Scene) -> tuple[Any, Tensor]:  # noqa: ANN401
        """As StreamPainter says: grey."""
        rows, columns = scene.segments.shape[-2:]
        return past, scene.segments.new_zeros(1, 3, 2 * rows, 2 * columns)


class _Look(NamedTuple):
    found: Translated
    pipeline: Pipeline
    panorama: Panorama | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Around:
    """`titan-pano` and a painter of panoramas: the pipeline itself.

    The camera's classes are looked up in the scores from the camera's optical centre, its colours in the panorama.
    Where a panorama around another point is asked for, that is a second run.

    paints  whether it has a painter;  steady: whether it is told the sensor's pose, where that is known, and steadies
            its pictures by it.
    """

    origin: Origin
    pipeline: Pipeline
    paints: bool = True
    told: bool = False
    steady: bool = False

    @torch.inference_mode()
    def see(self, question: Question, past: Any = None) -> tuple[Any, Seen]:  # noqa: ANN401
        """As System says."""
        if not self.steady:
            question = replace(question, pose=None)
        pipeline, calibration = self.pipeline, question.calibration
        memories: dict[str, Memory] = dict(past or {})
        places = _places(question)
        if not places:
            return past, Seen(labels=pipeline.segmenter.points(question.scan, pipeline.device).cpu().numpy())
        looks: dict[str, _Look] = {}
        watch = Timer(pipeline.device)
        for number, (name, place) in enumerate(places.items()):
            moved = replace(pipeline, view=replace(pipeline.view, origin=place))
            if not question.painted:
                moved = replace(moved, painter=Blank())
            mine = Timer(pipeline.device) if number else watch
            wanted = question.painted or name == "around" or (len(places) == 1 and question.origin is not None)
            memories[name], looks[name] = _look(moved, question, memories.get(name, Memory()), mine, wanted)
        around = looks.get("around", looks.get("camera")) if question.origin is not None else None
        seen = Seen(
            labels=next(iter(looks.values())).found.labels.cpu().numpy(),
            panorama=around.panorama if around else None,
            painted=self.paints and question.painted,
            milliseconds=watch.milliseconds,
        )
        if calibration is None:
            return memories, seen
        return memories, self._in_camera(seen, looks["camera"], calibration, watch, question.painted)

    def _in_camera(self, seen: Seen, look: _Look, calibration: Calibration, watch: Timer, painted: bool) -> Seen:
        """The answer with the camera's look into the panorama."""
        with watch("camera"):
            lookup = panorama_in_camera(look.pipeline.view, calibration).to(look.pipeline.device)
            ids = lookup.linear(look.found.logits[0].float()).max(0).indices
            depth_m = lookup.linear(look.found.depth_m[0].float())
        colour: np.ndarray | None = None
        if painted and self.paints and look.panorama is not None:
            colour = look.panorama.to_camera(calibration).colour
        return replace(seen, ids=ids.cpu().numpy(), depth_m=depth_m.cpu().numpy(), colour=colour)


def _places(question: Question) -> dict[str, tuple[float, float, float]]:
    """From where to look: "camera" and "around"; the first does for both where they are the same."""
    places: dict[str, tuple[float, float, float]] = {}
    if question.calibration is not None:
        places["camera"] = question.calibration.centre
    if question.origin is not None:
        apart = np.abs(np.subtract(places.get("camera", np.inf), question.origin)).max()
        if apart > SAME_PLACE_M:
            places["around"] = question.origin
    return places


def _look(pipeline: Pipeline, question: Question, memory: Memory, watch: Timer, wanted: bool) -> tuple[Memory, _Look]:
    """Translate, and where the panorama is wanted go on to it."""
    found = pipeline.translate(question.scan, watch)
    if not wanted:
        return memory, _Look(found, pipeline, None)
    memory, panorama = pipeline.paint(found, memory, question.pose, watch)
    return memory, _Look(found, pipeline, panorama)
