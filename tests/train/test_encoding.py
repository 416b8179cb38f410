"""The smaller encoder of a painter: it learns the latents of the painter's own, and nothing else changes."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch.utils.data import default_collate

from blob_photographs import write_blobs
from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.card import Card, load, save
from lidar2pano.train.checkpoint import load_checkpoint
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task

NARROW = ((6, 8, 10), (1, 1, 1))
OWN = {"latents": 4, "autoencoder": ((8, 12, 16), (4, 4, 6, 8)), "mean": NARROW, "flow": NARROW, "code": 8}
SMALLER = {**OWN, "autoencoder": ((4, 6, 8), (4, 4, 6, 8))}


@pytest.fixture
def place(tmp_path):
    """Three photographs of 40 x 72 pixels, and a painter whose latents are far from unit scale."""
    write_blobs(tmp_path / "set", 5, 9)
    torch.manual_seed(0)
    painter = build("latent-painter", **OWN)
    painter.decoder.scale.copy_(torch.tensor([[0.3, -0.2, 0.1, 0.0], [0.5, 0.2, 0.4, 1.0]]))
    save(tmp_path / "own.safetensors", painter, Card(network="latent-painter", settings=OWN))
    return tmp_path


def small(place, *further):
    recipe = recipe_named("latent-encoder-mini")
    network = replace(recipe.networks["painter"], settings=SMALLER)
    recipe = replace(recipe, networks={"painter": network})
    for assignment in (
        "options.size=32",
        "data.val=train",
        "training.precision=32-true",
        "training.ema=0",
        f"options.painter={place / 'own.safetensors'}",
        *further,
    ):
        recipe = override(recipe, assignment)
    return recipe


def test_its_latents_come_nearer_to_those_of_the_painters_own(place):
    task = build_task(small(place), place / "set")
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(3)])
    optimizer = torch.optim.AdamW([part for part in task.networks["painter"].parameters() if part.requires_grad], 5e-3)
    losses = []
    for _ in range(60):
        ((role, loss),) = task.updates(batch)
        assert role == "painter"
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]


def test_half_of_the_lesson_is_pictures_of_half_the_size(place):
    """By definition: normalised latents are those of the encoder, less the mean, over the deviation."""
    task = build_task(small(place), place / "set")
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(3)])
    ((_, loss),) = task.updates(batch)
    own, _ = load(place / "own.safetensors")
    deviation = torch.tensor([0.5, 0.2, 0.4, 1.0])[:, None, None]
    halved = batch.image.view(3, 3, 16, 2, 16, 2).mean((3, 5))
    gaps = [
        ((task.networks["painter"].encoder(image) - own.encoder(image)) / deviation).square().mean()
        for image in (batch.image, halved)
    ]
    assert float(loss.detach()) == pytest.approx(float(sum(gaps).detach()) / 2, rel=0.05)
    scores = task.validate()
    assert scores["score"] == -scores["latents"] < 0


def test_a_run_releases_the_painter_with_another_encoder(place):
    recipe = small(place, "training.minutes=0", "training.steps=3", "training.preview_minutes=0")
    train(recipe, place / "set", place / "run", device="cpu")
    own, card = load(place / "own.safetensors")
    made, made_card = load(place / "run/weights/painter.safetensors", expect="latent-painter")
    assert made_card.settings["autoencoder"][0] == [4, 6, 8]
    weights = made.state_dict()
    for name, weight in own.state_dict().items():
        assert name.startswith("encoder.") or torch.equal(weight, weights[name])
    picture = torch.rand(1, 3, 32, 32) * 2 - 1
    assert made.encode(picture).shape == own.encode(picture).shape == (1, 4, 4, 4)
    assert made_card.views["panorama"] and card.network == made_card.network


@pytest.mark.usefixtures("one_thread")
def test_two_processes_equal_one_that_takes_two_turns(place):
    """`encode` is no `forward`: without the engine's help each process would learn for itself."""
    settings = {"looks": ("photograph", "day", "overcast", "autumn", "evening"), "palette": True}
    card = Card(network="latent-painter", settings=settings)
    save(place / "whole.safetensors", build("latent-painter", **settings), card)
    changes = [f"options.painter={place / 'whole.safetensors'}", "options.size=32", "data.val=train"]
    changes += [f"training.{name}" for name in ("precision=32-true", "ema=0", "batch=2", "steps=2", "minutes=0")]
    recipe = recipe_named("latent-encoder-mini")
    for change in [*changes, "training.accumulate=2"]:
        recipe = override(recipe, change)
    train(recipe, place / "set", place / "one", device="cpu")
    words = [word for change in changes for word in ("--set", change)]
    data, out = ("--data", str(place / "set")), ("--out", str(place / "two"))
    command = [sys.executable, "-m", "lidar2pano", "train", "latent-encoder-mini", *data, *out, "--device", "cpu"]
    done = subprocess.run(
        [*command, "--devices", "2", *words],
        capture_output=True, text=True, check=False, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    one, two = (load_checkpoint(place / name)[1] for name in ("one", "two"))
    apart = [(one[name] - two[name]).abs().max() for name in one if name.startswith("network/painter/encoder.")]
    assert apart and max(apart) < 1e-5


def test_a_table_cannot_be_set_by_a_word():
    with pytest.raises(InputError, match="networks.painter.settings.autoencoder is a table"):
        override(recipe_named("latent-encoder"), "networks.painter.settings.autoencoder=16,32")


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("options.painter=", "needs --set options.painter=FILE"),
        ("options.size=40", "options.size=40: must be a multiple of 16"),
        ("latents", "was trained with other settings than the network's"),
        ("palette", "was trained with other settings than the network's"),
    ],
)
def test_what_it_cannot_learn_from(place, assignment, message):
    recipe = small(place)
    if "=" not in assignment:
        network = replace(recipe.networks["painter"], settings={**SMALLER, assignment: 5})
        recipe = replace(recipe, networks={"painter": network})
    else:
        recipe = override(recipe, assignment)
    with pytest.raises(InputError, match=message):
        build_task(recipe, place / "set")
