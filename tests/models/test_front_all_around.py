"""Front-view translators over the whole turn: directions stay where they are, and nothing ends at the seam."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn
from torch.nn.functional import interpolate

from lidar2pano.cli import main
from lidar2pano.geometry.projection import Normalisation, one_hot_layers, project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.models.titan_pano import PANORAMA, FrontAllAround
from lidar2pano.pipeline import PaperPipeline, load
from random_weights import FRONT_VIEW, street, write_front, write_scan, write_weights

VIDEO = {"channels": 16, "widths": (4,), "downsamplings": 1, "blocks": (1, 1), "foreground": ()}


class FirstClasses(nn.Module):
    """A translator whose scores are the first 15 classes of its condition, stretched to its image."""

    size = (48, 160)

    def forward(self, z: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        assert z.shape[2:] == condition.shape[2:]
        self.lidar = z
        return interpolate(condition[:, :15], self.size, mode="bilinear", align_corners=False)


def translated(azimuth_deg: float) -> tuple[FrontAllAround, torch.Tensor, torch.Tensor]:
    """Class 7 in one direction, class 9 elsewhere: the network, its logits and depth."""
    around = FrontAllAround(FirstClasses(), FRONT_VIEW, Normalisation())
    view = around.input_view
    ids = torch.full((view.rows, view.columns), 9)
    ids[:, round((180 - azimuth_deg) / 360 * view.columns) % view.columns] = 7
    channels = project(street(), view).channels[None]
    return (around, *around(channels, one_hot_layers(ids[None], len(SEMANTIC_KITTI))))


def test_the_view_goes_on_around_the_sensor_as_fine_as_in_training():
    around = FrontAllAround(FirstClasses(), FRONT_VIEW, Normalisation())
    view = around.input_view
    assert view.circular and view.columns / 360 == FRONT_VIEW.columns / 90
    assert (view.rows, view.up, view.down) == (FRONT_VIEW.rows, FRONT_VIEW.up, FRONT_VIEW.down)


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, -135.0, 180.0])
def test_what_lies_in_a_direction_is_painted_there(azimuth_deg):
    _, logits, depth_m = translated(azimuth_deg)
    assert logits.shape == (1, len(COMMON15), PANORAMA.rows, PANORAMA.columns)
    column = int(logits[0, 7].mean(0).argmax())
    found = 180 - (column + 0.5) / PANORAMA.columns * 360
    pixel = 360 / (4 * FRONT_VIEW.columns)
    assert abs((found - azimuth_deg + 180) % 360 - 180) < 1.5 * pixel
    ids = logits[0].argmax(0)
    assert COMMON15.id_of("sky") not in ids, "the paper's classes have no sky"
    assert depth_m.shape == (1, PANORAMA.rows, PANORAMA.columns) and (depth_m > 0).all() and depth_m.isfinite().all()


def test_empty_pixels_are_zero_for_the_network_and_the_seam_is_no_border():
    around, logits, _ = translated(180.0)
    network = around.network
    assert isinstance(network, FirstClasses)
    lidar, overlap = network.lidar, around.overlap
    assert lidar.shape[3] == around.input_view.columns + 2 * overlap
    assert torch.equal(lidar[..., : 2 * overlap], lidar[..., -2 * overlap :])
    empty = project(street(), around.input_view).channels[0] == 0
    assert (lidar[0, :, :, overlap:-overlap][:, empty] == 0).all() and empty.any()
    assert logits[0, 7, :, 0].mean() == pytest.approx(float(logits[0, 7, :, -1].mean()), abs=0.5)


def test_translate_takes_titan_net_and_vid2vid_together(tmp_path, capsys):
    weights = write_front(tmp_path / "titan")
    views = {"panorama": PANORAMA.scaled(0.5).as_dict()}
    video = write_weights(tmp_path, "video", "vid2vid", VIDEO, labels="common-15", views=views)
    scan = write_scan(tmp_path / "a.bin")
    words = ["translate", str(scan), "--weights", f"{weights}+{video}", "--out", str(tmp_path / "out")]
    assert main([*words, "--save", "rgb,segments", "--device", "cpu"]) == 0
    capsys.readouterr()
    for name in ("a.png", "a.segments.png"):
        image = np.asarray(Image.open(tmp_path / "out" / name))
        assert image.shape[:2] == (2 * PANORAMA.rows, 2 * PANORAMA.columns)
    pipeline = load(f"{weights}+{video}", "cpu")
    assert isinstance(pipeline, PaperPipeline) and pipeline.view == PANORAMA
