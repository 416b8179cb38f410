"""Random streams, and the classes of the street world in every label set."""

from lidar2pano.labels import CITYSCAPES, COMMON15, SEMANTIC_KITTI
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import (
    CITYSCAPES_IDS,
    COMMON15_IDS,
    OBJECT_TYPE_IDS,
    OBJECT_TYPES,
    RAW_IDS,
    RAW_MOVING_IDS,
    SKY,
)


def test_streams_depend_on_every_name():
    draws = {stream(*names).integers(2**62) for names in [(1, "a"), (2, "a"), (1, "b"), (1, "a", 0), (1, "a", 1)]}
    assert len(draws) == 5
    assert stream(1, "a").integers(2**62) == stream(1, "a").integers(2**62)


def test_object_types_name_the_class_of_every_label_set():
    raw = {
        name: SEMANTIC_KITTI.classes[int(SEMANTIC_KITTI.from_raw(RAW_IDS[[OBJECT_TYPE_IDS[name]]])[0])]
        for name in OBJECT_TYPES
    }
    assert raw["lane-marking"] == "road"
    assert raw["tram"] == raw["bus"] == raw["trailer"] == "other-vehicle"
    assert set(raw.values()) == set(SEMANTIC_KITTI.classes), "all nineteen classes, and unlabeled for clutter"
    folded = SEMANTIC_KITTI.from_raw(RAW_MOVING_IDS)
    assert (folded == SEMANTIC_KITTI.from_raw(RAW_IDS)).all(), "moving classes fold into their standing ones"
    assert CITYSCAPES.classes[CITYSCAPES_IDS[SKY]] == COMMON15.classes[COMMON15_IDS[SKY]] == "sky"
    assert set(COMMON15_IDS[: len(OBJECT_TYPES)]) == set(range(15))
