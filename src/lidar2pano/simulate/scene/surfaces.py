"""Kinds of surface, and the class that each label set gives them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.labels import CITYSCAPES, COMMON15


class Material(NamedTuple):
    """One row.

    texture   name in textures.TEXTURES, which says how the surface varies ("" = even).
    colour    linear RGB albedo in [0, 1]; a face's tint multiplies it.
    gloss     share of light that mirrors at right angles (Fresnel's F0); 0 is matt.
    rough     how far the mirror image is smeared: 0 a mirror, 1 not at all visible.
    light     colour it sends out by itself, linear RGB (lamps, traffic lights).
    cutout    name in textures.CUTOUTS: where the surface is a hole (leaves, wire fences); "" = nowhere.
    through   share of the sunlight that passes from the other side (leaves).
    lidar     reflectance at 905 nm at right angles, as remission in [0, 1].
    spread    relative standard deviation of `lidar` from place to place.
    retro     remission of a retro-reflector, independent of the angle; 0 = none.
    loss      probability that no pulse comes back at right angles and near by (glass, black paint, water).
    """

    texture: str = ""
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)
    gloss: float = 0.0
    rough: float = 1.0
    light: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cutout: str = ""
    through: float = 0.0
    lidar: float = 0.3
    spread: float = 0.15
    retro: float = 0.0
    loss: float = 0.0


MATERIALS: dict[str, Material] = {
    # ground
    "asphalt": Material("asphalt", (0.12, 0.12, 0.12), 0.03, 0.7, lidar=0.23, spread=0.2),
    "asphalt-new": Material("asphalt", (0.06, 0.06, 0.062), 0.03, 0.6, lidar=0.16, spread=0.2),
    "paint-white": Material("paint", (0.55, 0.55, 0.53), lidar=0.5, spread=0.3),
    "cobbles": Material("cobbles", (0.17, 0.165, 0.16), lidar=0.3),
    "paving": Material("paving", (0.24, 0.23, 0.22), lidar=0.32, spread=0.1),
    "kerb": Material("concrete", (0.28, 0.275, 0.265), lidar=0.34),
    "gravel": Material("gravel", (0.26, 0.24, 0.21), lidar=0.33, spread=0.25),
    "soil": Material("soil", (0.13, 0.10, 0.07), lidar=0.3, spread=0.25),
    "grass": Material("grass", (0.062, 0.077, 0.031), lidar=0.36, spread=0.12),
    "meadow": Material("meadow", (0.095, 0.098, 0.046), lidar=0.36, spread=0.18),
    "field": Material("field", (0.20, 0.165, 0.09), lidar=0.34, spread=0.2),
    # buildings
    "plaster": Material("plaster", (0.43, 0.41, 0.37), lidar=0.42, spread=0.25),
    "brick": Material("brick", (0.24, 0.125, 0.095), lidar=0.39, spread=0.25),
    "concrete": Material("concrete", (0.30, 0.295, 0.28), lidar=0.38),
    "stone": Material("stone", (0.25, 0.23, 0.20), lidar=0.36),
    "tiles": Material("tiles", (0.24, 0.105, 0.07), lidar=0.38),
    "slate": Material("tiles", (0.085, 0.085, 0.095), lidar=0.2),
    "wood": Material("wood", (0.20, 0.135, 0.085), lidar=0.38),
    "frame": Material("", (0.60, 0.60, 0.58), 0.04, 0.3, lidar=0.45),
    "shutter": Material("shutter", (0.35, 0.35, 0.35), lidar=0.4),
    "door": Material("wood", (0.26, 0.22, 0.18), 0.03, 0.4, lidar=0.35),
    "pane": Material("pane", (0.03, 0.035, 0.04), 0.08, 0.02, lidar=0.08, spread=0.6, loss=0.75),
    # made of metal or plastic
    "metal": Material("metal", (0.42, 0.43, 0.44), 0.35, 0.4, lidar=0.28, spread=0.5),
    "dark-metal": Material("", (0.05, 0.05, 0.055), 0.05, 0.4, lidar=0.08, spread=0.5),
    "plastic": Material("", (0.30, 0.30, 0.30), 0.04, 0.35, lidar=0.35),
    "wire": Material("", (0.35, 0.37, 0.36), 0.1, 0.5, cutout="wire", lidar=0.35, spread=0.3),
    "pickets": Material("wood", (0.28, 0.22, 0.16), cutout="pickets", lidar=0.4),
    "railing": Material("", (0.12, 0.13, 0.13), 0.1, 0.4, cutout="railing", lidar=0.25),
    # vehicles
    "paint": Material("car-paint", (0.5, 0.5, 0.5), 0.05, 0.06, lidar=0.5, spread=0.2, loss=0.001),
    "window": Material("", (0.02, 0.022, 0.025), 0.08, 0.02, lidar=0.06, spread=0.6, loss=0.9),
    "rubber": Material("", (0.025, 0.025, 0.025), 0.02, 0.8, lidar=0.06, loss=0.1),
    "rim": Material("", (0.45, 0.46, 0.47), 0.3, 0.3, lidar=0.4, spread=0.4),
    "underbody": Material("", (0.015, 0.015, 0.015), lidar=0.06, loss=0.3),
    "headlamp": Material("", (0.7, 0.7, 0.72), 0.15, 0.1, lidar=0.4, retro=0.7),
    "tail-lamp": Material("", (0.42, 0.02, 0.02), 0.08, 0.1, lidar=0.4, retro=0.9),
    "plate": Material("plate", (0.65, 0.65, 0.63), lidar=0.6, retro=0.95),
    "tarpaulin": Material("cloth", (0.35, 0.35, 0.35), lidar=0.4),
    # people
    "skin": Material("", (0.42, 0.27, 0.20), lidar=0.4),
    "hair": Material("", (0.08, 0.05, 0.03), lidar=0.2),
    "cloth": Material("cloth", (0.28, 0.28, 0.28), lidar=0.34, spread=0.3),
    # plants
    "bark": Material("bark", (0.10, 0.08, 0.06), lidar=0.36, spread=0.25),
    "bark-birch": Material("birch", (0.42, 0.41, 0.38), lidar=0.42, spread=0.25),
    "leaves": Material(
        "leaves", (0.112, 0.142, 0.047), 0.03, 0.6, cutout="leaves", through=0.35, lidar=0.36, spread=0.35
    ),
    "needles": Material(
        "leaves", (0.052, 0.076, 0.034), 0.02, 0.7, cutout="needles", through=0.2, lidar=0.33, spread=0.35
    ),
    "hedge": Material(
        "leaves", (0.086, 0.115, 0.039), 0.03, 0.6, cutout="leaves", through=0.25, lidar=0.35, spread=0.35
    ),
    "hedge-core": Material("", (0.012, 0.016, 0.007), lidar=0.3, spread=0.3),
    # signs and lights; a sign's picture is its tint and the texture's mask
    "sign": Material("", (0.62, 0.62, 0.62), lidar=0.7, retro=0.97),
    "sign-back": Material("", (0.35, 0.36, 0.37), 0.2, 0.5, lidar=0.4),
    "lamp": Material("", (0.8, 0.8, 0.78), 0.05, 0.3, lidar=0.4),
    "light-red": Material("", (0.3, 0.02, 0.02), light=(1.6, 0.08, 0.05), lidar=0.4, retro=0.4),
    "light-yellow": Material("", (0.3, 0.2, 0.02), light=(1.5, 0.8, 0.05), lidar=0.4, retro=0.4),
    "light-green": Material("", (0.02, 0.3, 0.1), light=(0.08, 1.5, 0.5), lidar=0.4, retro=0.4),
    "light-off": Material("", (0.06, 0.06, 0.06), lidar=0.3),
}

MATERIAL_IDS: dict[str, int] = {name: index for index, name in enumerate(MATERIALS)}


def column(field: str) -> np.ndarray:
    """One numeric field of all materials as float32: (M,) or (M, 3)."""
    return np.array([getattr(material, field) for material in MATERIALS.values()], dtype=np.float32)


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
