"""Frames to paint: how bright an image and its classes are beside the mean of their look."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from lidar2pano.train.painting_frames import SCORED_PIXELS, PaintingFrames

CAR, ROAD, SKY = 1, 7, 15


class MadeFrames(PaintingFrames):
    """Three frames with sums of colours only; the first two are of one look."""

    def __init__(self, folder: Path) -> None:
        self.look, self.folder, self._means = [0, 0, 1], folder, {}

    def _file(self, index: int) -> Path:
        return self.folder / f"{index}.safetensors"


def write(file: Path, **pixels: tuple[int, float]) -> None:
    """A frame of so many pixels of each class, grey of so much brightness."""
    count, total = torch.zeros(256), torch.zeros(256, 3)
    for name, (number, brightness) in pixels.items():
        count[int(name[1:])], total[int(name[1:])] = number, number * brightness
    save_file({"class_colours": total, "class_pixels": count}, file)


@pytest.fixture
def frames(tmp_path) -> MadeFrames:
    write(tmp_path / "0.safetensors", c1=(100, 0.5), c7=(300, 0.0))
    write(tmp_path / "1.safetensors", c1=(300, -0.3), c7=(100, 0.4), c15=(SCORED_PIXELS - 1, 1.0))
    write(tmp_path / "2.safetensors", c1=(100, 0.9))
    return MadeFrames(tmp_path)


def test_tones_are_what_an_image_has_beyond_the_mean_of_its_look(frames):
    """By hand: cars of the look are -0.1 on average, its road 0.1."""
    tone, class_tones = frames._tones(0)
    assert class_tones.shape == (16, 3)
    assert class_tones[CAR].tolist() == pytest.approx([0.6] * 3)
    assert class_tones[ROAD].tolist() == pytest.approx([-0.1] * 3)
    assert tone.tolist() == pytest.approx([(100 * 0.6 - 300 * 0.1) / 400] * 3)
    assert frames._tones(1)[1][CAR].tolist() == pytest.approx([-0.2] * 3)


def test_a_class_that_a_frame_hardly_shows_has_no_tone(frames):
    write(frames._file(0), c1=(100, 0.5), c7=(300, 0.0), c15=(1000, 0.5))
    assert not frames._tones(1)[1][SKY].any()
    assert frames._tones(0)[1][SKY].any()


def test_every_look_has_its_own_mean(frames):
    tone, class_tones = frames._tones(2)
    assert not tone.any() and not class_tones.any()
