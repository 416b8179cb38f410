"""Metrics of one system: the choice, the networks that some need, and values with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame
from lidar2pano.errors import InputError, closest
from lidar2pano.evaluate.ground_truth import Resampled, camera_depth, is_dense, windows
from lidar2pano.evaluate.panorama_system import Prediction
from lidar2pano.geometry.flow import Flow
from lidar2pano.hardware import pick_device
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI, TABLES
from lidar2pano.metrics.accumulation import FrameMetric, Interval, SetMetric, interval, set_intervals
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.frame_metrics import SSIM, WINDOW, DepthError, RollError, SeamRatio, WarpingError
from lidar2pano.metrics.frechet import DOWN, PATCH, FrechetDistance, PatchFrechetDistance
from lidar2pano.metrics.inception import SHA256, find_inception, load_inception
from lidar2pano.metrics.sliced_wasserstein import LEVELS, PairwiseSlicedWasserstein, SlicedWasserstein
from lidar2pano.models.camera_teachers import CameraSegmenter
from lidar2pano.models.card import load
from lidar2pano.models.frozen_features import EDGE_DOWN, EDGES, LITE2, EdgeFeatures, ImagenetFeatures
from lidar2pano.models.sdnet import SdNet

GROUPS = ("points", "classes", "pictures", "depth", "seams", "time", "roll")
DEFAULT_GROUPS = GROUPS[:-1]  # the roll error needs every prediction twice
SECTORS = ("camera", "panorama")
ABSENT = {"camera": {"points", "seams", "roll"}, "panorama": {"points"}}  # groups without metrics in a sector


@dataclass(slots=True, kw_only=True, eq=False)
class FeatureExtractor:
    """Features of images, (B, 3, H, W) uint8 -> (B, D) float, and the SHA-256 of the network's weights.

    The features of the last two images are cached: every system is compared with the same ground truth.
    """

    features: Callable[[Tensor], Tensor]
    sha256: str
    _cache: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the features."""
        cached = next((pair for pair in self._cache if torch.equal(pair[0], images)), None)
        result = cached or (images.clone(), self.features(images))
        self._cache = [*(pair for pair in self._cache if pair is not cached), result][-2:]
        return result[1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSegmenter:
    """A camera segmenter for scores of painted images: its predicted labels, and its features."""

    segmenter: CameraSegmenter
    features: FeatureExtractor
    sha256: str

    def segment(self, image: np.ndarray) -> Tensor:
        """Return ids (h, w) uint8 of COMMON15 of an image (h, w, 3) uint8."""
        best = self.segmenter.probabilities(image).max(0).indices.cpu()
        return torch.from_numpy(TABLES["cityscapes", "common-15"])[best]


class PatchFeatures(NamedTuple):
    """Features of a patch Frechet distance; their pixels in those of the image, and by how much that is reduced."""

    extractor: FeatureExtractor
    down: int
    shrink: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MetricConfig:
    """The choice of metrics, as far as data and systems allow.

    groups           of GROUPS: points (classes of the scan's points), classes, pictures (SSIM, SWD, FID, FSD,
                     re-segmentation of images), depth, seams, time (warping error), roll (every prediction again for
                     the rotated scan).
    sectors          of SECTORS: the camera's image, and the panorama.
    inception        for FID;  image_segmenter: for FSD and re-segmentation. None: these metrics are left out.
    patches          for the patch Frechet distances, by metric.
    """

    groups: tuple[str, ...] = DEFAULT_GROUPS
    sectors: tuple[str, ...] = SECTORS
    inception: FeatureExtractor | None = None
    image_segmenter: ImageSegmenter | None = None
    patches: Mapping[str, PatchFeatures] = field(default_factory=dict)

    @classmethod
    def parse(
        cls, words: str | None = None, *, inception: Path | None = None, sdnet: Path | None = None, device: str = "auto"
    ) -> Self:
        """Return the configuration of "points,classes,camera"; without a group all but the roll, without a sector both.

        words      None: all but the roll, in both sectors.
        inception  file of Inception's published weights; None: the one in torch hub's cache folder, if there.
        sdnet      weight file or run of a camera segmenter.
        Raises InputError for unknown or no words and for unusable files.
        """
        inception_file = find_inception(inception)
        camera_file = None if sdnet is None else _camera_file(sdnet)
        named = [word.strip() for word in (words or "").split(",") if word.strip()]
        if words is not None and not named:
            raise InputError(f"--metrics: empty list; choose from {', '.join((*GROUPS, *SECTORS))}")
        for word in named:
            if word not in (*GROUPS, *SECTORS):
                raise InputError(f"--metrics: nothing is called {word!r}{closest(word, (*GROUPS, *SECTORS))}")
        groups = tuple(group for group in GROUPS if group in named) or DEFAULT_GROUPS
        sectors = tuple(sector for sector in SECTORS if sector in named) or SECTORS
        images, picked = "pictures" in groups and "camera" in sectors, pick_device(device)
        return cls(
            groups=groups,
            sectors=sectors,
            inception=_inception(inception_file, picked) if images and inception_file else None,
            image_segmenter=_image_segmenter(camera_file, picked) if images and camera_file else None,
            patches=_patches(picked) if "pictures" in groups else {},
        )

    def has(self, sector: str) -> bool:
        """Return whether there is any metric of a sector."""
        return sector in self.sectors and not set(self.groups) <= ABSENT[sector]

    @property
    def colours(self) -> bool:
        """Return whether any metric needs colours."""
        return bool({"pictures", "seams", "time", "roll"} & set(self.groups))


def _inception(file: Path, device: torch.device) -> FeatureExtractor:
    network = load_inception(file, device)
    return FeatureExtractor(features=lambda images: network(images.to(device)), sha256=SHA256)


def _patches(device: torch.device) -> dict[str, PatchFeatures]:
    """Return features of EfficientNet-Lite2 and of HED's VGG-16, opponents of no training, as far as installed.

    Each measures images as they are and at half the size: two families and two scales do not err alike.
    """
    families: dict[str, tuple[Callable[[Tensor], Tensor], str, int]] = {}
    with suppress(InputError):
        lite = ImagenetFeatures.load(LITE2).to(device)
        families["patches"] = lambda images: lite(images.to(device) / 127.5 - 1)[-1], LITE2.sha256, DOWN
    with suppress(InputError):
        vgg = EdgeFeatures.load().to(device)
        families["edge patches"] = lambda images: vgg(images.to(device).float()), EDGES.sha256, EDGE_DOWN
    return {
        name + suffix: PatchFeatures(FeatureExtractor(features=features, sha256=sha256), down, shrink)
        for name, (features, sha256, down) in families.items()
        for suffix, shrink in (("", 1), (" halved", 2))
    }


def _camera_file(path: Path) -> Path:
    """Return the weight file of a camera segmenter or of its run; InputError if it is missing."""
    folder = path / "weights" if (path / "weights").is_dir() else path
    file = folder / "camera.safetensors" if folder.is_dir() else folder
    if not file.is_file():
        raise InputError(f"no weight file {file}; check the path")
    return file


def _image_segmenter(file: Path, device: torch.device) -> ImageSegmenter:
    network, card = load(file, device, expect="sdnet")
    segmenter = CameraSegmenter.from_card(network, card)
    features = FeatureExtractor(features=lambda images: _context(segmenter, images), sha256=card.sha256)
    return ImageSegmenter(segmenter=segmenter, features=features, sha256=card.sha256)


def _context(segmenter: CameraSegmenter, images: Tensor) -> Tensor:
    """Return (B, context) float32 of (B, 3, h, w) uint8: means over all pixels of OCR's features, at scale one."""
    network = cast("SdNet", segmenter.network)
    with torch.inference_mode():
        normalised = segmenter.normalise(images.to(next(network.parameters()).device))
        return network.ocr(network.backbone(normalised)).features.float().mean((2, 3))


# --- values -----------------------------------------------------------------------------------------------------------

UNSCORED = (COMMON15.id_of("unlabeled"), COMMON15.id_of("sky"))
SECTOR_ORDER = (*SECTORS, "points")
SWD_LEVELS = tuple(f"swd_{level}" for level in LEVELS)
# metric -> value of it -> name; the order is that of tables
NAMES: dict[str, dict[str, str]] = {
    "classes": {"mIoU": "miou", "accuracy": "accuracy", "published mIoU": "miou_published"},
    "ssim": {"SSIM": "ssim"},
    "swd pairs": {"mean": "swd_pairs"} | {str(level): f"swd_pairs_{level}" for level in LEVELS},
    "swd": {"mean": "swd"} | dict(zip(map(str, LEVELS), SWD_LEVELS, strict=True)),
    "patches": {
        "ratio": "patch_frechet_ratio",
        "distance": "patch_frechet",
        "real to real": "patch_frechet_real",
    },
    "patches halved": {"ratio": "patch_frechet_halved_ratio"},
    "edge patches": {"ratio": "edge_frechet_ratio"},
    "edge patches halved": {"ratio": "edge_frechet_halved_ratio"},
    "fid": {"FID": "fid"},
    "fsd": {"FSD": "fsd"},
    "resegmentation": {"mIoU": "resegmentation_miou", "accuracy": "resegmentation_accuracy"},
    "depth": {"AbsRel": "depth_abs_rel", "RMSE": "depth_rmse_m", "delta1": "depth_delta1"},
    "warping": {"warping error": "warping_error"},
    "seam": {"seam ratio": "seam_ratio", "seam ratio nearby": "seam_ratio_nearby"},
    "roll": {"roll error": "roll_error"},
    "roll labels": {"roll error": "roll_error_ids"},
}
RANKING = (  # frames are ranked by their first of these; more is better
    ("camera", "classes", "mIoU"),
    ("panorama", "classes", "mIoU"),
    ("camera", "ssim", "SSIM"),
    ("panorama", "ssim", "SSIM"),
    ("points", "classes", "mIoU"),
)
# group -> the leading one of its values, and its needs
LEADING = {
    "points": ("miou", "point labels"),
    "classes": ("miou", "class labels and a system that predicts classes"),
    "pictures": ("swd", "images and a system that paints"),
    "depth": ("depth_abs_rel", "dense ground truth, not the scan, and a system that predicts depths"),
    "seams": ("seam_ratio", "a system that paints"),
    "time": ("warping_error", "frames that follow each other, with poses and depths, and a system that paints"),
    "roll": ("roll_error", "a system of panoramas"),
}
PANORAMA_NEED = "ground-truth panoramas"
Metric = TypeVar("Metric", bound="FrameMetric | SetMetric")


MetricValue = tuple[str, str, Interval]  # sector and name, e.g. "camera", "miou"


class MetricCollection:
    """Metrics of one system by sector ("camera", "panorama", "points") and name, made on first use."""

    def __init__(self, config: MetricConfig) -> None:
        self.config = config
        self.metrics: dict[tuple[str, str], FrameMetric | SetMetric] = {}

    def points(self, frame: Frame, prediction: Prediction) -> None:
        """Count the classes of the scan's points."""
        if "points" not in self.config.groups or prediction.point_labels is None or frame.point_labels is None:
            return
        metric = self._metric("points", "classes", partial(MeanIoU, SEMANTIC_KITTI, unscored=(0,)))
        metric.update(prediction.point_labels, frame.point_labels, frame.name)

    def camera(self, frame: Frame, prediction: Prediction) -> None:
        """Count the camera's image."""
        groups, image = self.config.groups, prediction.image
        if "classes" in groups and prediction.camera_labels is not None and frame.camera_labels is not None:
            target = CITYSCAPES_TO_COMMON15[frame.camera_labels]
            self._metric("camera", "classes", _mean_iou).update(prediction.camera_labels, target, frame.name)
        if "depth" in groups and prediction.depth_m is not None and (depth_m := camera_depth(frame)) is not None:
            self._metric("camera", "depth", DepthError).update(prediction.depth_m, depth_m, frame.name)
        if image is None:
            return
        if "pictures" in groups and frame.image is not None:
            self._images("camera", image, frame.image, frame.name)
            self._metric("camera", "swd", SlicedWasserstein).update(image, frame.image, frame.name)
            self._metric("camera", "swd pairs", PairwiseSlicedWasserstein).update(image, frame.image, frame.name)
            if (segmenter := self.config.image_segmenter) is not None:
                make = partial(FrechetDistance, segmenter.features, name="FSD")
                self._metric("camera", "fsd", make).update(image, frame.image, frame.name)
                self.resegmentation(image, frame)
            if (inception := self.config.inception) is not None:
                make = partial(FrechetDistance, inception, name="FID")
                self._metric("camera", "fid", make).update(image, frame.image, frame.name)

    def panorama(self, frame: Frame, predicted: Resampled, painted: bool) -> None:
        """Count the panorama, on the ground truth's raster."""
        true, groups = frame.panorama, self.config.groups
        assert true is not None
        if "classes" in groups and true.labels is not None:
            self._metric("panorama", "classes", _mean_iou).update(predicted.labels, true.labels, frame.name)
        if "depth" in groups and true.depth_m is not None and is_dense(true):  # a scan's own depths are the input
            self._metric("panorama", "depth", DepthError).update(predicted.depth_m, true.depth_m, frame.name)
        if not painted:
            return
        if "pictures" in groups and true.valid.any():
            self._images("panorama", predicted.image, true.image, frame.name, true.valid)
            swd = self._metric("panorama", "swd", SlicedWasserstein)
            for number, pair in enumerate(windows(predicted.image, true.image, true.valid)):
                swd.update(*pair, f"{frame.name}#{number}")

    def seam(self, image: np.ndarray, name: str) -> None:
        """Count the seam of a panorama (H, W, 3) uint8."""
        if "seams" in self.config.groups:
            self._metric("panorama", "seam", SeamRatio).update(image, name)

    def roll(self, straight: Resampled, rotated: Resampled, columns: int, name: str) -> None:
        """Count a panorama against that of the scan rotated by so many columns."""
        colours = [torch.from_numpy(np.ascontiguousarray(item.image)).movedim(2, 0) for item in (straight, rotated)]
        self._metric("panorama", "roll", RollError).update(colours[0], colours[1], columns, name)
        make = partial(RollError, ids=True)
        self._metric("panorama", "roll labels", make).update(straight.labels, rotated.labels, columns, name)

    def resegmentation(self, image: np.ndarray, frame: Frame) -> None:
        """Count the labels predicted by the camera segmenter in an image; the camera's own is the upper bound."""
        segmenter = self.config.image_segmenter
        if segmenter is None or frame.camera_labels is None or "pictures" not in self.config.groups:
            return
        target = CITYSCAPES_TO_COMMON15[frame.camera_labels]
        self._metric("camera", "resegmentation", _mean_iou).update(segmenter.segment(image), target, frame.name)

    def warping(
        self, sector: str, image: np.ndarray | None, previous: np.ndarray | None, flow: Flow | None, name: str
    ) -> None:
        """Count an image against the previous one, warped by the flow; nothing if one of them is missing."""
        if image is not None and previous is not None and flow is not None:
            metric = self._metric(sector, "warping", partial(WarpingError, circular=sector == "panorama"))
            metric.update(previous, image, flow.shift, name, valid=flow.known)

    def classes(self, sector: str) -> MeanIoU | None:
        """Return the class counts of a sector."""
        metric = self.metrics.get((sector, "classes"))
        return metric if isinstance(metric, MeanIoU) else None

    def target_classes(self, sector: str) -> list[int] | None:
        """Return ids of the classes in a sector's scored targets; None if no labels were counted."""
        for name in ("classes", "resegmentation"):
            if isinstance(metric := self.metrics.get((sector, name)), MeanIoU):
                return metric.counts().sum(1).nonzero()[0].tolist()
        return None

    def values(self, over: Mapping[str, Sequence[int]]) -> Iterator[MetricValue]:
        """Yield every value, in the order of tables; `over`: per sector, ids of the classes in the mean IoU."""
        for (sector, key), metric in sorted(self.metrics.items(), key=lambda item: _order(item[0])):
            if isinstance(metric, SetMetric):
                intervals = set_intervals(metric)
                for name, title in NAMES[key].items():
                    yield sector, title, intervals[name]
                continue
            if isinstance(metric, MeanIoU):
                metric = metric.averaged_over(over.get(sector, ()))  # noqa: PLW2901
            for name, title in NAMES[key].items():
                yield sector, title, interval(metric, name)

    def rank(self, name: str) -> tuple[str, float] | None:
        """Return the metric for a frame's rank, and its value; None if it has none."""
        for sector, key, value_name in RANKING:
            metric = self.metrics.get((sector, key))
            if isinstance(metric, FrameMetric) and not math.isnan(value := metric.value_of_frame(name, value_name)):
                return f"{sector} {value_name}", value
        return None

    def _metric(self, sector: str, name: str, make: Callable[[], Metric]) -> Metric:
        if (sector, name) not in self.metrics:
            self.metrics[sector, name] = make()
        return self.metrics[sector, name]  # pyright: ignore[reportReturnType] made by the same function before

    def _images(
        self, sector: str, predicted: np.ndarray, target: np.ndarray, name: str, valid: np.ndarray | None = None
    ) -> None:
        """Count SSIM and patches of an image, as far as it is large enough for their windows."""
        side = min(target.shape[:2])
        if side >= WINDOW:
            self._metric(sector, "ssim", SSIM).update(predicted, target, name, valid=valid)
        for metric, patches in self.config.patches.items():
            if side >= PATCH * patches.shrink:
                make = partial(PatchFrechetDistance, *patches)
                self._metric(sector, metric, make).update(predicted, target, name, valid)


def _mean_iou() -> MeanIoU:
    return MeanIoU(COMMON15, unscored=UNSCORED)


def _order(key: tuple[str, str]) -> tuple[int, int]:
    sector, name = key
    return SECTOR_ORDER.index(sector), list(NAMES).index(name)
