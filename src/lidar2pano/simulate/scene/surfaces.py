"""Surfaces: their materials with the cut-outs of some, and their object types."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from lidar2pano.labels import CITYSCAPES, COMMON15, LabelSet
from lidar2pano.simulate.scene.random_streams import stream


class Material(NamedTuple):
    """Optical properties of a surface, for the cameras and for the LiDAR.

    texture          name in textures.TEXTURES; "" = uniform.
    albedo           linear RGB in [0, 1]; a face's tint multiplies it.
    specular         Fresnel reflectance at normal incidence (F0); 0 = matt.
    roughness        of the specular reflection: 0 a mirror, 1 no highlight at all.
    emission         linear RGB radiance (lamps, traffic lights).
    cutout           name in cutouts.CUTOUTS, the mask of the surface's holes (leaves, wire fences); "" = no holes.
    transmission     share of the sunlight from the other side (leaves).
    remission        at 905 nm and normal incidence, in [0, 1].
    variation        relative standard deviation of `remission` from place to place.
    retroreflection  remission of a retro-reflector, independent of the angle; 0 = none.
    dropout          probability of a lost pulse at normal incidence and short range (glass, black paint).
    """

    texture: str = ""
    albedo: tuple[float, float, float] = (0.5, 0.5, 0.5)
    specular: float = 0.0
    roughness: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cutout: str = ""
    transmission: float = 0.0
    remission: float = 0.3
    variation: float = 0.15
    retroreflection: float = 0.0
    dropout: float = 0.0


MATERIALS: dict[str, Material] = {
    # ground
    "asphalt": Material("asphalt", (0.12, 0.12, 0.12), 0.03, 0.7, remission=0.23, variation=0.2),
    "asphalt-new": Material("asphalt", (0.06, 0.06, 0.062), 0.03, 0.6, remission=0.16, variation=0.2),
    "paint-white": Material("paint", (0.55, 0.55, 0.53), remission=0.5, variation=0.3),
    "cobbles": Material("cobbles", (0.17, 0.165, 0.16), remission=0.3),
    "paving": Material("paving", (0.24, 0.23, 0.22), remission=0.32, variation=0.1),
    "kerb": Material("concrete", (0.28, 0.275, 0.265), remission=0.34),
    "gravel": Material("gravel", (0.26, 0.24, 0.21), remission=0.33, variation=0.25),
    "soil": Material("soil", (0.13, 0.10, 0.07), remission=0.3, variation=0.25),
    "grass": Material("grass", (0.062, 0.077, 0.031), remission=0.36, variation=0.12),
    "meadow": Material("meadow", (0.095, 0.098, 0.046), remission=0.36, variation=0.18),
    "field": Material("field", (0.20, 0.165, 0.09), remission=0.34, variation=0.2),
    # buildings
    "plaster": Material("plaster", (0.43, 0.41, 0.37), remission=0.42, variation=0.25),
    "brick": Material("brick", (0.24, 0.125, 0.095), remission=0.39, variation=0.25),
    "concrete": Material("concrete", (0.30, 0.295, 0.28), remission=0.38),
    "stone": Material("stone", (0.25, 0.23, 0.20), remission=0.36),
    "tiles": Material("tiles", (0.24, 0.105, 0.07), remission=0.38),
    "slate": Material("tiles", (0.085, 0.085, 0.095), remission=0.2),
    "wood": Material("wood", (0.20, 0.135, 0.085), remission=0.38),
    "frame": Material("", (0.60, 0.60, 0.58), 0.04, 0.3, remission=0.45),
    "shutter": Material("shutter", (0.35, 0.35, 0.35), remission=0.4),
    "door": Material("wood", (0.26, 0.22, 0.18), 0.03, 0.4, remission=0.35),
    "pane": Material("pane", (0.03, 0.035, 0.04), 0.08, 0.02, remission=0.08, variation=0.6, dropout=0.75),
    # made of metal or plastic
    "metal": Material("metal", (0.42, 0.43, 0.44), 0.35, 0.4, remission=0.28, variation=0.5),
    "dark-metal": Material("", (0.05, 0.05, 0.055), 0.05, 0.4, remission=0.08, variation=0.5),
    "plastic": Material("", (0.30, 0.30, 0.30), 0.04, 0.35, remission=0.35),
    "wire": Material("", (0.35, 0.37, 0.36), 0.1, 0.5, cutout="wire", remission=0.35, variation=0.3),
    "pickets": Material("wood", (0.28, 0.22, 0.16), cutout="pickets", remission=0.4),
    "railing": Material("", (0.12, 0.13, 0.13), 0.1, 0.4, cutout="railing", remission=0.25),
    # vehicles
    "paint": Material("car-paint", (0.5, 0.5, 0.5), 0.05, 0.06, remission=0.5, variation=0.2, dropout=0.001),
    "window": Material("", (0.02, 0.022, 0.025), 0.08, 0.02, remission=0.06, variation=0.6, dropout=0.9),
    "rubber": Material("", (0.025, 0.025, 0.025), 0.02, 0.8, remission=0.06, dropout=0.1),
    "rim": Material("", (0.45, 0.46, 0.47), 0.3, 0.3, remission=0.4, variation=0.4),
    "underbody": Material("", (0.015, 0.015, 0.015), remission=0.06, dropout=0.3),
    "headlamp": Material("", (0.7, 0.7, 0.72), 0.15, 0.1, remission=0.4, retroreflection=0.7),
    "tail-lamp": Material("", (0.42, 0.02, 0.02), 0.08, 0.1, remission=0.4, retroreflection=0.9),
    "plate": Material("plate", (0.65, 0.65, 0.63), remission=0.6, retroreflection=0.95),
    "tarpaulin": Material("cloth", (0.35, 0.35, 0.35), remission=0.4),
    # people
    "skin": Material("", (0.42, 0.27, 0.20), remission=0.4),
    "hair": Material("", (0.08, 0.05, 0.03), remission=0.2),
    "cloth": Material("cloth", (0.28, 0.28, 0.28), remission=0.34, variation=0.3),
    # plants
    "bark": Material("bark", (0.10, 0.08, 0.06), remission=0.36, variation=0.25),
    "bark-birch": Material("birch", (0.42, 0.41, 0.38), remission=0.42, variation=0.25),
    "leaves": Material(
        "leaves", (0.112, 0.142, 0.047), 0.03, 0.6, cutout="leaves", transmission=0.35, remission=0.36, variation=0.35
    ),
    "needles": Material(
        "leaves", (0.052, 0.076, 0.034), 0.02, 0.7, cutout="needles", transmission=0.2, remission=0.33, variation=0.35
    ),
    "hedge": Material(
        "leaves", (0.086, 0.115, 0.039), 0.03, 0.6, cutout="leaves", transmission=0.25, remission=0.35, variation=0.35
    ),
    "hedge-core": Material("", (0.012, 0.016, 0.007), remission=0.3, variation=0.3),
    # signs and lights; a sign's symbols are polygons of other tints
    "sign": Material("", (0.62, 0.62, 0.62), remission=0.7, retroreflection=0.97),
    "sign-back": Material("", (0.35, 0.36, 0.37), 0.2, 0.5, remission=0.4),
    "lamp": Material("", (0.8, 0.8, 0.78), 0.05, 0.3, remission=0.4),
    "light-red": Material("", (0.3, 0.02, 0.02), emission=(1.6, 0.08, 0.05), remission=0.4, retroreflection=0.4),
    "light-yellow": Material("", (0.3, 0.2, 0.02), emission=(1.5, 0.8, 0.05), remission=0.4, retroreflection=0.4),
    "light-green": Material("", (0.02, 0.3, 0.1), emission=(0.08, 1.5, 0.5), remission=0.4, retroreflection=0.4),
    "light-off": Material("", (0.06, 0.06, 0.06), remission=0.3),
}

MATERIAL_IDS: dict[str, int] = {name: index for index, name in enumerate(MATERIALS)}
"""Of the windows and doors of buildings."""


def material_table(field: str) -> np.ndarray:
    """One numeric field of all materials as float32: (M,) or (M, 3)."""
    return np.array([getattr(material, field) for material in MATERIALS.values()], dtype=np.float32)


IGNORE = 255  # camera label of object types that Cityscapes has no train id for


class ObjectType(NamedTuple):
    """One class of the simulator, in every label set.

    raw, moving  SemanticKITTI's raw ids of static and of moving objects.
    cityscapes   class of Cityscapes, "" for none;  common: class of common-15.
    """

    raw: int
    moving: int
    cityscapes: str
    common: str


OBJECT_TYPES: dict[str, ObjectType] = {
    "road": ObjectType(40, 40, "road", "road"),
    "lane-marking": ObjectType(60, 60, "road", "road"),
    "parking": ObjectType(44, 44, "sidewalk", "sidewalk"),  # where the paper's table 4 puts it
    "sidewalk": ObjectType(48, 48, "sidewalk", "sidewalk"),
    "other-ground": ObjectType(49, 49, "", "unlabeled"),  # rails' beds, water
    "terrain": ObjectType(72, 72, "terrain", "terrain"),
    "vegetation": ObjectType(70, 70, "vegetation", "vegetation"),
    "trunk": ObjectType(71, 71, "vegetation", "vegetation"),
    "building": ObjectType(50, 50, "building", "building"),
    "fence": ObjectType(51, 51, "fence", "fence"),
    "wall": ObjectType(51, 51, "wall", "fence"),  # free-standing
    "guard-rail": ObjectType(51, 51, "fence", "fence"),
    "pole": ObjectType(80, 80, "pole", "pole"),
    "traffic-sign": ObjectType(81, 81, "traffic sign", "traffic-sign"),
    "traffic-light": ObjectType(81, 81, "traffic light", "traffic-sign"),
    "car": ObjectType(10, 252, "car", "car"),
    "truck": ObjectType(18, 258, "truck", "truck"),
    "bus": ObjectType(13, 257, "bus", "other-vehicle"),
    "tram": ObjectType(16, 256, "train", "other-vehicle"),
    "trailer": ObjectType(20, 259, "truck", "other-vehicle"),
    "motorcycle": ObjectType(15, 15, "motorcycle", "motorcycle"),
    "bicycle": ObjectType(11, 11, "bicycle", "bicycle"),
    "person": ObjectType(30, 254, "person", "person"),
    "bicyclist": ObjectType(31, 253, "rider", "person"),
    "ridden-bicycle": ObjectType(31, 253, "bicycle", "person"),  # SemanticKITTI: one class with its rider
    "motorcyclist": ObjectType(32, 255, "rider", "person"),
    "ridden-motorcycle": ObjectType(32, 255, "motorcycle", "person"),
    "other-object": ObjectType(99, 99, "", "unlabeled"),  # bins, boxes, benches
}

OBJECT_TYPE_IDS: dict[str, int] = {name: index for index, name in enumerate(OBJECT_TYPES)}
SKY = 255  # object type of rays without a hit

RAW_IDS = np.array([object_type.raw for object_type in OBJECT_TYPES.values()], dtype=np.uint16)
RAW_MOVING_IDS = np.array([object_type.moving for object_type in OBJECT_TYPES.values()], dtype=np.uint16)


def _ids(labels: LabelSet, classes: list[str], unlabelled: int) -> np.ndarray:
    """Ids (256,) uint8 of object types, named by `classes` ("" = none), and of SKY."""
    table = np.full(256, unlabelled, dtype=np.uint8)
    table[: len(classes)] = [labels.id_of(name) if name else unlabelled for name in classes]
    table[SKY] = labels.id_of("sky")
    return table


CITYSCAPES_IDS = _ids(CITYSCAPES, [object_type.cityscapes for object_type in OBJECT_TYPES.values()], IGNORE)
COMMON15_IDS = _ids(COMMON15, [object_type.common for object_type in OBJECT_TYPES.values()], 0)
"""Per object type (and SKY): Cityscapes' train id, common-15's id; (256,) uint8."""


SIZE = 256  # pixels of a mask's side


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """u and v (size, size) of the pixels' centres of a tile with period 1."""
    u, v = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size)
    return u, v


def _leaf(solid: np.ndarray, foot: np.ndarray, turn: float, length: float, width: float) -> None:
    """Draw one pointed leaf from its foot (u, v) towards `turn` (radians, 0 along u); lengths as shares of the side."""
    low = ((foot - length - width) * SIZE).astype(int).clip(0, SIZE)
    high = ((foot + length + width) * SIZE).astype(int).clip(0, SIZE)
    near = (slice(low[1], high[1]), slice(low[0], high[0]))
    v, u = (np.mgrid[near] + 0.5) / SIZE
    x, y = u - foot[0], v - foot[1]
    along = (x * np.cos(turn) + y * np.sin(turn)) / length
    across = np.abs(y * np.cos(turn) - x * np.sin(turn)) / width
    inside = (along > 0) & (along < 1)
    solid[near] |= inside & (across < np.sin(np.pi * np.clip(along, 0, 1) ** 0.75) / 2)


def _twigs(sides: int) -> list[tuple[np.ndarray, float, float]]:
    """Start, direction and length of the twigs of a spray, from (0.5, 0) upwards; the first is the stem."""
    twigs = [(np.array([0.5, 0.0]), np.pi / 2, 0.72)]
    for i, height in enumerate(np.linspace(0.06, 0.64, sides)):
        lean = (0.95 - 0.35 * height) * (1 if i % 2 else -1)
        twigs.append((np.array([0.5, height]), np.pi / 2 + lean, 0.44 * (1 - 0.72 * height)))
    return twigs


def _leaves() -> np.ndarray:
    """Broad leaves on side twigs of uneven length: single leaves at the rim, gaps between the twigs."""
    rng, solid = stream(0, "cutout", "leaves"), np.zeros((SIZE, SIZE), dtype=bool)
    for foot, turn, length in _twigs(8):
        way = np.array([np.cos(turn), np.sin(turn)])
        end = length * rng.uniform(0.65, 1.12)
        _leaf(solid, foot, turn, end, 0.012)
        for i, away in enumerate(np.arange(0.05, end, 0.033)):
            side = rng.uniform(0.4, 1.3) * (1 if i % 2 else -1)
            size = rng.uniform(0.095, 0.145)
            _leaf(solid, foot + away * way, turn + side, size, 0.6 * size)
        _leaf(solid, foot + 0.95 * end * way, turn + rng.normal(0, 0.2), 0.11, 0.06)
    return solid


def _needles() -> np.ndarray:
    """A spray of a conifer: twigs set with short, stiff needles."""
    rng, solid = stream(0, "cutout", "needles"), np.zeros((SIZE, SIZE), dtype=bool)
    for foot, turn, length in _twigs(11):
        way = np.array([np.cos(turn), np.sin(turn)])
        _leaf(solid, foot, turn, length, 0.03)
        for away in np.arange(0.0, length, 0.024):
            for side in (-1, 1):
                _leaf(solid, foot + away * way, turn + side * rng.uniform(0.5, 0.9), rng.uniform(0.08, 0.12), 0.018)
    return solid


_U, _V = grid(SIZE)
CUTOUTS: dict[str, Callable[[], np.ndarray]] = {
    "leaves": _leaves,
    "needles": _needles,
    "wire": lambda: (np.abs((_U * 12) % 1 - 0.5) > 0.44) | (np.abs((_V * 5) % 1 - 0.5) > 0.47),
    "pickets": lambda: (_U * 8) % 1 < 0.66,
    "railing": lambda: ((_U * 8) % 1 < 0.16) | (_V % 1 < 0.04) | (_V % 1 > 0.96),
}


@cache
def masks() -> tuple[np.ndarray, np.ndarray]:
    """Masks (C, SIZE, SIZE) bool, True where solid, and the index of each material's mask (M,), -1 for none."""
    names = list(CUTOUTS)
    stack = np.stack([CUTOUTS[name]() for name in names])
    index = [names.index(material.cutout) if material.cutout else -1 for material in MATERIALS.values()]
    return stack, np.array(index, dtype=np.int64)


def solid_at(uv: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return (N,) bool: cut-outs `mask` (N,) are solid at uv (N, 2)."""
    cell = ((uv % 1) * SIZE).astype(np.int64).clip(0, SIZE - 1)
    return masks()[0][mask, cell[:, 1], cell[:, 0]]
