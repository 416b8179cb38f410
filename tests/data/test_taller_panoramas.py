"""Ground truth of a panorama on rasters with other rows than its own."""

from __future__ import annotations

import json

import numpy as np
import torch
from PIL import Image

from lidar2pano.data.frames import IGNORE
from lidar2pano.data.panorama_crops import PanoramaDataset
from lidar2pano.views import VIEWS
from miniature_video import write_video


def test_a_panorama_is_learned_on_a_taller_raster_and_a_tall_one_on_the_default(tmp_path):
    root = write_video(tmp_path / "default", panorama=True)
    rows, tall = VIEWS["panorama"].scaled(1 / 4).rows, VIEWS["panorama-tall"].scaled(1 / 4)
    plain = PanoramaDataset(root, ("train",), VIEWS["panorama"].scaled(1 / 4), columns=192)
    taller = PanoramaDataset(root, ("train",), tall, columns=192)
    middle = slice(40, 40 + rows)  # 0.2182 of 0.005454 a row are above
    for name in ("camera_labels", "depth_m"):
        there, empty = (getattr(taller[1], name) for _ in range(2))
        assert torch.equal(there[middle], getattr(plain[1], name))
        assert len(empty) == 200 and (torch.cat([empty[:40], empty[40 + rows :]]) == (IGNORE, 0)[name[0] == "d"]).all()
    assert np.array_equal(plain.class_counts()[:16], taller.class_counts()[:16])
    world = write_video(tmp_path / "tall", panorama=True)
    (world / "world.json").write_text(json.dumps({"views": ["panorama-tall/4"]}))
    for path in (*world.glob("sequences/*/pano*/*.png"),):
        pixels = np.array(Image.open(path))
        added = [(40, 200 - 40 - rows), *[(0, 0)] * (pixels.ndim - 1)]
        Image.fromarray(np.pad(pixels, added, constant_values=6)).save(path)
    cut = PanoramaDataset(world, ("train",), VIEWS["panorama"].scaled(1 / 4), columns=192)
    for name in ("camera_labels", "depth_m", "range_image"):
        assert torch.equal(getattr(cut[1], name), getattr(plain[1], name))
    assert np.array_equal(plain.class_counts(), cut.class_counts())
    whole = PanoramaDataset(world, ("train",), tall, columns=192)[1]
    assert (whole.camera_labels[:40] == 6).all() and (whole.camera_labels[middle] == cut[1].camera_labels).all()
