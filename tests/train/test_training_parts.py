"""The parts of the training loop: the order of draws, learning rates, averages, checkpoints, weights to start from."""

from __future__ import annotations

import gc
import os
import random
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from torch import nn

from lidar2pano.data.frames import evenly_spaced
from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.train.averages import EMA, averaged
from lidar2pano.train.camera_segmentation import CameraSegmentation
from lidar2pano.train.checkpoint import Progress, commit, load_checkpoint, make_card, save_checkpoint, trained_on
from lidar2pano.train.engine import Meter, learning_rate, make_optimizer
from lidar2pano.train.environment import Timer, choose_precision
from lidar2pano.train.latent_painting import LatentPaintingOptions
from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.sampling import BatchSampler, batches, sample_at, seed_step
from lidar2pano.train.task import build_networks


def test_every_epoch_has_each_sample_once_in_another_order():
    epochs = [[sample_at(5, 11 * epoch + place, 11) for place in range(11)] for epoch in range(3)]
    orders = [[draw.index for draw in epoch] for epoch in epochs]
    assert all(sorted(order) == list(range(11)) for order in orders)
    assert orders[0] != orders[1] != orders[2]
    assert len({draw.seed for epoch in epochs for draw in epoch}) == 33
    assert [sample_at(5, place, 11) for place in range(11)] == epochs[0]
    assert [sample_at(6, place, 11).index for place in range(11)] != orders[0]


def test_draws_start_at_the_step_and_are_shared_out():
    training = Training(batch=12, accumulate=3)
    whole = list(islice(BatchSampler(100, 0, training), 9))
    assert [len(turn) for turn in whole] == [4] * 9
    assert list(islice(BatchSampler(100, 2, training), 3)) == whole[6:]
    shares = [list(islice(BatchSampler(100, 1, training, rank, 2), 3)) for rank in range(2)]
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
    assert all(len(set(values)) == 4 for values in zip(*drawn, strict=True))


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
        ({"schedule": "linear"}, 9, 0.5, 2.0),
        ({"schedule": "linear"}, 9, 0.75, 1.0),
        ({"schedule": "linear"}, 9, 1.5, 0.0),
        ({"schedule": "exponential", "final": 0.25}, 9, 0.5, 1.0),
        ({"schedule": "exponential", "final": 0.25}, 9, 2.0, 0.5),
    ],
)
def test_learning_rate(settings, step, progress, rate):
    assert learning_rate(Optimizer(rate=2.0, **settings), step, progress) == pytest.approx(rate, abs=1e-12)


def test_optimisers_are_what_the_recipe_says():
    network = nn.Linear(2, 1)
    network.bias.requires_grad_(False)
    settings = Optimizer(algorithm="adam", rate=0.5, betas=(0.1, 0.2), weight_decay=0.3)
    group = (made := make_optimizer(settings, network)).param_groups[0]
    assert type(made) is torch.optim.Adam and len(group["params"]) == 1
    assert (group["lr"], group["betas"], group["weight_decay"]) == (0.5, (0.1, 0.2), 0.3)
    assert type(make_optimizer(replace(settings, algorithm="adamw"), network)) is torch.optim.AdamW


def test_means_of_losses_take_no_more_memory_with_every_step():
    """In all but the first of several processes nobody reads them."""
    meter, before = Meter(), sum(type(part) is torch.Tensor for part in gc.get_objects())
    for step in range(100):
        meter.add({"loss": torch.tensor(float(step)), "rate": step})
    assert sum(type(part) is torch.Tensor for part in gc.get_objects()) <= before + 1
    assert meter.read() == {"loss": 49.5, "rate": 49.5} and not meter.read()


def test_average_follows_its_formula_and_copies_statistics():
    network = nn.BatchNorm1d(1)
    average = EMA(network, decay=0.5)
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
    average = EMA(network, decay=0.9)
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


def test_what_is_applied_keeps_a_share_of_the_start():
    network = nn.BatchNorm1d(1)
    average = EMA(network, decay=0.0, start_share=0.25)  # of a weight of 1
    with torch.no_grad():
        network.weight.fill_(5.0)
        network.running_mean.fill_(8.0)
    average.update(0)
    with averaged([network], [average]):
        assert network.weight.item() == pytest.approx(0.25 * 1 + 0.75 * 5)
        assert network.running_mean.item() == 8  # statistics are those of the end
    assert network.weight.item() == 5 and average.state["weight"].item() == 5


@pytest.mark.parametrize(("start", "ema"), [("", 0.9), ("FILE", 0.0)])
def test_a_share_of_the_start_needs_a_start_and_an_average(start, ema):
    recipe = recipe_named("titan-pano-mini")
    network = replace(recipe.networks["translator"], start=start, start_share=0.5)
    recipe = replace(recipe, networks={"translator": network}, training=replace(recipe.training, ema=ema))
    with pytest.raises(InputError, match="start_share is a share"):
        build_networks(recipe)


@pytest.mark.parametrize(("batch", "accumulate"), [(1, 1), (4, 4)])
def test_a_camera_segmenter_takes_two_images_at_a_time(tmp_path, batch, accumulate):
    recipe = recipe_named("sdnet-mini")
    training = replace(recipe.training, batch=batch, accumulate=accumulate)
    with pytest.raises(InputError, match=r"training\.batch is one image at a time"):
        CameraSegmentation(replace(recipe, training=training), tmp_path)


def test_a_timer_counts_from_the_end_of_the_last_time():
    timer = Timer(0.5, 100.0)
    assert [timer.due(seconds) for seconds in (100, 129, 130, 131)] == [False, False, True, True]
    timer.done(131, 231)  # it took longer than its pause
    assert [timer.due(seconds) for seconds in (231, 260, 261)] == [False, False, True]
    assert not Timer(0.0, 0.0).due(1e9)


def test_a_timer_keeps_to_its_share_of_the_time():
    timer = Timer(0.5, 0.0, share=0.05)
    timer.done(30, 31)  # a twentieth of 20 seconds: the pause of 30 is enough
    assert not timer.due(60) and timer.due(61)
    timer.done(61, 71)  # ten seconds: a twentieth of 200
    assert not timer.due(260) and timer.due(261)


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


@pytest.mark.parametrize(
    "state",
    [
        '{"step": "4"}',
        '{"step": -1}',
        '{"seconds": NaN}',
        '{"seconds": "x"}',
        '{"best": []}',
        '{"more": 1}',
        "[]",
        "[" * 9999,
    ],
)
def test_a_state_that_no_run_writes_is_refused(tmp_path, state):
    (checkpoint(tmp_path, 3) / "state.json").write_text(state)
    with pytest.raises(InputError, match="000000003 is damaged .*; remove it to start again"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("PytorchStreamWriter failed")])
def test_a_full_disk_is_one_line_and_leaves_the_last_checkpoint(tmp_path, monkeypatch, error):
    checkpoint(tmp_path, 1)

    def refuse(*_):
        raise error

    monkeypatch.setattr(torch, "save", refuse)
    with pytest.raises(InputError, match=r"000000002.part: cannot be written \((No space left|Pytorch)"):
        checkpoint(tmp_path, 2)
    assert load_checkpoint(tmp_path)[0].step == 1


def test_settings_that_no_network_can_have_are_refused():
    recipe = small_critic(width=-1)
    with pytest.raises(InputError, match="network 'projected-critic' cannot be built with settings .*'width': -1"):
        build_networks(recipe)


@pytest.mark.parametrize(("count", "most"), [(3, 500), (500, 500), (20_000, 500), (1, 20), (7, 3)])
def test_a_sample_of_frames_is_evenly_spaced(count, most):
    found = evenly_spaced(count, most)
    assert len(found) == len(set(found)) == min(count, most)
    assert (found[0], found[-1]) == (0, count - 1)
    assert found == list(range(count)) or np.ptp(np.diff(found)) <= 1


class Broken:
    """A data set whose every sample is the user's mistake."""

    def __len__(self):
        return 4

    def __getitem__(self, index):
        raise InputError("sequences/00/labels/000003.label: is missing; complete the data")


@pytest.mark.parametrize("workers", [0, 1])
def test_a_mistake_in_a_loader_worker_is_its_one_line(workers):
    found = batches(Broken(), BatchSampler(4, 0, Training(batch=2)), workers, pinned=False)
    with pytest.raises(InputError) as refusal:
        next(found)
    assert str(refusal.value) == "sequences/00/labels/000003.label: is missing; complete the data"


class Killer(Broken):
    """A data set that kills the process that reads it."""

    def __getitem__(self, index):
        os.kill(os.getpid(), signal.SIGKILL)


# torch learns of the second worker's end while it clears up after the first
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_killed_loader_worker_is_one_line():
    found = batches(Killer(), BatchSampler(4, 0, Training(batch=2)), 1, pinned=False)
    with pytest.raises(InputError, match="samples was killed.*; repeat the command to go on"):
        next(found)


def test_weights_that_are_not_finite_are_not_kept(tmp_path):
    checkpoint(tmp_path, 1)
    with pytest.raises(FloatingPointError, match="network/a/w is not finite after step 2"):
        checkpoint(tmp_path, 2, value=float("inf"))
    assert load_checkpoint(tmp_path)[0].step == 1


@pytest.mark.parametrize("name", ["state.json", "weights.safetensors", "optimizers.pt"])
@pytest.mark.parametrize("content", [b"", b"{", b"\x80\x02garbage"])
def test_a_damaged_checkpoint_is_named(tmp_path, name, content):
    (checkpoint(tmp_path, 3) / name).write_bytes(content)
    with pytest.raises(InputError, match="000000003 is damaged .*; remove it to start again"):
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
    spec = Network(model="projected-critic", settings={"mixed": 4, "width": width}, start=str(start))
    return Recipe(name="r", view="panorama", networks={"critic": spec}, options=LatentPaintingOptions())


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
        Network(model="latent-painter", settings={"widths": (1, 2, 3)}),
        {"labels": "x", "steps": 1},
        {"steps": 2, "recipe": "r"},
    )
    assert (card.network, card.settings, card.labels, card.steps) == ("latent-painter", {"widths": [1, 2, 3]}, "x", 2)
    assert card.commit == commit() != ""


@pytest.mark.parametrize(
    ("device", "has", "precision"),
    [
        ("cpu", True, "bf16-mixed"),
        ("cpu", False, "32-true"),
        ("cuda", True, "bf16-mixed"),
        ("cuda", False, "16-mixed"),
    ],
)
def test_bfloat16_only_where_the_device_has_it(monkeypatch, device, has, precision):
    monkeypatch.setattr("lidar2pano.train.environment.has_bfloat16", lambda device: has)
    assert choose_precision(Training(precision="bf16-mixed"), torch.device(device)) == precision
    assert choose_precision(Training(precision="32-true"), torch.device(device)) == "32-true"


def test_curves_are_written_without_tensorflow_though_it_is_installed(tmp_path):
    """It would take seconds, say much on stderr, and raise errors of its own on a full disk."""
    (tmp_path / "tensorflow.py").write_text("raise SystemExit('tensorflow is imported')\n")
    program = (
        "from pathlib import Path\n"
        "from lidar2pano.train.monitor import Monitor\n"
        f"Monitor(Path({str(tmp_path)!r}), 'a', 1, 0).close()"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        check=False,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    assert list((tmp_path / "tensorboard").glob("events.*"))
