"""The two ways to foretell a camera's classes from a scan: by a panorama, and by the paper's front view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.geometry.images import Normalisation, one_hot_layers
from lidar2pano.geometry.knn import clean_up
from lidar2pano.geometry.projection import project
from lidar2pano.labels import SEMANTIC_KITTI, TABLES
from lidar2pano.models.precision import fast_arithmetic
from lidar2pano.models.segmenter import Segmenter
from lidar2pano.pipeline import Pipeline, Stopwatch
from lidar2pano.scan import Scan
from lidar2pano.sensors import View


class Sight(Protocol):
    """What foretells a camera's classes from a scan."""

    @property
    def segmenter(self) -> Segmenter:
        """Labels the points."""
        ...

    @property
    def device(self) -> torch.device:
        """Where its networks are."""
        ...

    def see(self, scan: Scan, calibration: Calibration, watch: Stopwatch) -> tuple[Tensor, Tensor]:
        """Ids (h, w) of COMMON15 in the camera's image at its size, and ids (N,) of SEMANTIC_KITTI of the points."""
        ...


@dataclass(frozen=True, kw_only=True)
class Around:
    """`titan-pano`: the panorama around the camera's optical centre, looked up from its image."""

    pipeline: Pipeline

    @property
    def segmenter(self) -> Segmenter:
        """The pipeline's."""
        return self.pipeline.segmenter

    @property
    def device(self) -> torch.device:
        """The pipeline's."""
        return self.pipeline.device

    @torch.inference_mode()
    def see(self, scan: Scan, calibration: Calibration, watch: Stopwatch) -> tuple[Tensor, Tensor]:
        """As Sight says; scores are looked up bilinearly, then the best one is taken."""
        pipeline = self.pipeline.at(calibration)
        found = pipeline.translated(scan, watch)
        with watch("camera"):
            lookup = panorama_in_camera(pipeline.view, calibration).to(self.device)
            ids = lookup.linear(found.logits[0].float()).max(0).indices
        return ids, found.labels


@dataclass(frozen=True, kw_only=True)
class Front:
    """`titan`: the paper's setting, front view in and perspective image out, resized to the camera's image."""

    segmenter: Segmenter
    translator: nn.Module
    view: View
    normalise: Normalisation
    device: torch.device

    @torch.inference_mode()
    def see(self, scan: Scan, calibration: Calibration, watch: Stopwatch) -> tuple[Tensor, Tensor]:
        """As Sight says; scores are resized bilinearly, then the best one is taken."""
        with watch("project"):
            image = project(scan, self.segmenter.view, device=self.device)
            front = project(scan, self.view, device=self.device)
        with watch("segment"):
            ids = self.segmenter.raster(image)
        with watch("clean_up"):
            labels = clean_up(image, ids)
        with watch("translate"), fast_arithmetic(self.device):
            condition = one_hot_layers(front.spread(labels)[None], len(SEMANTIC_KITTI))
            logits = self.translator(self.normalise(front)[None], condition)
        with watch("camera"):
            width, height = calibration.size
            logits = interpolate(logits.float(), size=(height, width), mode="bilinear", align_corners=False)
            table = torch.from_numpy(TABLES["common-14", "common-15"]).to(self.device)
        return table[logits[0].max(0).indices].long(), labels
