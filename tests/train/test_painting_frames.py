"""Frames to paint: how bright an image and its classes are beside the mean of their look."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from lidar2pano.train.painter_recipes import ScenePaintingOptions
from lidar2pano.train.painting_frames import MARGIN, SCORED_PIXELS, PaintingFrames, made_by
from lidar2pano.views import VIEWS

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


def test_files_depend_on_networks_raster_and_data_set(tmp_path):
    """What other weights made of a frame, or the same of another data set's frame, is never taken for it."""
    one, other = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    one.write_bytes(b"1")
    other.write_bytes(b"2")
    view = VIEWS["panorama"]
    keys = [made_by(view, str(a), str(b)) for a in (one, other) for b in (one, other)]
    keys.append(made_by(replace(view, rows=8), str(one), str(one)))
    assert len(set(keys)) == 5 and made_by(view, str(one), str(one)) == keys[0]

    def file(root: Path, cache: str = "", key: str = keys[0], shift_px: int = 48) -> Path:
        frames = object.__new__(PaintingFrames)
        frames.options, frames._made_by = ScenePaintingOptions(cache=cache), key
        frames.crops = SimpleNamespace(frames=[SimpleNamespace(root=root, name="00/000007")], shift_px=shift_px)
        return frames._file(0)

    assert file(tmp_path / "x" / "day").is_relative_to(tmp_path / "x" / "day" / ".lidar2pano" / "painting")
    assert file(tmp_path / "x") != file(tmp_path / "x", shift_px=100), "files of a camera's sector hold no more than it"
    kept = tmp_path / "kept"
    files = {file(tmp_path / folder / "day", str(kept), key) for folder in "xy" for key in keys[:2]}
    assert len(files) == 4
    assert all(one.is_relative_to(kept) and one.name == "day-00-000007.safetensors" for one in files)


def test_the_mean_of_a_look_does_not_depend_on_what_was_made_before(frames):
    """Frame 1 as an image instead of a file: 300 dark pixels of car and 100 of road, of every 64th."""
    wanted = frames._tones(0)
    labels = torch.ones(80, 80, dtype=torch.uint8)
    labels[60:] = 7
    image = torch.full((3, 160, 160), round((1 - 0.3) * 127.5), dtype=torch.uint8)
    image[:, 120:] = round((1 + 0.4) * 127.5)
    window = SimpleNamespace(camera_labels=labels, image=image, valid=torch.ones(160, 160, dtype=torch.bool))
    frames._file(1).unlink()
    frames._means, frames.crops = {}, SimpleNamespace(window=lambda index: {1: window}[index])
    for one, other in zip(wanted, frames._tones(0), strict=True):
        torch.testing.assert_close(one, other, atol=0.005, rtol=0)


def test_crops_lie_where_a_camera_looks_but_for_a_share():
    """A camera sees 100 of 1000 columns, from 300 on; crops are 64 wide and may begin MARGIN before."""
    frames, known = object.__new__(PaintingFrames), torch.zeros(4, 2000, dtype=torch.bool)
    known[1, 600:800] = True
    starts = {}
    for share in (0.0, 0.5):
        frames.options = ScenePaintingOptions(columns=64, elsewhere_probability=share)
        generator = np.random.default_rng(0)
        assert abs(frames._start(known, None) - (350 - 32)) <= 1
        starts[share] = [frames._start(known, generator) for _ in range(2000)]
    assert min(starts[0.0]) == 300 - MARGIN and max(starts[0.0]) == 399 + MARGIN - 64
    assert min(starts[0.5]) < 20 and max(starts[0.5]) > 1000 - 64 - 20 and max(starts[0.5]) <= 1000 - 64
    inside = np.mean([300 - MARGIN <= start <= 399 + MARGIN - 64 for start in starts[0.5]])
    assert 0.5 < inside < 0.65


def test_a_crop_may_be_as_wide_as_what_is_known():
    frames, known = object.__new__(PaintingFrames), torch.ones(4, 128, dtype=torch.bool)
    frames.options = ScenePaintingOptions(columns=64)
    assert frames._start(known[:, :128], np.random.default_rng(0)) == 0 == frames._start(known, None)
