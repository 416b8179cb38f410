"""Systems of the paper's kind, whose answers are the camera's image: translators of the front view, and renderers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.data.camera_rasters import camera_raster
from lidar2pano.evaluate.films import CameraPainter, picture
from lidar2pano.evaluate.questions import Origin, Question, Seen
from lidar2pano.geometry.images import Normalisation, one_hot_layers
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import project
from lidar2pano.hardware import Timer
from lidar2pano.labels import SEMANTIC_KITTI, TABLES
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.pipeline import Segmenter
from lidar2pano.views import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Front:
    """TITAN-Net, its ablations, TITAN-Next and Pix2Pix: front view and segments in, the camera's classes out.

    translator  (lidar (1, 5, H, W), condition (1, 20, H, W)) -> logits (1, 15, h, w) of COMMON14, or those and depth.
    painter     paints them; None: there are classes only.
    Networks run in float32: instance norms amplify what bfloat16 rounds away.
    """

    origin: Origin
    segmenter: Segmenter
    translator: nn.Module
    view: View
    normalise: Normalisation
    device: torch.device
    painter: CameraPainter | None = None
    told: bool = False

    @torch.inference_mode()
    def see(self, question: Question, past: Any = None) -> tuple[Any, Seen]:  # noqa: ANN401
        """As System says; scores are stretched bilinearly to the camera's image, then the best one is taken."""
        if question.calibration is None:
            return past, Seen(labels=self.segmenter.points(question.scan, self.device).cpu().numpy())
        watch = Timer(self.device)
        with watch("project"):
            image = project(question.scan, self.segmenter.view, device=self.device)
            front = project(question.scan, self.view, device=self.device)
        with watch("segment"):
            raster = self.segmenter.raster(image)
        with watch("clean_up"):
            labels = clean_up(image, raster)
        with watch("translate"):
            condition = one_hot_layers(front.spread(labels)[None], len(SEMANTIC_KITTI))
            answer = self.translator(self.normalise(front)[None], condition)
            logits, depth_m = answer if isinstance(answer, tuple) else (answer, None)
        with watch("camera"):
            width, height = question.calibration.size
            table = torch.from_numpy(TABLES["common-14", "common-15"]).to(self.device)
            ids = table[_stretched(logits, (height, width))[0].max(0).indices]
            if depth_m is not None:
                depth_m = _stretched(depth_m[None], (height, width))[0, 0].cpu().numpy()
        colour = None
        if self.painter is not None and question.painted:
            with watch("paint"):
                past, colour = self.painter.paint(past, ids)
        return past, Seen(
            labels=labels.cpu().numpy(),
            ids=ids.cpu().numpy(),
            colour=colour,
            depth_m=depth_m,
            milliseconds=watch.milliseconds,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Direct:
    """SC-UNET, and Pix2Pix and TITAN-Net without segments: the scan in, the camera's colours out.

    renderer  what it sees (1, C, H, W) -> (1, 3, h, w) in [-1, 1].
    view      of the range image that it sees; None: it sees the scan projected into the camera.
    size      rows and columns of that projection; None: those of the camera's image.
    inputs    channels of it: 1, remission; 2, remission and range.
    """

    origin: Origin
    renderer: nn.Module
    view: View | None
    normalise: Normalisation
    device: torch.device
    size: tuple[int, int] | None = None
    inputs: int = 1
    told: bool = False

    @torch.inference_mode()
    def see(self, question: Question, past: Any = None) -> tuple[Any, Seen]:  # noqa: ANN401
        """As System says: colours and nothing else."""
        if question.calibration is None or not question.painted:
            return past, Seen()
        watch = Timer(self.device)
        with watch("project"):
            seen = self._evidence(question)
        with watch("render"):
            colour = self.renderer(seen)[0]
        with watch("camera"):
            width, height = question.calibration.size
            answer = picture(colour, (height, width))
        return past, Seen(colour=answer, milliseconds=watch.milliseconds)

    def _evidence(self, question: Question) -> Tensor:
        assert question.calibration is not None
        if self.view is not None:
            return self.normalise(project(question.scan, self.view, device=self.device))[None]
        width, height = question.calibration.size
        lidar = camera_raster(question.scan, question.calibration, self.size or (height, width)).to(self.device)
        return torch.stack([lidar[0], depth_code(lidar[1])])[None, : self.inputs]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ceiling:
    """The camera's true classes, painted: what a painter makes of a translator that errs nowhere."""

    origin: Origin
    painter: CameraPainter
    told: bool = True

    @torch.inference_mode()
    def see(self, question: Question, past: Any = None) -> tuple[Any, Seen]:  # noqa: ANN401
        """As System says: colours, where classes are known."""
        if question.ids is None or not question.painted:
            return past, Seen()
        watch = Timer(self.painter.device)
        with watch("paint"):
            past, colour = self.painter.paint(past, torch.from_numpy(np.ascontiguousarray(question.ids)))
        return past, Seen(colour=colour, milliseconds=watch.milliseconds)


def _stretched(layers: Tensor, size: tuple[int, int]) -> Tensor:
    """(1, C, H, W) -> (1, C, *size) float32."""
    return interpolate(layers.float(), size=size, mode="bilinear", align_corners=False)
