"""Label sets: names and colours of ids, and tables from one set to another, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lidar2pano.errors import closest


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSet:
    """Names of the ids 0 .. K-1.

    name      of the set, as cards write it.
    classes   K names in the order of their ids.
    colours   (K, 3) uint8 values, one RGB triple a class, for palette pictures.
    raw       per class the id in files (SemanticKITTI), or empty when files hold the id itself.
    folds     further raw ids -> class name (SemanticKITTI's moving classes fold into their static ones).
    """

    name: str
    classes: tuple[str, ...]
    colours: tuple[tuple[int, int, int], ...]
    raw: tuple[int, ...] = ()
    folds: Mapping[int, str] = field(default_factory=dict[int, str])

    def __post_init__(self) -> None:
        """Refuse a set with a class twice or without its colour (ValueError)."""
        if len(set(self.classes)) != len(self.classes) or len(self.colours) != len(self.classes):
            raise ValueError(f"{self.name}: every class once, with one colour")
        if self.raw and len(self.raw) != len(self.classes):
            raise ValueError(f"{self.name}: every class needs its raw id")

    def __len__(self) -> int:
        """Return the number of classes K, the unlabeled one included."""
        return len(self.classes)

    def id_of(self, name: str) -> int:
        """Id of a class; ValueError with the nearest name when there is none."""
        if name not in self.classes:
            raise ValueError(f"{self.name} has no class {name!r}" + closest(name, self.classes))
        return self.classes.index(name)

    def table_to(self, other: LabelSet, rename: Mapping[str, str]) -> np.ndarray:
        """Return the table (K,) uint8 of `other`'s ids; a class named by neither `rename` nor `other` is an error."""
        if lost := set(self.classes) - set(rename) - set(other.classes):
            raise ValueError(f"{self.name} -> {other.name}: say where {sorted(lost)} go")
        if strange := set(rename) - set(self.classes):
            raise ValueError(f"{self.name} has no class {sorted(strange)}")
        if wrong := {rename.get(c, c) for c in self.classes} - set(other.classes):
            raise ValueError(f"{other.name} has no class {sorted(wrong)}")
        return np.array([other.classes.index(rename.get(c, c)) for c in self.classes], dtype=np.uint8)

    def from_raw(self, values: np.ndarray) -> np.ndarray:
        """Return ids (N,) int64 of a file's values; the low 16 bits are the class. Unknown values become unlabeled.

        ValueError for a set without unlabeled: there every value must be a class.
        """
        low = np.asarray(values).astype(np.int64) & 0xFFFF
        table = np.full(0x10000, self.classes.index("unlabeled") if "unlabeled" in self.classes else -1)
        for index, raw in enumerate(self.raw or range(len(self))):
            table[raw] = index
        for raw, name in self.folds.items():
            table[raw] = self.classes.index(name)
        ids = table[low]
        if (unknown := ids < 0).any():
            raise ValueError(f"{self.name} has no class for the values {np.unique(low[unknown])[:5].tolist()}")
        return ids

    def to_raw(self, ids: np.ndarray) -> np.ndarray:
        """Return the values (N,) uint32 of ids in a file; instances (the high 16 bits) are 0."""
        table = np.array(self.raw or range(len(self)), dtype=np.uint32)
        return table[ids]

    def palette(self) -> bytes:
        """768 bytes for a palette PNG: RGB per id, black if there is no class."""
        return bytes(value for colour in self.colours for value in colour).ljust(768, b"\0")

    def paint(self, ids: np.ndarray) -> np.ndarray:
        """RGB picture (..., 3) uint8 of ids (...); ids outside the set are black."""
        table = np.frombuffer(self.palette(), dtype=np.uint8).reshape(256, 3)
        return table[np.where((ids >= 0) & (ids < len(self)), ids, 255)]


def unpack_label(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split a .label file's uint32 values: (class: the low 16 bits, instance: the high 16 bits)."""
    return values & 0xFFFF, values >> 16


# SemanticKITTI's learning map, Behley et al. 2019 (semantic-kitti.yaml): order, raw ids, colours.
SEMANTIC_KITTI = LabelSet(
    name="semantic-kitti",
    classes=(
        "unlabeled", "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist",
        "road", "parking", "sidewalk", "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole",
        "traffic-sign",
    ),
    colours=(
        (0, 0, 0), (100, 150, 245), (100, 230, 245), (30, 60, 150), (80, 30, 180), (0, 0, 255), (255, 30, 30),
        (255, 40, 200), (150, 30, 90), (255, 0, 255), (255, 150, 255), (75, 0, 75), (175, 0, 75), (255, 200, 0),
        (255, 120, 50), (0, 175, 0), (135, 60, 0), (150, 240, 80), (255, 240, 150), (255, 0, 0),
    ),
    raw=(0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81),
    folds={
        1: "unlabeled", 13: "other-vehicle", 16: "other-vehicle", 52: "unlabeled", 60: "road", 99: "unlabeled",
        252: "car", 253: "bicyclist", 254: "person", 255: "motorcyclist", 256: "other-vehicle", 257: "other-vehicle",
        258: "truck", 259: "other-vehicle",
    },
)  # fmt: skip

# Cityscapes' label ids and colours, Cordts et al. 2016 (cityscapesscripts/helpers/labels.py), read by published vid2vid
# weights; the last one is -1 there.
CITYSCAPES_IDS = LabelSet(
    name="cityscapes-ids",
    classes=(
        "unlabeled", "ego vehicle", "rectification border", "out of roi", "static", "dynamic", "ground", "road",
        "sidewalk", "parking", "rail track", "building", "wall", "fence", "guard rail", "bridge", "tunnel", "pole",
        "polegroup", "traffic light", "traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car", "truck",
        "bus", "caravan", "trailer", "train", "motorcycle", "bicycle", "license plate",
    ),
    colours=(
        (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0), (111, 74, 0), (81, 0, 81), (128, 64, 128),
        (244, 35, 232), (250, 170, 160), (230, 150, 140), (70, 70, 70), (102, 102, 156), (190, 153, 153),
        (180, 165, 180), (150, 100, 100), (150, 120, 90), (153, 153, 153), (153, 153, 153), (250, 170, 30),
        (220, 220, 0), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60), (255, 0, 0), (0, 0, 142),
        (0, 0, 70), (0, 60, 100), (0, 0, 90), (0, 0, 110), (0, 80, 100), (0, 0, 230), (119, 11, 32), (0, 0, 142),
    ),
)  # fmt: skip

# Cityscapes' 19 trainIds, same file.
_TRAIN = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
CITYSCAPES = LabelSet(
    name="cityscapes",
    classes=_TRAIN,
    colours=tuple(CITYSCAPES_IDS.colours[CITYSCAPES_IDS.id_of(name)] for name in _TRAIN),
)

# The 14 classes of both data sets, in the order of TITAN-Net's published weights (its palette).
COMMON14 = LabelSet(
    name="common-14",
    classes=(
        "unlabeled", "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "road", "sidewalk",
        "building", "fence", "vegetation", "terrain", "pole", "traffic-sign",
    ),
    colours=(
        (0, 0, 0), (100, 150, 245), (100, 230, 245), (30, 60, 150), (80, 30, 180), (0, 0, 250), (255, 30, 30),
        (255, 0, 255), (75, 0, 75), (255, 200, 0), (255, 120, 50), (0, 175, 0), (150, 240, 80), (255, 240, 150),
        (255, 0, 0),
    ),
)  # fmt: skip

COMMON15 = LabelSet(name="common-15", classes=(*COMMON14.classes, "sky"), colours=(*COMMON14.colours, (70, 130, 180)))
THINGS = tuple(COMMON15.id_of(name) for name in ("car", "bicycle", "motorcycle", "truck", "other-vehicle", "person"))
"""Ids of COMMON15 of what can be counted, and may move."""

LABEL_SETS: dict[str, LabelSet] = {s.name: s for s in (SEMANTIC_KITTI, CITYSCAPES, CITYSCAPES_IDS, COMMON14, COMMON15)}

# TITAN-Net's supplement, table 4 (parking stands in its sidewalk column).
_FROM_KITTI = {
    "bicyclist": "person", "motorcyclist": "person", "parking": "sidewalk", "other-ground": "unlabeled",
    "trunk": "vegetation",
}  # fmt: skip
# Table 4 is silent about Cityscapes (rider .. traffic light): there the choice is ours.
_FROM_CITYSCAPES = {
    "traffic sign": "traffic-sign", "rider": "person", "bus": "other-vehicle", "train": "other-vehicle",
    "wall": "fence", "traffic light": "traffic-sign",
}  # fmt: skip
# SemanticKITTI's fences hold small walls (Behley et al. 2019, appendix); what a camera calls sky is no point's class.
_KITTI_FROM_CITYSCAPES = {
    "sky": "unlabeled", "wall": "fence", "rider": "bicyclist", "bus": "other-vehicle", "train": "other-vehicle",
    "traffic light": "traffic-sign", "traffic sign": "traffic-sign",
}  # fmt: skip
# And back, for classes of ours with several of theirs.
_TO_CITYSCAPES = {"other-vehicle": "bus", "traffic-sign": "traffic sign"}

TABLES: dict[tuple[str, str], np.ndarray] = {
    ("semantic-kitti", "common-14"): SEMANTIC_KITTI.table_to(COMMON14, _FROM_KITTI),
    ("semantic-kitti", "common-15"): SEMANTIC_KITTI.table_to(COMMON15, _FROM_KITTI),
    ("cityscapes", "common-14"): CITYSCAPES.table_to(COMMON14, _FROM_CITYSCAPES | {"sky": "unlabeled"}),
    ("cityscapes", "common-15"): CITYSCAPES.table_to(COMMON15, _FROM_CITYSCAPES),
    ("cityscapes", "semantic-kitti"): CITYSCAPES.table_to(SEMANTIC_KITTI, _KITTI_FROM_CITYSCAPES),
    ("common-15", "common-14"): COMMON15.table_to(COMMON14, {"sky": "unlabeled"}),
    ("common-14", "common-15"): COMMON14.table_to(COMMON15, {}),
    ("common-15", "cityscapes-ids"): COMMON15.table_to(CITYSCAPES_IDS, _TO_CITYSCAPES),
}
"""Look-up tables (K,) uint8 by (from, to)."""
