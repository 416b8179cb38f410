"""The two teachers: one labels scans, one images. Networks are loaded when there is something to label."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.data.frames import IGNORE
from lidar2pano.data.journal import stamp_of
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import read_image, write_ids
from lidar2pano.formats.scan_files import write_label
from lidar2pano.hardware import pick_device
from lidar2pano.models.camera_teachers import (
    MODEL_TYPES,
    CameraSegmenter,
    CameraTeacher,
    load_teacher,
    local_folder,
    parts_of,
)
from lidar2pano.models.card import load, read_card
from lidar2pano.models.families import weight_files
from lidar2pano.models.sdnet import falling
from lidar2pano.pipeline import Segmenter, load_segmenter

FORM = 1  # part of every teacher's name: raise it when the same weights give other labels, and all are made again
PNG_END = b"IEND\xaeB`\x82"


@dataclass(kw_only=True)
class LidarTeacher:
    """A range-view segmenter: scans -> raw ids of SemanticKITTI per point.

    folder   of a sequence, for the files, whose ending is `suffix`.
    made_by  hash of weights and settings: files of another one are made again.
    weights  files of the network;  device: torch's, or "auto".
    """

    suffix: ClassVar[str] = ".label"
    folder: str
    made_by: str
    weights: tuple[Path, ...]
    device: str

    def source(self, frame: SemanticKittiFrame) -> Path | None:
        """The scan, None if absent."""
        return frame.scan_file if os.path.lexists(frame.scan_file) else None

    @cached_property
    def network(self) -> Segmenter:
        """The segmenter, loaded; InputError when its weights cannot be used."""
        return load_segmenter(self.weights[0], pick_device(self.device))[0]

    def write(self, frame: SemanticKittiFrame, path: Path) -> None:
        """Write raw ids (N,) uint32 in file order; a scan without a usable point raises InputError."""
        scan = frame.scan
        if not np.isfinite(scan.xyz).all(1).any():
            raise InputError(f"{frame.scan_file}: none of its {len(scan)} points can be used (NaN or Inf); replace it")
        write_label(path, self.network.points(scan, pick_device(self.device)).cpu().numpy())

    def whole(self, frame: SemanticKittiFrame, path: Path) -> bool:
        """Tell if there is one label per point: 4 bytes for a scan's 16."""
        return path.stat().st_size * 4 == frame.scan_file.stat().st_size


@dataclass(kw_only=True)
class ImageTeacher:
    """A camera teacher: images -> Cityscapes train ids per pixel; further fields as of LidarTeacher.

    spec             "mask2former" or "oneformer" with a folder in `weights`, or "sdnet" with a file.
    scales           of the labelled image; () for the network's own.
    min_probability  of the best class; a pixel below it becomes IGNORE.
    """

    suffix: ClassVar[str] = ".png"
    folder: str
    made_by: str
    weights: tuple[Path, ...]
    device: str
    spec: str
    scales: tuple[float, ...]
    min_probability: float

    def source(self, frame: SemanticKittiFrame) -> Path | None:
        """The image, None if absent."""
        return frame.image_file

    @cached_property
    def network(self) -> CameraTeacher:
        """The network, loaded; InputError when its weights cannot be used."""
        device = pick_device(self.device)
        if self.spec in MODEL_TYPES:
            return load_teacher(self.spec, self.weights[0], device, self.scales or (1.0,))
        network, card = load(self.weights[0], device, expect="sdnet")
        return CameraSegmenter.from_card(network, card, self.scales or None)

    def write(self, frame: SemanticKittiFrame, path: Path) -> None:
        """Write ids (h, w) uint8 as a PNG of grey values."""
        assert frame.image_file is not None
        best, ids = self.network.probabilities(read_image(frame.image_file, "RGB")).max(0)
        ids[best < self.min_probability] = IGNORE
        write_ids(path, ids.cpu().numpy().astype(np.uint8))

    def whole(self, frame: SemanticKittiFrame, path: Path) -> bool:
        """Tell if it is an image, to its end."""
        try:
            read_image(path)
        except InputError:
            return False
        return path.suffix != ".png" or PNG_END in read_input(path, "label the image again")


Teacher = LidarTeacher | ImageTeacher


def lidar_teacher(weights: str, *, folder: str = "labels", device: str = "auto") -> LidarTeacher:
    """The LiDAR teacher of a family, a run or a weight file. InputError when it has no segmenter, or no such device."""
    pick_device(device)
    files = weight_files(weights, fill=False)
    if "segmenter" not in files:
        raise InputError(f"{weights}: has no segmenter to label scans with; name a family, a run or a file that has")
    file = files["segmenter"]
    return LidarTeacher(folder=folder, made_by=_hash([file], {}), weights=(file,), device=device)


def camera_teacher(
    spec: str,
    *,
    folder: str = "camera_labels",
    scales: Sequence[float] = (),
    min_probability: float = 0.4,
    device: str = "auto",
) -> ImageTeacher:
    """The camera teacher of a weight file or run of SD-Net, or of "mask2former:PATH" or "oneformer:PATH".

    PATH             a folder, or the name of a model in the hub's cache; nothing is downloaded.
    scales           sizes of the image to label, as factors (without any: SD-Net its own, the others 1).
    min_probability  of the best class; a pixel below it is labelled IGNORE.
    Raises InputError when the weights or the device are not there, or a setting cannot be.
    """
    pick_device(device)
    check_camera_settings(scales, min_probability)
    model_type, _, place = spec.partition(":")
    if model_type in MODEL_TYPES and place:
        source = local_folder(place)
        hashed = parts_of(source)
    else:
        model_type, source = "sdnet", _sdnet_file(spec)
        hashed = [source]
        if scales:
            falling(scales)  # refuses early, not image by image
    # these keys are hashed into made_by of journals: they stay
    settings = {"kind": model_type, "scales": list(scales), "unsure": min_probability}
    return ImageTeacher(
        folder=folder,
        made_by=_hash(hashed, settings),
        weights=(source,),
        device=device,
        spec=model_type,
        scales=tuple(scales),
        min_probability=min_probability,
    )


def check_camera_settings(scales: Sequence[float], min_probability: float) -> None:
    """Raise InputError for settings of `camera_teacher` out of range."""
    if not 0 <= min_probability < 1:
        raise InputError(f"--unsure {min_probability:g} is no probability; choose one from 0 up to, not including, 1")
    if any(not 0 < scale <= 4 for scale in scales) or len(set(scales)) < len(scales):
        raise InputError(f"--scales {','.join(f'{s:g}' for s in scales)} cannot be: name factors up to 4, each once")


def _sdnet_file(name: str) -> Path:
    """The one SD-Net in a weight file, a folder or a run's folder."""
    path = Path(name)
    if path.is_file():
        if (network := read_card(path).network) != "sdnet":
            raise InputError(f"{path} has weights of another network: {network!r} instead of 'sdnet'; name others")
        return path
    if not path.is_dir():
        raise InputError(
            f"no camera teacher {name!r}: name weights of sdnet, a run's folder, mask2former:PATH or oneformer:PATH"
        )
    folder = path / "weights" if (path / "weights").is_dir() else path
    files = [file for file in sorted(folder.glob("*.safetensors")) if not file.stem.endswith(".last")]
    networks = [file for file in files if read_card(file).network == "sdnet"]
    if len(networks) != 1:
        raise InputError(f"{folder}: holds {len(networks) or 'no'} weights of sdnet; name the file")
    return networks[0]


def _hash(files: Iterable[Path], settings: dict[str, object]) -> str:
    """A name for weights and settings: SHA-256 over the files' contents and the settings."""
    digest = hashlib.sha256(json.dumps({"form": FORM, **settings}, sort_keys=True).encode())
    for path in files:
        digest.update(stamp_of(path).sha256.encode())
    return digest.hexdigest()
