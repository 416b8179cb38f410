"""What a prompt, a notebook and other programs show of panoramas and pipelines."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.errors import InputError
from lidar2pano.pipeline import load
from random_weights import street
from small_panoramas import small_panorama

SCAN = street()


def test_a_panorama_is_one_short_line():
    panorama = replace(small_panorama(scan=SCAN, name="street"), milliseconds={"paint": 400.0, "project": 180.0})
    classes = len(set(panorama.segments.ravel().tolist()) - {0})
    assert repr(panorama) == f"Panorama('street', 96 x 1152, {classes} classes, {len(SCAN)} points, 0.6 s)"
    assert " s)" not in repr(small_panorama(scan=SCAN))


def test_a_pipeline_is_one_short_line(random_weights):
    text = repr(load(random_weights, torch.device("cpu")))
    assert text.startswith("Pipeline(") and "\n" not in text and len(text) < 100
    assert "salsanext" in text and "latent-painter" in text and text.endswith("cpu, torch)")


def test_a_notebook_shows_the_colours():
    panorama = small_panorama()
    with Image.open(io.BytesIO(panorama._repr_png_())) as image:
        assert np.array_equal(np.asarray(image), panorama.colour)
    assert np.array_equal(np.asarray(panorama.to_pil()), panorama.colour)


def test_show_opens_the_colours(monkeypatch):
    shown = []
    monkeypatch.setattr(Image.Image, "show", lambda image, title=None: shown.append((title, image.size)))
    small_panorama(name="street").show()
    assert shown == [("street", (1152, 96))]


def test_open3d_gets_the_points_that_save_points_writes(monkeypatch):
    open3d = SimpleNamespace(
        geometry=SimpleNamespace(PointCloud=SimpleNamespace), utility=SimpleNamespace(Vector3dVector=np.array)
    )
    monkeypatch.setitem(sys.modules, "open3d", open3d)
    panorama = small_panorama(scan=SCAN)
    cloud = panorama.to_open3d(SCAN)
    assert np.allclose(cloud.points, SCAN.xyz) and cloud.points.dtype == np.float64
    assert np.array_equal(np.round(cloud.colors * 255), panorama.colour_points(SCAN).colour)
    with pytest.raises(ValueError, match="this panorama is of a scan with"):
        panorama.to_open3d(street(50))
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match="pip install open3d"):
        panorama.to_open3d(SCAN)


def test_open3d_itself_takes_them():
    pytest.importorskip("open3d", reason="Open3D is no dependency: pip install open3d")
    panorama = small_panorama(scan=SCAN)
    cloud = panorama.to_open3d(SCAN)
    np.testing.assert_allclose(np.asarray(cloud.points), SCAN.xyz, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, panorama.colour_points(SCAN).colour, atol=0.01)
