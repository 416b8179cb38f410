"""Kinds of surface, and the class that each label set gives them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.labels import CITYSCAPES, COMMON15

UNSURE = 255  # camera label of what Cityscapes has no train id for


class Kind(NamedTuple):
    """One row: SemanticKITTI's raw id standing and moving, Cityscapes' class ("" for none), common-15's class."""

    raw: int
    moving: int
    camera: str
    common: str


KINDS: dict[str, Kind] = {
    "road": Kind(40, 40, "road", "road"),
    "lane-marking": Kind(60, 60, "road", "road"),
    "parking": Kind(44, 44, "sidewalk", "sidewalk"),  # where the paper's table 4 puts it
    "sidewalk": Kind(48, 48, "sidewalk", "sidewalk"),
    "other-ground": Kind(49, 49, "", "unlabeled"),  # rails' beds, water
    "terrain": Kind(72, 72, "terrain", "terrain"),
    "vegetation": Kind(70, 70, "vegetation", "vegetation"),
    "trunk": Kind(71, 71, "vegetation", "vegetation"),
    "building": Kind(50, 50, "building", "building"),
    "fence": Kind(51, 51, "fence", "fence"),
    "wall": Kind(51, 51, "wall", "fence"),  # free-standing
    "guard-rail": Kind(51, 51, "fence", "fence"),
    "pole": Kind(80, 80, "pole", "pole"),
    "traffic-sign": Kind(81, 81, "traffic sign", "traffic-sign"),
    "traffic-light": Kind(81, 81, "traffic light", "traffic-sign"),
    "car": Kind(10, 252, "car", "car"),
    "truck": Kind(18, 258, "truck", "truck"),
    "bus": Kind(13, 257, "bus", "other-vehicle"),
    "tram": Kind(16, 256, "train", "other-vehicle"),
    "trailer": Kind(20, 259, "truck", "other-vehicle"),
    "motorcycle": Kind(15, 15, "motorcycle", "motorcycle"),
    "bicycle": Kind(11, 11, "bicycle", "bicycle"),
    "person": Kind(30, 254, "person", "person"),
    "bicyclist": Kind(31, 253, "rider", "person"),
    "ridden-bicycle": Kind(31, 253, "bicycle", "person"),  # SemanticKITTI: one class with its rider
    "motorcyclist": Kind(32, 255, "rider", "person"),
    "ridden-motorcycle": Kind(32, 255, "motorcycle", "person"),
    "other-object": Kind(99, 99, "", "unlabeled"),  # bins, boxes, benches
}

KIND_IDS: dict[str, int] = {name: index for index, name in enumerate(KINDS)}
SKY = 255  # in pictures of kinds: nothing was met

RAW = np.array([kind.raw for kind in KINDS.values()], dtype=np.uint16)
RAW_MOVING = np.array([kind.moving for kind in KINDS.values()], dtype=np.uint16)


def _camera_ids() -> np.ndarray:
    table = np.full(256, UNSURE, dtype=np.uint8)
    for index, kind in enumerate(KINDS.values()):
        table[index] = CITYSCAPES.id_of(kind.camera) if kind.camera else UNSURE
    table[SKY] = CITYSCAPES.id_of("sky")
    return table


def _common_ids() -> np.ndarray:
    table = np.zeros(256, dtype=np.uint8)
    for index, kind in enumerate(KINDS.values()):
        table[index] = COMMON15.id_of(kind.common)
    table[SKY] = COMMON15.id_of("sky")
    return table


CAMERA_IDS, COMMON_IDS = _camera_ids(), _common_ids()
"""Per kind (and SKY): Cityscapes' train id, common-15's id; (256,) uint8."""
