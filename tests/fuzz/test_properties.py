"""Properties: what is written is read again, what is projected is projected back, labels keep their names."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lidar2pano import labels
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import (
    DEPTH_STEPS,
    image_text,
    read_image,
    write_depth,
    write_ids,
    write_palette,
    write_png,
)
from lidar2pano.formats.json_files import parse_json, validated
from lidar2pano.formats.ply import write_ply
from lidar2pano.formats.readers import open_path
from lidar2pano.formats.scan_files import read_bin, read_label, write_bin, write_label
from lidar2pano.geometry.projection import project_points
from lidar2pano.labels import CITYSCAPES, COMMON14, COMMON15, LABEL_SETS, SEMANTIC_KITTI, TABLES, LabelSet
from lidar2pano.models.card import Card
from lidar2pano.scan import Scan
from lidar2pano.train.checkpoint import Progress, load_checkpoint, save_checkpoint
from lidar2pano.train.recipe import Optimizer
from lidar2pano.views import View
from slow_definitions import points_on_rays

FLOATS = st.floats(-1e6, 1e6, width=32)
NUMBERS = st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
PLAIN = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
VIEWS = st.builds(
    View,
    rows=st.integers(1, 8),
    columns=st.integers(1, 16),
    up=st.floats(0.05, 1.0),
    down=st.floats(-1.0, 0.0),
    kind=st.sampled_from(["sphere", "cylinder"]),
    origin=st.tuples(*[st.floats(-2, 2)] * 3),
)
quickly = settings(max_examples=40, deadline=None, database=None, derandomize=True)


def written(name: str) -> Path:
    return Path(tempfile.mkdtemp()) / name


@quickly
@given(arrays.arrays(np.float32, st.tuples(st.integers(1, 50), st.just(4)), elements=FLOATS))
def test_a_scan_is_read_as_it_was_written(rows):
    path = written("a.bin")
    write_bin(path, Scan(xyz=rows[:, :3], remission=rows[:, 3]))
    scan = read_bin(path)
    assert (scan.xyz == rows[:, :3]).all() and (scan.remission == rows[:, 3]).all()


@quickly
@given(arrays.arrays(np.int64, st.integers(1, 50), elements=st.integers(0, len(SEMANTIC_KITTI) - 1)))
def test_labels_are_read_as_they_were_written(ids):
    path = written("a.label")
    write_label(path, ids)
    assert (read_label(path, len(ids)) == ids).all()
    with pytest.raises(InputError):
        read_label(path, len(ids) + 1)


@quickly
@given(
    arrays.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(2, 9), st.just(3))),
    st.dictionaries(st.text("abcdefghij", min_size=1, max_size=20), st.text("xyz {}:0123", max_size=40), max_size=3),
)
def test_an_image_is_read_as_it_was_written(colour, text):
    path = written("a.png")
    write_png(path, colour, text)
    assert (read_image(path, "RGB") == colour).all() and image_text(path) == text


@quickly
@given(arrays.arrays(np.uint8, (5, 7), elements=st.integers(0, len(COMMON15) - 1)))
def test_segments_are_read_as_they_were_written(ids):
    path = written("a.png")
    write_palette(path, ids)
    assert (read_image(path) == ids).all()


@quickly
@given(arrays.arrays(st.sampled_from([np.uint8, np.uint16]), (5, 7)))
def test_ids_are_read_as_they_were_written(ids):
    path = written("a.png")
    write_ids(path, ids)
    assert (read_image(path) == ids).all()


@quickly
@given(arrays.arrays(np.float32, (4, 6), elements=st.floats(0, 255, width=32)))
def test_depths_are_read_to_half_a_step(depth_m):
    path = written("a.png")
    write_depth(path, depth_m)
    assert np.abs(read_image(path) / DEPTH_STEPS - depth_m).max() <= 0.5 / DEPTH_STEPS + 1e-6


@quickly
@given(arrays.arrays(np.float32, st.tuples(st.integers(1, 50), st.just(3)), elements=FLOATS))
def test_a_ply_is_read_as_it_was_written(xyz):
    path = written("a.ply")
    write_ply(path, dict(zip("xyz", xyz.T, strict=True)))
    cloud = open_path(path).cloud(path)
    assert (cloud.xyz == xyz).all()


@quickly
@given(PLAIN)
def test_the_gate_gives_what_json_says(value):
    assert parse_json(json.dumps(value), "here") == value
    assert parse_json(json.dumps(value).encode(), "here") == value


@quickly
@given(PLAIN)
def test_a_typed_value_is_of_its_type_or_refused(value):
    for cls in (Progress, Optimizer, View):
        try:
            made = validated(cls, value, "here")
        except InputError as error:
            assert str(error).startswith("here: ")
        else:
            assert isinstance(made, cls)


FINITE = st.floats(allow_nan=False, allow_infinity=False)
OBJECTS = st.dictionaries(st.text(), FINITE | st.text() | st.booleans(), max_size=3)


@quickly
@given(
    st.builds(
        Card, network=st.text(), settings=OBJECTS, labels=st.sampled_from([None, *LABEL_SETS]), score=OBJECTS,
        steps=st.integers(0, 2**62), hours=FINITE, licence=st.text(),
    )
)  # fmt: skip
def test_a_card_is_read_as_it_was_written(card):
    assert Card.from_json(card.to_json()) == card


@settings(max_examples=8, deadline=None, database=None, derandomize=True)  # each is flushed to the disk
@given(
    st.builds(Progress, step=st.integers(0, 10**9), seconds=st.floats(0, 1e12), best=st.none() | FINITE),
    st.dictionaries(st.text("ab./", min_size=1, max_size=5), arrays.arrays(np.float32, (2, 3), elements=FLOATS)),
)
def test_a_checkpoint_is_read_as_it_was_written(progress, weights):
    run = written("run")
    tensors = {name: torch.from_numpy(value) for name, value in weights.items()}
    save_checkpoint(run, progress, tensors, {"a": {"state": {}, "param_groups": [{"lr": 0.1}]}})
    found = load_checkpoint(run)
    assert found is not None and found[0] == progress and found[1].keys() == tensors.keys()
    assert all(torch.equal(found[1][name], value) for name, value in tensors.items())
    assert found[2] == {"a": {"state": {}, "param_groups": [{"lr": 0.1}]}}


@quickly
@given(VIEWS)
def test_a_view_is_read_as_it_was_written(view):
    assert validated(View, parse_json(json.dumps(view.as_dict()), "here"), "here") == view


@quickly
@given(VIEWS, st.integers(0, 2**32 - 1))
def test_what_is_projected_back_falls_into_its_pixel(view, seed):
    generator = torch.Generator().manual_seed(seed)
    range_m = torch.rand((view.rows, view.columns), generator=generator) * 50 + 1
    points = points_on_rays(range_m, view).reshape(-1, 3)
    image = project_points(points, torch.zeros(len(points)), view)
    assert bool(image.valid.all())
    assert torch.allclose(image.channels[0], range_m, atol=1e-3)
    assert (image.index.reshape(-1) == torch.arange(len(points))).all()


@given(st.sampled_from([SEMANTIC_KITTI, CITYSCAPES, COMMON14, COMMON15]), st.data())
@quickly
def test_label_sets_keep_every_id(known: LabelSet, data):
    ids = data.draw(arrays.arrays(np.int64, 20, elements=st.integers(0, len(known) - 1)))
    assert (known.from_raw(known.to_raw(ids)) == ids).all()
    high = known.to_raw(ids).astype(np.uint32) | np.uint32(7 << 16)  # instances do not matter
    assert (known.from_raw(high) == ids).all()


def test_tables_lead_to_the_class_of_the_same_name():
    sets = {value.name: value for value in vars(labels).values() if isinstance(value, LabelSet)}
    for (ours, theirs), table in TABLES.items():
        assert len(table) == len(sets[ours]) and table.max() < len(sets[theirs])
        shared = set(sets[ours].classes) & set(sets[theirs].classes)
        assert all(sets[theirs].classes[table[sets[ours].id_of(name)]] == name for name in shared)
