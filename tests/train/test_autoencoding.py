"""The task of the autoencoder: it learns, a teacher's latents too, and what it scores is what it says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch.utils.data import default_collate

from blob_photographs import write_blobs
from lidar2pano.data.frames import SampleIndex
from lidar2pano.data.photographs import PhotographDataset, photograph_key
from lidar2pano.errors import InputError
from lidar2pano.models.card import load
from lidar2pano.train.autoencoding import difference_energy, difference_loss
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task

PLAIN = ("options.perceptual=0", "options.adversarial=0")  # no frozen features
SETTINGS = {"latents": 4, "encoder": (8, 8, 8), "decoder": (8, 8, 8, 8)}


@pytest.fixture
def root(tmp_path):
    """Three photographs of 56 x 72 pixels: blobs of colour."""
    return write_blobs(tmp_path / "set", 7, 9)


def small(*further):
    recipe = recipe_named("autoencoder-mini")
    network = replace(recipe.networks["autoencoder"], settings=SETTINGS)
    critic = replace(recipe.networks["critic"], settings={"conditions": SETTINGS["latents"], "mixed": 8, "width": 8})
    recipe = replace(recipe, networks={"autoencoder": network, "critic": critic})
    plain = ("options.size=48", "data.val=train", "training.workers=0", "training.precision=32-true", *PLAIN, *further)
    for assignment in plain:
        recipe = override(recipe, assignment)
    return recipe


def losses_of(task, steps):
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    optimizer = torch.optim.AdamW(task.networks["autoencoder"].parameters(), lr=3e-3)
    for _ in range(steps):
        ((role, loss),) = task.updates(batch)
        assert role == "autoencoder"
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield {name: float(value) for name, value in task.logs.items()}


def test_pixels_and_latents_come_nearer(root, tmp_path):
    photographs = PhotographDataset(root, ("train",), 48)
    for index in range(len(photographs)):
        image = photographs.photograph(index)
        means = torch.from_numpy(image).double().view(7, 8, 9, 8, 3).mean((1, 3)).movedim(2, 0) / 127.5 - 1
        latents = torch.cat([means, means[:1]]).half()
        save_file({"latents": latents}, tmp_path / f"{photograph_key(image)}.safetensors")
    torch.manual_seed(0)
    first, *_, last = losses_of(build_task(small(f"options.latents={tmp_path}"), root), steps=5)
    assert last["pixels"] < 0.97 * first["pixels"]
    assert last["latents"] < 0.8 * first["latents"]


def test_an_encoder_whose_latents_a_painter_learns_stays_as_it_is(root):
    task = build_task(small("options.encoder=false"), root)
    network = task.networks["autoencoder"]
    before = {name: weight.clone() for name, weight in network.state_dict().items()}
    list(losses_of(task, steps=2))
    changed = {name.split(".")[0] for name, weight in network.state_dict().items() if not weight.equal(before[name])}
    assert changed == {"decoder"}


def test_the_critic_and_the_features_teach_the_autoencoder_alone(root):
    for file in (root / "images").iterdir():
        Image.open(file).resize((144, 112)).save(file)
    task = build_task(small("options.perceptual=0.1", "options.adversarial=0.02", "options.size=96"), root)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    roles = []
    for role, loss in task.updates(batch):
        roles.append(role)
        for network in task.networks.values():
            network.zero_grad()
        loss.backward()
        taught = {name for name, network in task.networks.items() if any(has_gradient(w) for w in network.parameters())}
        assert taught == {role}
    assert roles == ["critic", "autoencoder"]
    plain = task.logs["pixels"] + task.logs["differences"]
    assert loss.item() == pytest.approx(float(plain + 0.1 * task.logs["perceptual"] + 0.02 * task.logs["adversarial"]))


def has_gradient(weight):
    return weight.grad is not None and bool(weight.grad.any())


def test_a_run_releases_the_network_with_its_score(root, tmp_path):
    train(small("training.steps=1", "training.batch=2"), root, tmp_path, device="cpu")
    network, card = load(tmp_path / "weights/autoencoder.safetensors")
    assert set(card.score) >= {"psnr_db", "energy"}
    made, latents = network(torch.zeros(1, 3, 16, 24))
    assert made.shape == (1, 3, 16, 24)
    assert latents.shape == (1, 4, 2, 3)


def test_a_crop_that_is_all_seam_is_refused(root):
    with pytest.raises(InputError, match=r"options\.size=32"):
        build_task(small("options.size=32"), root)


def test_differences_are_those_of_neighbours():
    real, made = torch.rand(1, 2, 5, 6), torch.rand(1, 2, 5, 6)
    across = np.mean(
        [
            abs((made - real)[0, c, i, j + 1] - (made - real)[0, c, i, j])
            for c in range(2)
            for i in range(5)
            for j in range(5)
        ]
    )
    down = np.mean(
        [
            abs((made - real)[0, c, i + 1, j] - (made - real)[0, c, i, j])
            for c in range(2)
            for i in range(4)
            for j in range(6)
        ]
    )
    assert float(difference_loss(made, real)) == pytest.approx(across + down, rel=1e-5)
    assert float(difference_energy(made - real)) == pytest.approx(across + down, rel=1e-5)
