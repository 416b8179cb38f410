"""The parts of the training loop: the order of draws, learning rates, averages, checkpoints, weights to start from."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from torch import nn

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.train.checkpoint import Progress, load_checkpoint, save_checkpoint
from lidar2pano.train.clock import every
from lidar2pano.train.draws import Places, draw_at, seed_step
from lidar2pano.train.optimisation import Average, averaged, clip, learning_rate, make_optimizer
from lidar2pano.train.placement import arithmetic
from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training
from lidar2pano.train.release import commit, make_card, trained_on
from lidar2pano.train.task import build_networks


def test_every_epoch_draws_each_sample_once_in_another_order():
    epochs = [[draw_at(5, 11 * epoch + place, 11) for place in range(11)] for epoch in range(3)]
    orders = [[draw.index for draw in epoch] for epoch in epochs]
    assert all(sorted(order) == list(range(11)) for order in orders)
    assert orders[0] != orders[1] != orders[2]
    assert len({draw.seed for epoch in epochs for draw in epoch}) == 33
    assert [draw_at(5, place, 11) for place in range(11)] == epochs[0]
    assert [draw_at(6, place, 11).index for place in range(11)] != orders[0]


def test_draws_start_at_the_step_and_are_shared_out():
    training = Training(batch=12, accumulate=3)
    whole = list(islice(Places(100, 0, training), 9))
    assert [len(turn) for turn in whole] == [4] * 9
    assert list(islice(Places(100, 2, training), 3)) == whole[6:]
    shares = [list(islice(Places(100, 1, training, rank, 2), 3)) for rank in range(2)]
    assert [len(turn) for share in shares for turn in share] == [2] * 6
    drawn = sorted(draw for share in shares for turn in share for draw in turn)
    assert drawn == sorted(draw for turn in whole[3:6] for draw in turn)


def test_each_step_and_process_has_numbers_of_its_own():
    def numbers(*where):
        seed_step(*where)
        return torch.rand(()).item(), np.random.random(), random.random()  # noqa: NPY002 what is seeded

    places = [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]
    drawn = [numbers(*place) for place in places]
    assert [numbers(*place) for place in places] == drawn
    assert all(len(set(kind)) == 4 for kind in zip(*drawn, strict=True))


@pytest.mark.parametrize(
    ("settings", "step", "progress", "rate"),
    [
        ({"schedule": "constant"}, 50, 0.5, 2.0),
        ({"schedule": "constant", "warmup": 4}, 0, 0.0, 0.5),
        ({"schedule": "constant", "warmup": 4}, 3, 0.1, 2.0),
        ({"schedule": "cosine"}, 0, 0.0, 2.0),
        ({"schedule": "cosine"}, 9, 0.5, 1.0),
        ({"schedule": "cosine"}, 9, 1.5, 0.0),
        ({"schedule": "cosine", "warmup": 10}, 4, 0.5, 0.5),
    ],
)
def test_learning_rate(settings, step, progress, rate):
    assert learning_rate(Optimizer(rate=2.0, **settings), step, progress) == pytest.approx(rate, abs=1e-12)


def test_optimisers_are_what_the_recipe_says():
    network = nn.Linear(2, 1)
    network.bias.requires_grad_(False)
    settings = Optimizer(kind="adam", rate=0.5, betas=(0.1, 0.2), weight_decay=0.3)
    group = (made := make_optimizer(settings, network)).param_groups[0]
    assert type(made) is torch.optim.Adam and len(group["params"]) == 1
    assert (group["lr"], group["betas"], group["weight_decay"]) == (0.5, (0.1, 0.2), 0.3)
    assert type(make_optimizer(replace(settings, kind="adamw"), network)) is torch.optim.AdamW


@pytest.mark.parametrize(("largest", "norm"), [(0.0, 5.0), (1.0, 1.0), (9.0, 5.0)])
def test_clip(largest, norm):
    weight = nn.Parameter(torch.zeros(2))
    weight.grad = torch.tensor([3.0, 4.0])
    clip([weight], largest)
    assert weight.grad.norm().item() == pytest.approx(norm, rel=1e-4)


def test_average_follows_its_formula_and_copies_statistics():
    network = nn.BatchNorm1d(1)
    average = Average(network, decay=0.5)
    for step, value in enumerate([1.0, 2.0, 4.0]):
        with torch.no_grad():
            network.weight.fill_(value)
            network.running_mean.fill_(10 * value)
        network.num_batches_tracked.fill_(step)
        average.update(step)
    # decays 1/10, 2/11, 3/12 of 1, 1, 2, 4: all below 0.5
    expected = 1.0
    for step, value in enumerate([1.0, 2.0, 4.0]):
        decay = (1 + step) / (10 + step)
        expected = decay * expected + (1 - decay) * value
    assert average.state["weight"].item() == pytest.approx(expected)
    assert average.state["running_mean"].item() == 40 and average.state["num_batches_tracked"].item() == 2
    with torch.no_grad():
        network.weight.fill_(0.0)
    average.update(1000)
    assert average.state["weight"].item() == pytest.approx(expected / 2)


def test_inside_averaged_the_network_carries_its_average_and_comes_back_exactly():
    network = nn.Sequential(nn.Linear(3, 3), nn.Dropout(0.5), nn.BatchNorm1d(3))
    network[2].eval()  # frozen statistics stay frozen
    average = Average(network, decay=0.9)
    with torch.no_grad():
        network[0].weight.mul_(1 / 3)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    kept = {name: value.clone() for name, value in average.state.items()}
    with averaged([network], [average]):
        assert torch.equal(network[0].weight, kept["0.weight"]) and not network[1].training
        assert not network(torch.ones(2, 3)).requires_grad
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
    assert all(torch.equal(kept[name], value) for name, value in average.state.items())
    assert (network.training, network[1].training, network[2].training) == (True, True, False)


def test_every_counts_from_the_last_time():
    due = every(0.5, 100.0)
    assert [due(seconds) for seconds in (100, 129, 130, 131, 159, 170, 199, 200)] == [
        False, False, True, False, False, True, False, True,
    ]  # fmt: skip
    assert not every(0.0, 0.0)(1e9)


def checkpoint(run, step, value=1.0):
    weights = {"network/a/w": torch.full((2, 2), value).t(), "average/a/w": torch.zeros(2)}
    return save_checkpoint(run, Progress(step=step, seconds=2.0), weights, {"a": {"state": {}, "betas": (0.5, 0.9)}})


def test_the_newest_whole_checkpoint_counts(tmp_path):
    assert load_checkpoint(tmp_path) is None
    checkpoint(tmp_path, 9)
    checkpoint(tmp_path, 10, value=3.0)
    (tmp_path / "checkpoints/000000011.part").mkdir()
    for older in ("000000010.old", "000000008"):  # killed before they were removed
        shutil.copytree(tmp_path / "checkpoints/000000010", tmp_path / "checkpoints" / older)
        (tmp_path / "checkpoints" / older / "state.json").write_text('{"step": 8}')
    progress, weights, optimizers = load_checkpoint(tmp_path)
    assert progress == Progress(step=10, seconds=2.0)
    assert weights["network/a/w"].tolist() == [[3.0, 3.0], [3.0, 3.0]] and optimizers["a"]["betas"] == (0.5, 0.9)
    checkpoint(tmp_path, 10, value=4.0)  # once more at the same step
    assert load_checkpoint(tmp_path)[1]["network/a/w"][0, 0] == 4.0
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["000000010"]
    (tmp_path / "checkpoints/000000010").rename(tmp_path / "checkpoints/000000010.old")  # killed between two renames
    assert load_checkpoint(tmp_path)[0].step == 10


def test_weights_that_are_not_finite_are_not_kept(tmp_path):
    checkpoint(tmp_path, 1)
    with pytest.raises(FloatingPointError, match="network/a/w is not finite after step 2"):
        checkpoint(tmp_path, 2, value=float("inf"))
    assert load_checkpoint(tmp_path)[0].step == 1


@pytest.mark.parametrize("name", ["state.json", "weights.safetensors", "optimizers.pt"])
@pytest.mark.parametrize("content", [b"", b"{", b"\x80\x02garbage"])
def test_a_damaged_checkpoint_is_named(tmp_path, name, content):
    (checkpoint(tmp_path, 3) / name).write_bytes(content)
    with pytest.raises(InputError, match="000000003 is damaged .*; remove it to start anew"):
        load_checkpoint(tmp_path)


def test_a_checkpoint_executes_nothing(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    torch.save({"a": Trap()}, checkpoint(tmp_path, 3) / "optimizers.pt")
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(tmp_path)
    assert not (tmp_path / "sprung").exists()


def small_critic(start="", width=4):
    spec = Network(model="patch-critic", settings={"channels": 3, "width": width, "layers": 1}, start=str(start))
    return Recipe(name="r", task="painting", view="panorama", networks={"critic": spec})


def test_networks_start_fresh_or_from_a_weight_file(tmp_path):
    spec = small_critic().networks["critic"]
    trained = build(spec.model, **spec.settings)
    path = tmp_path / "critic.safetensors"
    save(path, trained, Card(network=spec.model, settings=dict(spec.settings)), dtype=torch.float32)
    started = build_networks(small_critic(path))["critic"].state_dict()
    assert all(torch.equal(value, started[name]) for name, value in trained.state_dict().items())
    fresh = build_networks(small_critic())["critic"].state_dict()
    assert any(not torch.equal(value, fresh[name]) for name, value in trained.state_dict().items())
    with pytest.raises(InputError, match="networks.critic.start: .* was trained with other settings"):
        build_networks(small_critic(path, width=6))
    with pytest.raises(InputError, match="no weight file"):
        build_networks(small_critic(tmp_path / "absent"))


def test_a_card_names_every_data_set(tmp_path):
    root, more = tmp_path / "kitti", tmp_path / "towns"
    assert trained_on(root, ("train", "train")) == "kitti"
    assert trained_on(root, (f"{more}:all", "train", f"{more}:val")) == "towns+kitti"
    assert trained_on(root, (f"{more}:all",)) == "towns"


def test_a_card_says_what_task_and_run_know():
    card = make_card(
        Network(model="painter", settings={"widths": (1, 2, 3)}),
        {"labels": "x", "steps": 1},
        {"steps": 2, "recipe": "r"},
    )
    assert (card.network, card.settings, card.labels, card.steps) == ("painter", {"widths": [1, 2, 3]}, "x", 2)
    assert card.commit == commit() != ""


@pytest.mark.parametrize(("has", "precision"), [(True, "bf16-mixed"), (False, "32-true")])
def test_bfloat16_only_where_the_device_has_it(monkeypatch, has, precision):
    monkeypatch.setattr("lidar2pano.train.placement.has_bfloat16", lambda device: has)
    assert arithmetic(Training(precision="bf16-mixed"), "cpu") == precision
    assert arithmetic(Training(precision="32-true"), "cpu") == "32-true"
