"""Choice of metrics, and the networks that some need: Inception for FID, a camera segmenter for FSD."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self, cast

import numpy as np
import torch
from torch import Tensor

from lidar2pano.errors import InputError, closest
from lidar2pano.hardware import pick_device
from lidar2pano.labels import TABLES
from lidar2pano.metrics.frechet import fingerprint
from lidar2pano.metrics.inception import find_inception, load_inception
from lidar2pano.models.camera_segmenter import CameraSegmenter
from lidar2pano.models.card import load
from lidar2pano.models.imagenet_features import LITE2, ImagenetFeatures
from lidar2pano.models.sdnet import SdNet

GROUPS = ("points", "classes", "pictures", "depth", "seams", "time", "roll")
DEFAULT_GROUPS = GROUPS[:-1]  # the roll error needs every prediction twice
SECTORS = ("camera", "panorama")
ABSENT = {"camera": {"points", "seams", "roll"}, "panorama": {"points"}}  # groups that a sector has no metrics of


@dataclass(slots=True, kw_only=True, eq=False)
class FeatureExtractor:
    """Features of images, (B, 3, H, W) uint8 -> (B, D) float, and the SHA-256 of the network's weights.

    The features of the last two images are cached: every system is compared with the same ground truth.
    """

    features: Callable[[Tensor], Tensor]
    sha256: str
    _cache: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def __call__(self, images: Tensor) -> Tensor:
        """The features."""
        known = next((pair for pair in self._cache if torch.equal(pair[0], images)), None)
        found = known or (images.clone(), self.features(images))
        self._cache = [*(pair for pair in self._cache if pair is not known), found][-2:]
        return found[1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSegmenter:
    """A camera segmenter that scores painted images: its predicted labels, and its features."""

    segmenter: CameraSegmenter
    features: FeatureExtractor
    sha256: str

    def segment(self, image: np.ndarray) -> Tensor:
        """Ids (h, w) uint8 of COMMON15 of an image (h, w, 3) uint8."""
        best = self.segmenter.probabilities(image).max(0).indices.cpu()
        return torch.from_numpy(TABLES["cityscapes", "common-15"])[best]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MetricConfig:
    """Which metrics are computed, as far as data and systems allow.

    groups           of GROUPS: points (classes of the scan's points), classes, pictures (SSIM, SWD, FID, FSD,
                     re-segmentation of images), depth, seams, time (warping error), roll (every prediction again for
                     the rotated scan).
    sectors          of SECTORS: the camera's image, and the panorama.
    inception        for FID;  image_segmenter: for FSD and re-segmentation;  patches: for the patch Frechet distance.
                     None: these metrics are left out.
    """

    groups: tuple[str, ...] = DEFAULT_GROUPS
    sectors: tuple[str, ...] = SECTORS
    inception: FeatureExtractor | None = None
    image_segmenter: ImageSegmenter | None = None
    patches: FeatureExtractor | None = None

    @classmethod
    def parse(
        cls, words: str = "", *, inception: Path | None = None, sdnet: Path | None = None, device: str = "auto"
    ) -> Self:
        """The configuration of a list "points,classes,camera"; without a group all but the roll, without a sector both.

        inception  file of Inception's published weights; None: the one in torch hub's cache folder, if there.
        sdnet      weight file or run of a camera segmenter.
        Raises InputError for unknown words and for files that cannot be used.
        """
        named = [word.strip() for word in words.split(",") if word.strip()]
        for word in named:
            if word not in (*GROUPS, *SECTORS):
                raise InputError(f"--metrics: nothing is called {word!r}{closest(word, (*GROUPS, *SECTORS))}")
        groups = tuple(group for group in GROUPS if group in named) or DEFAULT_GROUPS
        sectors = tuple(sector for sector in SECTORS if sector in named) or SECTORS
        images, picked = "pictures" in groups and "camera" in sectors, pick_device(device)
        return cls(
            groups=groups,
            sectors=sectors,
            inception=_inception(inception, picked) if images else None,
            image_segmenter=_image_segmenter(sdnet, picked) if images and sdnet is not None else None,
            patches=_patches(picked) if "pictures" in groups else None,
        )

    def has(self, sector: str) -> bool:
        """Whether there is any metric of a sector."""
        return sector in self.sectors and not set(self.groups) <= ABSENT[sector]

    @property
    def colours(self) -> bool:
        """Whether any metric needs colours."""
        return bool({"pictures", "seams", "time", "roll"} & set(self.groups))


def _inception(given: Path | None, device: torch.device) -> FeatureExtractor | None:
    path = find_inception(given)
    if path is None:
        return None
    network = load_inception(path, device)
    return FeatureExtractor(features=lambda images: network(images.to(device)), sha256=fingerprint(network))


def _patches(device: torch.device) -> FeatureExtractor | None:
    """Features of EfficientNet-Lite2, which nothing is trained against; None where it is not installed."""
    try:
        network = ImagenetFeatures.load(LITE2).to(device)
    except InputError:
        return None
    return FeatureExtractor(features=lambda images: network(images.to(device) / 127.5 - 1)[-1], sha256=LITE2.sha256)


def _image_segmenter(given: Path, device: torch.device) -> ImageSegmenter:
    folder = given / "weights" if (given / "weights").is_dir() else given
    file = folder / "camera.safetensors" if folder.is_dir() else folder
    network, card = load(file, device, expect="sdnet")
    segmenter = CameraSegmenter.from_card(network, card)
    features = FeatureExtractor(features=lambda images: _context(segmenter, images), sha256=card.sha256)
    return ImageSegmenter(segmenter=segmenter, features=features, sha256=card.sha256)


def _context(segmenter: CameraSegmenter, images: Tensor) -> Tensor:
    """(B, 3, h, w) uint8 -> (B, context) float32: means over all pixels of OCR's features, at scale one."""
    network = cast("SdNet", segmenter.network)
    with torch.inference_mode():
        normalised = segmenter.normalise(images.to(next(network.parameters()).device))
        return network.ocr(network.backbone(normalised)).features.float().mean((2, 3))
