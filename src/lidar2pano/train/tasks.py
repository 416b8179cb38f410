"""The tasks by name; importing this imports all of them, and torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidar2pano.train.autoencoding import Autoencoding
from lidar2pano.train.camera_segmentation import CameraSegmentation
from lidar2pano.train.colour import CameraColour, FrontColour, Pix2PixColours
from lidar2pano.train.encoding import Encoding
from lidar2pano.train.front import FrontDepthTranslation, FrontTranslation, Pix2PixSegments
from lidar2pano.train.latent_painting import LatentPainting
from lidar2pano.train.latent_texture import LatentTexture
from lidar2pano.train.panorama import PanoramaTranslation
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.segmentation import Segmentation
from lidar2pano.train.task import Task
from lidar2pano.train.video import VideoPainting

TASKS: dict[str, Any] = {  # classes, made of a recipe and the folder of its data
    "segmentation": Segmentation,
    "camera-segmentation": CameraSegmentation,
    "front": FrontTranslation,
    "front-depth": FrontDepthTranslation,
    "pix2pix-segments": Pix2PixSegments,
    "front-colour": FrontColour,
    "camera-colour": CameraColour,
    "pix2pix-colours": Pix2PixColours,
    "panorama": PanoramaTranslation,
    "autoencoding": Autoencoding,
    "latent-painting": LatentPainting,
    "latent-texture": LatentTexture,
    "encoding": Encoding,
    "video": VideoPainting,
}


def build_task(recipe: Recipe, root: Path) -> Task:
    """The recipe's task over the data under `root`; InputError for impossible settings, or without its data."""
    return TASKS[recipe.task](recipe, root)
