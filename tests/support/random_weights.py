"""A family of untrained networks that are small and fast, and scans and data sets to go with it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import nn

from lidar2pano.calibration import Calibration
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.labels import CITYSCAPES, SEMANTIC_KITTI
from lidar2pano.models import build
from lidar2pano.models.camera_teachers import ImageNormalisation
from lidar2pano.models.card import Card, save
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS

SEGMENTER_VIEW = replace(VIEWS["hdl64e"], rows=32, columns=256)
TRANSLATOR_VIEW = VIEWS["panorama"].scaled(1 / 8)  # 48 x 576
CAMERA = Calibration(
    K=np.array([[60.0, 0, 40], [0, 60, 12], [0, 0, 1]]),
    T_camera_lidar=np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]),
    size=(80, 25),
)
FRONT_VIEW = replace(VIEWS["titan-front"], rows=32, columns=64)
LICENCE = "CC-BY-NC-SA-4.0"
PAINTER: dict[str, Any] = {  # settings that make a latent painter small
    "latents": 4,
    "autoencoder": [[4, 6, 8], [4, 4, 6, 8]],
    "mean": [[4, 6, 8], [1, 1, 1]],
    "flow": [[4, 6, 8], [1, 1, 1]],
    "code": 8,
}
CALIB = (
    "P2: 718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761\n"
    "Tr: 0.0004276802 -0.9999672 -0.008084491 -0.01198459 -0.007210626 0.008081198 -0.9999413 -0.05403984"
    " 0.9999738 0.0004859485 -0.007206933 -0.2921968\n"
)


def spread_norms(network: nn.Module) -> nn.Module:
    """Give every batch norm statistics and a scale of its own, as training does."""
    for layer in network.modules():
        if isinstance(layer, nn.BatchNorm2d):
            nn.init.uniform_(layer.weight, 0.5, 1.5)
            nn.init.uniform_(layer.bias, -0.2, 0.2)
            nn.init.uniform_(layer.running_mean, -0.2, 0.2)
            nn.init.uniform_(layer.running_var, 0.5, 1.5)
    return network


def write_weights(folder: Path, role: str, network: str, settings: dict[str, Any], **card: Any) -> Path:
    """Save an untrained network as FOLDER/ROLE.safetensors."""
    torch.manual_seed(len(role))
    path = folder / f"{role}.safetensors"
    model = spread_norms(build(network, **settings)).eval()
    save(path, model, Card(network=network, settings=settings, licence=LICENCE, **card))
    return path


def _plain() -> dict[str, list[float]]:
    normalise = Normalisation()
    return {"mean": list(normalise.mean), "deviation": list(normalise.deviation)}


def write_segmenter(folder: Path) -> Path:
    """Save an untrained, narrow SalsaNext on a small view."""
    views = {"input": SEGMENTER_VIEW.as_dict()}
    score = {"point_miou": 0.5, "split": "val"}
    return write_weights(
        folder,
        "segmenter",
        "salsanext",
        {"widths": [8, 8, 16, 16]},
        labels="semantic-kitti",
        normalisation=_plain(),
        views=views,
        score=score,
    )


def write_family(folder: Path) -> Path:
    """Write segmenter, translator and painter into a folder."""
    views = {"panorama": TRANSLATOR_VIEW.as_dict()}
    slim = {"widths": [8, 8, 8, 8, 8], "pyramid": 8}
    write_segmenter(folder)
    write_weights(folder, "translator", "titan-pano", slim, labels="common-15", views=views)
    write_weights(folder, "painter", "latent-painter", PAINTER | {"looks": ["day"]}, views=views)
    return folder


def write_front(folder: Path) -> Path:
    """Write a segmenter and a translator of the paper's kind into a folder."""
    write_segmenter(folder)
    views = {"input": FRONT_VIEW.as_dict()}
    write_weights(
        folder, "titan", "titan", {"size": [48, 160]}, labels="common-14", views=views, normalisation=_plain()
    )
    return folder


def write_camera_teacher(path: Path) -> Path:
    """Save an untrained, small SD-Net, a teacher of camera images."""
    settings = {"width": 4, "stem": 8, "blocks": 1, "modules": [1, 1, 1], "context": 16, "scales": [1.0]}
    torch.manual_seed(0)
    card = {"labels": CITYSCAPES.name, "normalisation": ImageNormalisation().as_dict()}
    save(path, build("sdnet", **settings).eval(), Card(network="sdnet", settings=settings, **card))
    return path


def street(points: int = 4000, seed: int = 0) -> Scan:
    """Points all around between 3 and 40 m, as an HDL-64E sees them."""
    generator = np.random.default_rng(seed)
    azimuth, elevation = generator.uniform(-np.pi, np.pi, points), np.radians(generator.uniform(-24, 2, points))
    range_m = generator.uniform(3, 40, points)
    flat = range_m * np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)], axis=1)
    return Scan(xyz=xyz.astype(np.float32), remission=generator.random(points).astype(np.float32), name="street")


def write_scan(path: Path, scan: Scan | None = None) -> Path:
    """Write a scan (a street's, when None) as a KITTI .bin."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bin(path, scan or street())
    return path


def write_data_set(root: Path, frames: int = 2, size: tuple[int, int] = (1241, 376)) -> Path:
    """Write a miniature data set in SemanticKITTI's layout with one sequence, 00, and the split "val"."""
    generator = np.random.default_rng(1)
    sequence = root / "sequences" / "00"
    for folder in ("velodyne", "labels", "image_2", "camera_labels"):
        (sequence / folder).mkdir(parents=True)
    for number in range(frames):
        scan = street(seed=number)
        write_scan(sequence / "velodyne" / f"{number:06d}.bin", scan)
        raw = SEMANTIC_KITTI.to_raw(generator.integers(0, len(SEMANTIC_KITTI), len(scan)))
        raw.astype("<u4").tofile(sequence / "labels" / f"{number:06d}.label")
        coarse = generator.choice(np.array([0, 2, 8, 10, 13, 255], dtype=np.uint8), (4, 12))
        ids = Image.fromarray(coarse).resize(size, Image.Resampling.NEAREST)
        ids.save(sequence / "camera_labels" / f"{number:06d}.png")
        Image.fromarray(np.full((size[1], size[0], 3), 99, np.uint8)).save(sequence / "image_2" / f"{number:06d}.png")
    (sequence / "calib.txt").write_text(CALIB)
    (root / "splits.json").write_text(json.dumps({"val": [f"00/{number:06d}" for number in range(frames)]}))
    return root
