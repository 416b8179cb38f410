"""What is to be measured, and what that needs: Inception for FID, a camera segmenter for FSD and re-segmentation."""

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

KINDS = ("points", "classes", "pictures", "depth", "seams", "time", "roll")
DEFAULT_KINDS = KINDS[:-1]  # the roll needs everything twice
SECTORS = ("camera", "panorama")
ELSEWHERE = {"camera": {"points", "seams", "roll"}, "panorama": {"points"}}  # kinds that a sector has nothing of


@dataclass(slots=True, kw_only=True, eq=False)
class Extractor:
    """Features of pictures, (B, 3, H, W) uint8 -> (B, D) float, and the SHA-256 of the weights that make them.

    The last two pictures' are remembered: every system is compared with the same truth.
    """

    features: Callable[[Tensor], Tensor]
    sha256: str
    _last: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def __call__(self, pictures: Tensor) -> Tensor:
        """The features."""
        known = next((pair for pair in self._last if torch.equal(pair[0], pictures)), None)
        found = known or (pictures.clone(), self.features(pictures))
        self._last = [*(pair for pair in self._last if pair is not known), found][-2:]
        return found[1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraEye:
    """A camera segmenter as a judge of pictures: what it sees in them, and its features."""

    segmenter: CameraSegmenter
    features: Extractor
    sha256: str

    def segment(self, picture: np.ndarray) -> Tensor:
        """Ids (h, w) uint8 of COMMON15 of a picture (h, w, 3) uint8."""
        best = self.segmenter.probabilities(picture).max(0).indices.cpu()
        return torch.from_numpy(TABLES["cityscapes", "common-15"])[best]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measures:
    """What is measured, as far as data and systems allow.

    kinds      of KINDS: points (classes of the scan's points), classes, pictures (SSIM, SWD, FID, FSD,
               re-segmentation), depth, seams, time (warping error), roll (everything again with the scan turned).
    sectors    of SECTORS: the camera's image, and all around.
    inception  for FID;  eye: for FSD and re-segmentation;  patches: for the patch Frechet distance. None: not measured.
    """

    kinds: tuple[str, ...] = DEFAULT_KINDS
    sectors: tuple[str, ...] = SECTORS
    inception: Extractor | None = None
    eye: CameraEye | None = None
    patches: Extractor | None = None

    @classmethod
    def of(
        cls, words: str = "", *, inception: Path | None = None, sdnet: Path | None = None, device: str = "auto"
    ) -> Self:
        """The measures of a list "points,classes,camera"; without a kind (a sector) all but the roll (both).

        inception  file of Inception's published weights; None: the one in torch hub's cache folder, if there.
        sdnet      weight file or run of a camera segmenter.
        Raises InputError for unknown words and for files that cannot be used.
        """
        named = [word.strip() for word in words.split(",") if word.strip()]
        for word in named:
            if word not in (*KINDS, *SECTORS):
                raise InputError(f"--metrics: nothing is called {word!r}{closest(word, (*KINDS, *SECTORS))}")
        kinds = tuple(kind for kind in KINDS if kind in named) or DEFAULT_KINDS
        sectors = tuple(sector for sector in SECTORS if sector in named) or SECTORS
        pictures, picked = "pictures" in kinds and "camera" in sectors, pick_device(device)
        patches = _patches(picked) if "pictures" in kinds else None
        return cls(
            kinds=kinds,
            sectors=sectors,
            inception=_inception(inception, picked) if pictures else None,
            eye=_eye(sdnet, picked) if pictures and sdnet is not None else None,
            patches=patches,
        )

    def asks(self, sector: str) -> bool:
        """Whether anything of a sector is measured."""
        return sector in self.sectors and not set(self.kinds) <= ELSEWHERE[sector]

    @property
    def painted(self) -> bool:
        """Whether colours are looked at at all."""
        return bool({"pictures", "seams", "time", "roll"} & set(self.kinds))


def _inception(given: Path | None, device: torch.device) -> Extractor | None:
    path = find_inception(given)
    if path is None:
        return None
    network = load_inception(path, device)
    return Extractor(features=lambda pictures: network(pictures.to(device)), sha256=fingerprint(network))


def _patches(device: torch.device) -> Extractor | None:
    """Features of EfficientNet-Lite2, which nothing is trained against; None where it is not installed."""
    try:
        network = ImagenetFeatures.load(LITE2).to(device)
    except InputError:
        return None
    return Extractor(features=lambda pictures: network(pictures.to(device) / 127.5 - 1)[-1], sha256=LITE2.sha256)


def _eye(given: Path, device: torch.device) -> CameraEye:
    folder = given / "weights" if (given / "weights").is_dir() else given
    file = folder / "camera.safetensors" if folder.is_dir() else folder
    network, card = load(file, device, expect="sdnet")
    segmenter = CameraSegmenter.from_card(network, card)
    features = Extractor(features=lambda pictures: _context(segmenter, pictures), sha256=card.sha256)
    return CameraEye(segmenter=segmenter, features=features, sha256=card.sha256)


def _context(segmenter: CameraSegmenter, pictures: Tensor) -> Tensor:
    """(B, 3, h, w) uint8 -> (B, context) float32: means over all pixels of OCR's features, at scale one."""
    network = cast("SdNet", segmenter.network)
    with torch.inference_mode():
        images = segmenter.normalise(pictures.to(next(network.parameters()).device))
        return network.ocr(network.backbone(images)).features.float().mean((2, 3))
