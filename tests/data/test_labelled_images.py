"""Images and labels without scans: Cityscapes' layout, and any folder of them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from lidar2pano.data.camera_pairs import FrontViewDataset
from lidar2pano.data.clips import ClipDataset, Framing
from lidar2pano.data.frames import IGNORE, SampleIndex
from lidar2pano.data.labelled_images import TRAIN_IDS
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS
from lidar2pano.train.camera_segmentation import CameraImageDataset, CameraSegmentationOptions
from lidar2pano.views import VIEWS
from miniature import SIZE, camera_view
from miniature_images import write_cityscapes, write_folders


@pytest.fixture(scope="module")
def cityscapes(tmp_path_factory):
    return write_cityscapes(tmp_path_factory.mktemp("cityscapes"))


def test_label_ids_become_train_ids_by_name():
    known = {name: int(TRAIN_IDS[number]) for number, name in enumerate(CITYSCAPES_IDS.classes)}
    assert {name for name, number in known.items() if number != IGNORE} == set(CITYSCAPES.classes)
    assert (known["road"], known["bicycle"], known["caravan"], known["license plate"]) == (0, 18, IGNORE, IGNORE)


def test_cityscapes_is_read_by_split(cityscapes):
    train = frames(cityscapes, "train")
    names = [f"aachen/aachen_{number:06d}_000019" for number in range(3)] + ["ulm/ulm_000000_000019"]
    assert list(train.names) == names
    assert len(frames(cityscapes, "val")) == 2
    ids, colours = camera_view()
    for frame in train:  # by train ids and by label ids
        image, labels = frame.require("image", "camera_labels")
        assert np.array_equal(image, colours) and np.array_equal(labels, ids)
        assert frame.calibration is None and frame.point_labels is None
    with pytest.raises(InputError, match="no split 'tran'; did you mean 'train'"):
        frames(cityscapes, "tran")


@pytest.mark.parametrize("splits", [(), ("train", "val")])
def test_any_images_beside_labels_are_a_data_set(tmp_path, splits):
    found = frames(write_folders(tmp_path, *splits), "train")
    assert list(found.names) == ["deep.er/b", "train/a"]
    ids, _ = camera_view()
    assert all(np.array_equal(*frame.require("camera_labels"), ids) for frame in found)
    if not splits:
        with pytest.raises(InputError, match="no split 'val'"):
            frames(tmp_path, "val")


def test_camera_segmenters_and_vid2vid_train_on_them(cityscapes):
    images = CameraImageDataset(cityscapes, ("train",), CameraSegmentationOptions(rows=32, columns=64))
    sample = images[SampleIndex(3, 1)]
    assert len(images) == 4 and sample.image.shape == (3, 32, 64) and sample.labels.shape == (32, 64)
    clips = ClipDataset(cityscapes, (), Framing(rows=24, columns=64, scale=0.5), 3, ("train",))
    clip = clips[SampleIndex(0, 5)]
    assert len(clips) == 4 and clip.image.shape == (3, 3, 24, 64) and clip.known[1:].any()


def test_what_needs_a_scan_says_so(cityscapes):
    samples = FrontViewDataset(cityscapes, ("train",), VIEWS["titan-front"], (24, 80))
    with pytest.raises(InputError, match="has images and labels only, no scan; sdnet, vid2vid and latent-painter"):
        samples[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "b.png: is missing; complete the labels, or leave b.png out"),
        (lambda path: Image.new("L", (4, 4)).save(path), "b.png: is 4x4 and its image 240x72; label it again"),
        (lambda path: Image.new("L", SIZE, 33).save(path), "b.png: holds class 33; write Cityscapes train ids"),
        (lambda path: Image.new("RGB", SIZE).save(path), "b.png: is no image of class ids"),
    ],
)
def test_labels_that_do_not_fit_are_named(tmp_path, change, message):
    root = write_folders(tmp_path)
    change(root / "labels/deep/er/b.png")
    with pytest.raises(InputError, match=message):
        frames(root, "train")[0].require("camera_labels")
