from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.labels import (
    CITYSCAPES,
    CITYSCAPES_IDS,
    COMMON14,
    COMMON15,
    LABEL_SETS,
    SEMANTIC_KITTI,
    TABLES,
    LabelSet,
    unpack_label,
)

# The paper's supplement, table 4, row by row.
KITTI_TO_COMMON = {
    "unlabeled": "unlabeled",
    "car": "car",
    "bicycle": "bicycle",
    "motorcycle": "motorcycle",
    "truck": "truck",
    "other-vehicle": "other-vehicle",
    "person": "person",
    "bicyclist": "person",
    "motorcyclist": "person",
    "road": "road",
    "parking": "sidewalk",
    "sidewalk": "sidewalk",
    "other-ground": "unlabeled",
    "building": "building",
    "fence": "fence",
    "vegetation": "vegetation",
    "trunk": "vegetation",
    "terrain": "terrain",
    "pole": "pole",
    "traffic-sign": "traffic-sign",
}
CITYSCAPES_TO_COMMON15 = {
    "road": "road",
    "sidewalk": "sidewalk",
    "building": "building",
    "wall": "fence",
    "fence": "fence",
    "pole": "pole",
    "traffic light": "traffic-sign",
    "traffic sign": "traffic-sign",
    "vegetation": "vegetation",
    "terrain": "terrain",
    "sky": "sky",
    "person": "person",
    "rider": "person",
    "car": "car",
    "truck": "truck",
    "bus": "other-vehicle",
    "train": "other-vehicle",
    "motorcycle": "motorcycle",
    "bicycle": "bicycle",
}
CITYSCAPES_TO_KITTI = CITYSCAPES_TO_COMMON15 | {"sky": "unlabeled", "rider": "bicyclist"}
ITSELF = {name: name for name in COMMON14.classes}
BY_HAND = {
    ("semantic-kitti", "common-14"): KITTI_TO_COMMON,
    ("semantic-kitti", "common-15"): KITTI_TO_COMMON,
    ("cityscapes", "common-14"): CITYSCAPES_TO_COMMON15 | {"sky": "unlabeled"},
    ("cityscapes", "common-15"): CITYSCAPES_TO_COMMON15,
    ("cityscapes", "semantic-kitti"): CITYSCAPES_TO_KITTI,
    ("common-15", "common-14"): ITSELF | {"sky": "unlabeled"},
    ("common-14", "common-15"): ITSELF,
    ("common-15", "cityscapes-ids"): ITSELF | {"sky": "sky", "other-vehicle": "bus", "traffic-sign": "traffic sign"},
}
MOVING = {
    252: "car",
    253: "bicyclist",
    254: "person",
    255: "motorcyclist",
    256: "other-vehicle",  # on rails
    257: "other-vehicle",  # bus
    258: "truck",
    259: "other-vehicle",
}


@pytest.mark.parametrize("pair", BY_HAND)
def test_tables_by_hand(pair):
    source, target = (LABEL_SETS[name] for name in pair)
    named = {name: target.classes[index] for name, index in zip(source.classes, TABLES[pair], strict=True)}
    assert named == BY_HAND[pair]


def test_every_table_is_worked_by_hand():
    assert set(TABLES) == set(BY_HAND) and all(table.dtype == np.uint8 for table in TABLES.values())


def test_sets_have_the_ids_that_the_data_sets_and_weights_use():
    assert {name: len(labels) for name, labels in LABEL_SETS.items()} == {
        "semantic-kitti": 20,
        "cityscapes": 19,
        "cityscapes-ids": 35,
        "common-14": 15,
        "common-15": 16,
    }
    assert SEMANTIC_KITTI.classes[0] == COMMON14.classes[0] == "unlabeled"
    assert [CITYSCAPES_IDS.id_of(name) for name in ("road", "building", "sky", "car", "bicycle")] == [7, 11, 23, 26, 33]
    assert (SEMANTIC_KITTI.id_of("traffic-sign"), CITYSCAPES.id_of("bicycle"), COMMON15.id_of("sky")) == (19, 18, 15)


@pytest.mark.parity
def test_labels_are_the_published_ones(golden: Path):
    recorded = json.loads((golden / "labels.json").read_text())
    titan, kitti, city = recorded["titan15"], recorded["semantickitti20"], recorded["cityscapes19"]
    assert list(COMMON14.classes) == titan["order"] and [list(c) for c in COMMON14.colours] == titan["palette_rgb"]
    assert list(SEMANTIC_KITTI.classes) == kitti["order"] and list(SEMANTIC_KITTI.raw) == kitti["20_to_raw"]
    assert TABLES["semantic-kitti", "common-14"].tolist() == kitti["20_to_titan15_paper_table"]
    raw = np.array([int(value) for value in kitti["raw_to_20"]])
    assert SEMANTIC_KITTI.from_raw(raw).tolist() == list(kitti["raw_to_20"].values())
    assert set(SEMANTIC_KITTI.raw) | set(SEMANTIC_KITTI.folds) == set(raw.tolist())
    assert list(CITYSCAPES.classes) == city["order"]
    ours = TABLES["cityscapes", "common-14"]
    assert {name: ours[CITYSCAPES.id_of(name)] for name in city["to_titan15_certain"]} == city["to_titan15_certain"]


def set_of(*classes: str, name: str = "ours") -> LabelSet:
    return LabelSet(name=name, classes=classes, colours=((0, 0, 0),) * len(classes))


def test_a_lost_class_is_an_error():
    with pytest.raises(ValueError, match=r"semantic-kitti -> common-14: say where \['bicyclist', .*'trunk'\] go"):
        SEMANTIC_KITTI.table_to(COMMON14, {})


def test_a_class_that_does_not_exist_is_an_error():
    with pytest.raises(ValueError, match=r"common-14 has no class \['raod'\]"):
        set_of("a").table_to(COMMON14, {"a": "raod"})
    with pytest.raises(ValueError, match=r"ours has no class \['rode'\]"):
        set_of("road").table_to(COMMON14, {"rode": "sidewalk"})
    with pytest.raises(ValueError, match="common-15 has no class 'skye'; did you mean 'sky'"):
        COMMON15.id_of("skye")


def test_tables_map_by_name():
    assert set_of("x", "b", "a").table_to(set_of("a", "b"), {"x": "a"}).tolist() == [0, 1, 0]
    assert set_of("a", "b").table_to(set_of("a", "b"), {"a": "b"}).tolist() == [1, 1], "a new name wins over the same"


@pytest.mark.parametrize(
    "wrong",
    [
        {"classes": ("a", "a"), "colours": ((0, 0, 0),) * 2},
        {"classes": ("a", "b"), "colours": ((0, 0, 0),)},
        {"classes": ("a", "b"), "colours": ((0, 0, 0),) * 2, "raw": (4,)},
    ],
)
def test_a_set_with_holes_is_refused(wrong):
    with pytest.raises(ValueError, match="bad: every class"):
        LabelSet(name="bad", **wrong)


def test_moving_classes_fold_into_their_static_ones():
    ids = SEMANTIC_KITTI.from_raw(np.array(list(MOVING)))
    assert [SEMANTIC_KITTI.classes[index] for index in ids] == list(MOVING.values())


def test_instances_are_the_high_bits():
    values = np.array([(7 << 16) | 10, (0xFFFF << 16) | 252, 40], dtype=np.uint32)
    assert SEMANTIC_KITTI.from_raw(values).tolist() == [1, 1, 9]
    class_id, instance = unpack_label(values)
    assert class_id.tolist() == [10, 252, 40] and instance.tolist() == [7, 0xFFFF, 0]


def test_raw_values_there_and_back():
    ids = np.arange(20)
    raw = SEMANTIC_KITTI.to_raw(ids)
    assert raw.dtype == np.uint32 and (raw[1], raw[19]) == (10, 81)
    assert SEMANTIC_KITTI.from_raw(raw).tolist() == ids.tolist() and SEMANTIC_KITTI.from_raw(raw).dtype == np.int64
    assert COMMON15.from_raw(COMMON15.to_raw(np.arange(16))).tolist() == list(range(16))
    with pytest.raises(IndexError):
        SEMANTIC_KITTI.to_raw(np.array([20]))


def test_unknown_raw_values_are_unlabeled_where_there_is_such_a_class():
    assert SEMANTIC_KITTI.from_raw(np.array([2, 65535, 10])).tolist() == [0, 0, 1]
    with pytest.raises(ValueError, match=r"cityscapes has no class for the values \[255\]"):
        CITYSCAPES.from_raw(np.array([3, 255]))


@pytest.mark.parametrize("name", LABEL_SETS)
def test_palette_and_paint(name):
    labels = LABEL_SETS[name]
    palette = labels.palette()
    assert len(palette) == 768 and not any(palette[3 * len(labels) :])
    assert list(palette[3:6]) == list(labels.colours[1])
    painted = labels.paint(np.array([[1, 2], [len(labels), 255]]))
    assert painted.dtype == np.uint8 and painted.shape == (2, 2, 3)
    assert painted[0].tolist() == [list(labels.colours[1]), list(labels.colours[2])] and not painted[1].any()
    assert not labels.paint(np.array([-255, -1, 256, 257])).any(), "no id wraps around"
    repeated = 6 if labels is CITYSCAPES_IDS else 0  # published so: what is unlabelled, and two kinds of poles and cars
    assert len(set(labels.colours)) == len(labels) - repeated, "colours tell the classes apart"
