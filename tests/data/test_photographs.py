"""Crops of photographs, of every camera, beside a teacher's latents of the same place."""

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from lidar2pano.data.frames import SampleIndex
from lidar2pano.data.photographs import PhotographDataset, photograph_key
from lidar2pano.errors import InputError
from miniature_surround import write_pandaset


@pytest.fixture
def root(tmp_path):
    """Two photographs of 44 x 60 and 36 x 52 pixels without scans; a pixel says where it lies."""
    folder = tmp_path / "set"
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True)
    for name, (rows, columns) in {"a": (44, 60), "b": (36, 52)}.items():
        row, column = np.mgrid[:rows, :columns]
        Image.fromarray(np.stack([row, column, row * 0], 2).astype(np.uint8)).save(folder / f"images/{name}.png")
    return folder


def latents_of(photographs, index):
    """(2, h, w): row and column of each latent pixel."""
    rows, columns = (side // 8 for side in photographs.photograph(index).shape[:2])
    return torch.stack(torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")).half()


def test_photographs_are_cut_to_whole_latent_pixels(root):
    photographs = PhotographDataset(root, ("train",), 16)
    assert len(photographs) == 2
    assert [photographs.photograph(index).shape for index in range(2)] == [(40, 56, 3), (32, 48, 3)]


def test_a_crop_and_its_latents_show_the_same_place(root, tmp_path):
    photographs = PhotographDataset(root, ("train",), 16, tmp_path)
    for index in range(2):
        name = photograph_key(photographs.photograph(index))
        save_file({"latents": latents_of(photographs, index)}, tmp_path / f"{name}.safetensors")
    places = set()
    for seed in range(30):
        image, latents = photographs[SampleIndex(seed % 2, seed)]
        assert image.shape == (3, 16, 16)
        assert latents.shape == (2, 2, 2)
        corner = ((image[:2, 0, 0] + 1) * 127.5).round().tolist()
        assert (8 * latents[:, 0, 0]).tolist() == corner
        places.add(tuple(corner))
    assert len(places) > 10


def test_a_crop_is_the_same_for_the_same_seed_and_in_the_middle_for_a_number(root):
    photographs = PhotographDataset(root, ("train",), 16)
    first, second = (photographs[SampleIndex(0, 7)].image for _ in range(2))
    assert torch.equal(first, second)
    assert ((photographs[0].image[:2, 0, 0] + 1) * 127.5).round().tolist() == [8, 16]


def test_every_camera_of_a_surround_frame_is_a_photograph(tmp_path):
    photographs = PhotographDataset(write_pandaset(tmp_path), ("all",), 16)
    assert len(photographs) == sum(len(frame.cameras) for frame in photographs.frames) == 6
    (rows, columns, _), frame = photographs.photograph(2).shape, photographs.frames[0]
    image = list(frame.cameras.values())[2].image
    assert (photographs.photograph(2) == image[:rows, :columns]).all()


def test_what_is_missing_is_said(root, tmp_path):
    with pytest.raises(InputError, match="multiple of 8"):
        PhotographDataset(root, ("train",), 20)
    with pytest.raises(InputError, match=r"runs/teacher_latents\.py"):
        PhotographDataset(root, ("train",), 16, tmp_path)[0]
    with pytest.raises(InputError, match=r"b: .* smaller than 48 pixels"):
        PhotographDataset(root, ("train",), 48)[1]
