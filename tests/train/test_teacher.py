"""What a task learns from a teacher: a trained network of the same kind."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.utils.data import default_collate

from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.losses.supervised import distillation
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from miniature import write_data_set

SMALL = {
    "fast-segmenter-mini": ("segmenter", {"classes": 20, "channels": 6, "widths": (8, 8, 8, 8)}),
    "fast-translator-mini": (
        "translator",
        {"classes": 16, "conditions": 20, "widths": (8, 8, 8, 8, 8), "pyramid": 8, "dropout": 0.0},
    ),
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_data_set(tmp_path_factory.mktemp("data"))


def small(name: str) -> Recipe:
    role, settings = SMALL[name]
    recipe = recipe_named(name)
    recipe = replace(recipe, networks={role: replace(recipe.networks[role], settings=settings)})
    columns, scale = (64, 1) if role == "segmenter" else (160, 0.125)
    for assignment in (f"options.columns={columns}", f"scale={scale}", "training.precision=32-true"):
        recipe = override(recipe, assignment)
    return recipe


def written_teacher(name: str, folder) -> nn.Module:
    torch.manual_seed(7)
    role, settings = SMALL[name]
    model = recipe_named(name).networks[role].model
    network = build(model, **settings).eval()
    save(folder / "teacher.safetensors", network, Card(network=model, settings=settings))
    return network


def test_the_divergence_from_a_teacher_by_hand():
    logits = torch.tensor([[0.25, 0.75], [0.5, 0.5]]).log().T[None, :, None]  # two pixels of two classes
    taught = torch.tensor([[0.5, 0.5], [0.5, 0.5]]).log().T[None, :, None]
    one = 0.5 * math.log(0.5 / 0.25) + 0.5 * math.log(0.5 / 0.75)
    assert distillation(logits, taught).item() == pytest.approx(one / 2)
    assert distillation(logits, taught, torch.tensor([[[True, False]]])).item() == pytest.approx(one)
    assert distillation(logits, taught, torch.zeros(1, 1, 2, dtype=torch.bool)).item() == 0
    assert distillation(logits + 3, logits).item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", SMALL)
def test_a_task_draws_nearer_to_its_teacher(name, root, tmp_path):
    written_teacher(name, tmp_path)
    recipe = override(small(name), f"options.teacher={tmp_path / 'teacher.safetensors'}")
    task = build_task(override(recipe, "options.distillation=100"), root)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    (network,) = task.networks.values()
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    course = []
    for _ in range(12):
        ((_, loss),) = task.updates(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        course.append(float(task.logs["distillation"]))
    assert course[-1] < 0.6 * course[0]
    assert not any(weight.requires_grad for weight in task.teacher.network.parameters())


@pytest.mark.parametrize("name", SMALL)
def test_the_teacher_itself_has_nothing_to_learn(name, root, tmp_path):
    teacher = written_teacher(name, tmp_path)
    task = build_task(override(small(name), f"options.teacher={tmp_path / 'teacher.safetensors'}"), root)
    (network,) = task.networks.values()
    network.load_state_dict(teacher.state_dict())
    network.eval()
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    list(task.updates(batch))
    learned = {key: float(value) for key, value in task.logs.items() if key in ("distillation", "taught_depth")}
    assert learned and max(map(abs, learned.values())) < 1e-3  # the teacher computes in bfloat16


def test_a_translators_crops_begin_anywhere_where_there_is_a_teacher(root, tmp_path):
    written_teacher("fast-translator-mini", tmp_path)
    recipe = small("fast-translator-mini")
    camera = build_task(recipe, root).dataset.window(0).view
    taught = override(recipe, f"options.teacher={tmp_path / 'teacher.safetensors'}")
    around = build_task(taught, root).dataset.window(0).view
    assert camera.columns < around.columns == around.scaled(1).columns
    assert around.left - around.right == pytest.approx(360, abs=360 / around.columns + 1e-6)


def test_a_teacher_that_is_another_network_is_refused(root, tmp_path):
    written_teacher("fast-segmenter-mini", tmp_path)
    recipe = override(small("fast-translator-mini"), f"options.teacher={tmp_path / 'teacher.safetensors'}")
    with pytest.raises(InputError, match="titan-pano"):
        build_task(recipe, root)
