"""Small panoramas with random content, as frames of the viewer's page and as saved files."""

from __future__ import annotations

import numpy as np

from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan
from lidar2pano.viewer.page import PageFrame
from lidar2pano.views import VIEWS, View
from random_weights import street

VIEW = VIEWS["panorama"].scaled(1 / 4)  # 96 x 1152


def small_panorama(seed: int = 0, scan: Scan | None = None, name: str = "a") -> Panorama:
    """Noise for colours, blocks of classes, depths between 2 and 120 m (0 for the sky)."""
    generator = np.random.default_rng(seed)
    shape = VIEW.rows, VIEW.columns
    coarse = generator.integers(1, len(COMMON15), (VIEW.rows // 8, VIEW.columns // 8), dtype=np.uint8)
    segments = coarse.repeat(8, axis=0).repeat(8, axis=1)
    depth_m = np.exp(generator.uniform(np.log(2), np.log(120), coarse.shape)).repeat(8, axis=0).repeat(8, axis=1)
    return Panorama(
        name=name,
        frame=seed,
        view=VIEW,
        colour=generator.integers(0, 256, (*shape, 3), dtype=np.uint8),
        segments=segments,
        depth_m=np.where(segments == COMMON15.id_of("sky"), 0, depth_m).astype(np.float32),
        confidence=generator.uniform(0, 1, coarse.shape).repeat(8, axis=0).repeat(8, axis=1).astype(np.float32),
        labels=generator.integers(0, len(SEMANTIC_KITTI), len(scan or street())),
    )


def camera_numbers() -> np.ndarray:
    """The first of two cameras sees a half, the second a quarter, the rest is invented."""
    numbers = np.zeros((VIEW.rows, VIEW.columns), dtype=np.uint8)
    numbers[:, : VIEW.columns // 2], numbers[:, VIEW.columns * 3 // 4 :] = 1, 2
    return numbers


def page_frame(seed: int = 0, name: str = "a", view: View = VIEW, camera: bool = False) -> PageFrame:
    """The same as a frame of the page, with the points of a street and, if wanted, an image of a camera ahead."""
    around = small_panorama(seed)
    layer = np.zeros((*around.colour.shape[:2], 4), dtype=np.uint8)
    layer[:, VIEW.columns * 3 // 8 : VIEW.columns * 5 // 8] = 10, 200, 30, 255
    return PageFrame(
        name=name,
        view=view,
        colour=around.colour,
        segments=around.segments,
        depth_m=around.depth_m,
        confidence=around.confidence,
        camera=layer if camera else None,
        xyz=street().xyz,
        remission=street().remission,
        source=camera_numbers() if camera else None,
        cameras=("front",) if camera else (),
    )
