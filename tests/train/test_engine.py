"""The training loop: resume is as if never stopped, two processes are one, budgets, what a run leaves behind."""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import default_collate

from lidar2pano.errors import InputError
from lidar2pano.models.card import load
from lidar2pano.train.checkpoint import load_checkpoint, save_checkpoint
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import Recipe, override, resolved
from lidar2pano.train.sampling import BatchSampler, seed_step
from toy_training import Denoise, Gan, entries, gap, left, toy_recipe

PLAIN = ("networks.generator.settings.norm=false", "networks.generator.settings.dropout=0")
PROGRAM = Path(__file__).parents[1] / "support" / "toy_training.py"


@pytest.fixture(autouse=True)
def _toys(monkeypatch):
    for table, name, value in entries():
        monkeypatch.setitem(table, name, value)
    monkeypatch.setattr(Denoise, "before_step", None)
    monkeypatch.setattr(Gan, "before_step", None)
    monkeypatch.setattr(Denoise, "scores", [])


def run(recipe: Recipe, out: Path) -> Path:
    return train(recipe, Path(), out, device="cpu").parent


def interrupt_at(call: int, number: signal.Signals = signal.SIGINT):
    """A `before_step` that sends this process a signal."""
    return lambda calls: signal.raise_signal(number) if calls == call else None


def start(*arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-W", "error", str(PROGRAM), *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


@pytest.mark.parametrize(
    ("task", "settings"),
    [("toy", {}), ("toy-gan", {"accumulate": 2}), ("toy-gan", {"ema": 0.0, "channels_last": False})],
)
def test_resume_equals_never_stopped(tmp_path, monkeypatch, task, settings):
    recipe = toy_recipe(task, **settings)
    whole = run(recipe, tmp_path / "whole")
    for call in (3, 4):  # stopped in the first epoch (11 samples, 4 a step) and then in the second
        monkeypatch.setattr(TASK_CLASSES[task], "before_step", interrupt_at(call))
        with pytest.raises(KeyboardInterrupt, match="repeat the command"):
            run(recipe, tmp_path / "parts")
    assert 0 < left(tmp_path / "parts")[0] < 12
    monkeypatch.setattr(TASK_CLASSES[task], "before_step", None)
    assert gap(whole, run(recipe, tmp_path / "parts")) == 0
    assert gap(whole, run(replace(recipe, training=replace(recipe.training, seed=1)), tmp_path / "seed")) > 0


TASK_CLASSES = {"toy": Denoise, "toy-gan": Gan}


@pytest.mark.usefixtures("one_thread")
def test_killed_in_an_epoch_and_repeated_equals_an_undisturbed_run(tmp_path):
    often = 0.0005
    killed = start("toy-gan", tmp_path / "killed", 1, 0.2, "training.steps=40", f"training.checkpoint_minutes={often}")
    give_up = time.monotonic() + 120
    while not list(tmp_path.glob("killed/checkpoints/*[1-9]/state.json")) and time.monotonic() < give_up:
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL and 0 < left(tmp_path / "killed")[0] < 40
    run(toy_recipe("toy-gan", steps=40, checkpoint_minutes=often), tmp_path / "killed")
    assert gap(tmp_path / "killed", run(toy_recipe("toy-gan", steps=40), tmp_path / "whole")) == 0


def plain_gan(**training) -> Recipe:
    """The toy GAN without statistics and chance, whose steps can be done by hand."""
    recipe = toy_recipe("toy-gan", **training)
    for change in PLAIN:
        recipe = override(recipe, change)
    return recipe


def test_two_processes_equal_one(tmp_path):
    two = start("toy-gan", tmp_path / "two", 2, 0, *PLAIN, "training.accumulate=2", "training.validate_minutes=0.0001")
    messages = two.communicate()[1]
    assert two.returncode == 0, messages
    recipe = plain_gan()
    assert gap(tmp_path / "two", run(recipe, tmp_path / "one")) < 1e-5
    other = run(replace(recipe, training=replace(recipe.training, batch=2)), tmp_path / "half")
    assert gap(tmp_path / "two", other) > 1e-3  # what one process alone would have seen


def test_lock_step_accumulation_equals_the_big_batch(tmp_path):
    big = run(plain_gan(), tmp_path / "big")
    assert gap(big, run(plain_gan(accumulate=4), tmp_path / "turns")) < 1e-5


def test_steps_are_those_done_by_hand(tmp_path):
    recipe = plain_gan(steps=5, ema=0.5)
    seed_step(recipe.training.seed, 0, -1)
    task = Gan(recipe, Path())
    rules = recipe.networks["generator"].optimizer
    adams = {name: torch.optim.Adam(net.parameters(), lr=0.0, betas=rules.betas) for name, net in task.networks.items()}
    average = {name: value.clone() for name, value in task.networks["generator"].state_dict().items()}
    for step, draws in enumerate(islice(BatchSampler(len(task.dataset), 0, recipe.training), 5)):
        for name, loss in task.updates(default_collate([task.dataset[draw] for draw in draws])):
            for group in adams[name].param_groups:
                group["lr"] = 1e-2 * min(1, (step + 1) / 3) * (1 + math.cos(math.pi * step / 5)) / 2
            weights = list(task.networks[name].parameters())
            for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
                weight.grad = gradient
            torch.nn.utils.clip_grad_norm_(weights, 1.0)
            adams[name].step()
        decay = min(0.5, (1 + step) / (10 + step))
        for name, value in task.networks["generator"].state_dict().items():
            average[name] = decay * average[name] + (1 - decay) * value
    tensors = left(run(recipe, tmp_path))[1]
    for name, network in task.networks.items():
        for key, value in network.state_dict().items():
            assert torch.allclose(value, tensors[f"network/{name}/{key}"], atol=1e-6), (name, key)
    for key, value in average.items():
        assert torch.allclose(value, tensors[f"average/generator/{key}"], atol=1e-6), key


@pytest.mark.parametrize(("channels_last", "bfloat16"), [(True, True), (False, True), (True, False)])
def test_channels_last_is_the_layout_of_the_weights(tmp_path, monkeypatch, channels_last, bfloat16):
    """But not in float32 on a CPU, where it is the slower one."""
    weights = []
    monkeypatch.setattr("lidar2pano.train.environment.has_bfloat16", lambda device: bfloat16)
    monkeypatch.setattr(Denoise, "preview", lambda self: weights.extend(self.networks["generator"].parameters()) or {})
    run(toy_recipe("toy", steps=1, channels_last=channels_last, precision="bf16-mixed"), tmp_path)
    wide = [weight for weight in weights if weight.ndim == 4]
    expected = channels_last and bfloat16
    assert wide and all(w.is_contiguous(memory_format=torch.channels_last) is expected for w in wide)


# --- float16, whose losses are scaled ---------------------------------------------------------------------------------


@pytest.fixture
def float16(monkeypatch):
    """The CPU computes in float16, as a GPU without bfloat16 does."""
    monkeypatch.setattr("lidar2pano.train.engine.choose_precision", lambda training, device: "16-mixed")


def test_float16_trains_as_float32_does_and_clips_what_is_not_scaled(tmp_path, request):
    recipe = toy_recipe("toy", steps=4)
    for change in (*PLAIN, "networks.generator.optimizer.clip=0.01", "networks.generator.optimizer.algorithm=sgd"):
        recipe = override(recipe, change)
    single = run(recipe, tmp_path / "single")
    request.getfixturevalue("float16")
    assert 0 < gap(single, run(recipe, tmp_path / "half")) < 1e-4


def test_in_float16_a_step_that_overflows_is_omitted_and_the_scale_halved(tmp_path, float16, monkeypatch):
    weights = []

    def updates(self, batch):
        self.begin()
        weights.append(self.networks["generator"].layers[0].weight.detach().clone())
        factor = 1e3 if self.calls == 2 else 1e-3  # times the scale, 65536, too large for float16
        yield "generator", factor * self.networks["generator"](batch.noisy).float().mean()

    monkeypatch.setattr(Denoise, "updates", updates)
    run(toy_recipe("toy", steps=3), tmp_path)
    assert not torch.equal(weights[0], weights[1]) and torch.equal(weights[1], weights[2])
    assert load_checkpoint(tmp_path)[2]["loss scale"]["scale"] == 32768


def test_in_float16_resume_equals_never_stopped(tmp_path, float16, monkeypatch):
    def updates(self, batch):
        self.begin()
        factor = 1e3 if "0" in batch.name else 0.5  # steps with image 0 overflow
        yield "generator", factor * (self.networks["generator"](batch.noisy) - batch.image).square().mean()

    monkeypatch.setattr(Denoise, "updates", updates)
    recipe = toy_recipe("toy", steps=6)
    whole = run(recipe, tmp_path / "whole")
    monkeypatch.setattr(Denoise, "before_step", interrupt_at(3))
    with pytest.raises(KeyboardInterrupt):
        run(recipe, tmp_path / "parts")
    monkeypatch.setattr(Denoise, "before_step", None)
    scales = [load_checkpoint(tmp_path / "parts")[2]["loss scale"]]
    assert gap(whole, run(recipe, tmp_path / "parts")) == 0
    scales += [load_checkpoint(tmp_path / name)[2]["loss scale"] for name in ("parts", "whole")]
    assert scales[0]["scale"] < 65536 and scales[1] == scales[2]


@pytest.mark.skipif(not shutil.which(os.environ.get("CXX", "g++")), reason="torch.compile needs a C++ compiler")
@pytest.mark.filterwarnings("ignore:`torch.jit.script:DeprecationWarning")  # torch's own
def test_compiled_steps_are_those_of_the_plain_network(tmp_path, monkeypatch):
    """The toy GAN's generator is compiled and its critic, differentiated twice, is not; validation compiles nothing."""
    torch._dynamo.utils.counters.clear()  # noqa: SLF001 no public count
    compiled = []
    monkeypatch.setattr(torch.nn.Module, "compile", _noting(compiled, torch.nn.Module.compile))
    plain = run(plain_gan(steps=4, validate_minutes=1e-9), tmp_path / "plain")
    assert gap(plain, run(plain_gan(steps=4, validate_minutes=1e-9, compile=True), tmp_path / "compiled")) < 1e-4
    assert [network.layers[-1].out_channels for network in compiled] == [3]
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1  # noqa: SLF001


def _noting(compiled: list, compile_network):
    """`compile_network`, which notes the networks that it compiles."""
    return lambda network, **settings: compiled.append(network) or compile_network(network, **settings)


def test_compiling_without_a_compiler_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(InputError, match=r"training.compile=true needs a C\+\+ compiler, and no-such-compiler is"):
        run(toy_recipe("toy", compile=True), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_workers_change_nothing(tmp_path):
    assert gap(run(toy_recipe("toy"), tmp_path / "0"), run(toy_recipe("toy", workers=2), tmp_path / "2")) == 0


def test_updates_must_agree_over_micro_batches(tmp_path, monkeypatch):
    def moody(self, batch):
        self.begin()
        yield ("generator" if self.calls % 2 else "critic"), self.networks["generator"](batch.noisy).mean()

    monkeypatch.setattr(Gan, "updates", moody)
    with pytest.raises(RuntimeError, match="'generator' for one micro-batch and 'critic' next"):
        run(toy_recipe("toy-gan", accumulate=2), tmp_path)


def test_another_recipe_in_the_same_folder_is_refused(tmp_path):
    recipe = toy_recipe("toy", steps=2)
    run(recipe, tmp_path)
    changed = override(override(recipe, "training.batch=2"), "networks.generator.optimizer.rate=0.1")
    with pytest.raises(InputError) as refusal:
        run(changed, tmp_path)
    assert "networks.generator.optimizer.rate: 0.01 -> 0.1; training.batch: 4 -> 2" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="steps: 2 -> 1"):
        run(override(recipe, "training.steps=1"), tmp_path)
    assert json.loads((tmp_path / "recipe.json").read_text()) == resolved(recipe)


def test_more_steps_and_other_clocks_go_on(tmp_path):
    run(toy_recipe("toy", steps=2), tmp_path)
    grown = toy_recipe("toy", steps=5, workers=1, checkpoint_minutes=3.0)
    run(grown, tmp_path)
    assert left(tmp_path)[0] == 5
    assert json.loads((tmp_path / "recipe.json").read_text()) == resolved(grown)


def test_minutes_end_the_run_over_all_sittings(tmp_path, monkeypatch):
    recipe = toy_recipe("toy", steps=10**9, minutes=0.03)
    monkeypatch.setattr(Denoise, "before_step", interrupt_at(1))
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run(recipe, tmp_path)
    first = load_checkpoint(tmp_path)[0]
    assert first.step == 2 and 0 < first.seconds < time.monotonic() - began
    monkeypatch.setattr(Denoise, "before_step", None)
    run(recipe, tmp_path)
    progress = load_checkpoint(tmp_path)[0]
    assert 2 < progress.step < 10**9
    assert 1.8 <= progress.seconds < time.monotonic() - began
    curves = sorted(tmp_path.glob("tensorboard/*"))
    run(recipe, tmp_path)  # nothing is left to do
    assert load_checkpoint(tmp_path)[0] == progress and sorted(tmp_path.glob("tensorboard/*")) == curves


def test_time_of_earlier_sittings_counts(tmp_path, monkeypatch):
    recipe = toy_recipe("toy", minutes=60)
    monkeypatch.setattr(Denoise, "before_step", interrupt_at(5))
    with pytest.raises(KeyboardInterrupt):
        run(recipe, tmp_path)
    (state,) = tmp_path.glob("checkpoints/*/state.json")
    state.write_text(json.dumps(json.loads(state.read_text()) | {"seconds": 4000.0}))
    run(recipe, tmp_path)
    progress = load_checkpoint(tmp_path)[0]
    assert progress.step == progress.finished == 6 and progress.seconds > 4000


def test_sigterm_saves_and_leaves(tmp_path, monkeypatch):
    monkeypatch.setattr(Denoise, "before_step", interrupt_at(6, signal.SIGTERM))
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        run(toy_recipe("toy"), tmp_path)
    assert left(tmp_path)[0] == 7
    assert signal.getsignal(signal.SIGTERM) is handler


def test_a_run_leaves_weights_previews_and_curves(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "lidar2pano"):
        run(toy_recipe("toy", preview_minutes=0.00001), tmp_path)
    weights, averaged = left(tmp_path)[1], "average/generator/layers.0.weight"
    for name in ("generator", "generator.last"):
        model, card = load(tmp_path / "weights" / f"{name}.safetensors", expect="toy")
        assert (card.recipe, card.steps, card.settings["outputs"], card.licence) == ("toy", 12, 3, "none")
        assert card.commit and card.hours >= 0 and "cpu" in card.device
        ours = model.state_dict()["layers.0.weight"]
        assert torch.allclose(ours, weights[averaged], atol=1e-3)
        assert not torch.allclose(ours, weights["network/generator/layers.0.weight"], atol=1e-3)
    assert set(load(tmp_path / "weights/generator.safetensors")[1].score) == {"score", "split", "looks"}
    previews = sorted((tmp_path / "preview").iterdir())
    assert len(previews) > 1 and previews[-1].name == "0000012-grey.png"
    assert (np.asarray(Image.open(previews[-1])) == np.full((4, 5, 3), 128)).all()
    curves = b"".join(path.read_bytes() for path in (tmp_path / "tensorboard").iterdir())
    assert all(name in curves for name in (b"generator", b"rate/generator", b"val/score", b"grey"))
    assert any("12/12" in line for line in caplog.messages)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["000000012"]


def test_the_best_weights_stay_when_later_ones_are_worse(tmp_path, monkeypatch):
    monkeypatch.setattr(Denoise, "scores", [float("nan"), 0.25, 0.75, 0.5, *[0.1] * 50])
    monkeypatch.setattr("lidar2pano.train.engine.VALIDATION_SHARE", 1.0)  # after every step
    run(toy_recipe("toy", validate_minutes=1e-9), tmp_path)
    best, last = (load(tmp_path / "weights" / f"generator{end}.safetensors")[1] for end in ("", ".last"))
    assert best.score["score"] == 0.75 and best.steps < last.steps == 12
    progress = load_checkpoint(tmp_path)[0]
    assert progress.best == 0.75
    assert best.score["looks"] == 3 < progress.looks  # the third of the scores above is the best


def test_a_loss_that_is_not_finite_leaves_the_last_checkpoint(tmp_path, monkeypatch):
    def breaks(self, batch):
        self.begin()
        loss = (self.networks["generator"](batch.noisy) - batch.image).square().mean()
        yield "generator", loss * (float("nan") if self.calls > 8 else 1.0)

    monkeypatch.setattr(Denoise, "updates", breaks)
    monkeypatch.setattr("lidar2pano.train.engine.SAVING_SHARE", 1.0)  # a checkpoint after every step
    with pytest.raises(FloatingPointError, match="generator is not finite near step 9; the last checkpoint is sound"):
        run(toy_recipe("toy", checkpoint_minutes=1e-9), tmp_path)
    step, tensors = left(tmp_path)
    assert step == 8 and all(value.isfinite().all() for value in tensors.values())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"device": "gpu"}, "no device 'gpu'"),
        ({"devices": 3}, "batch=4 cannot be divided among 3 devices.*multiple of 3"),
    ],
)
def test_devices_that_cannot_be(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        train(toy_recipe("toy"), Path(), tmp_path, **settings)


def test_a_launcher_with_another_count_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(InputError, match="started 4 processes"):
        run(toy_recipe("toy"), tmp_path)


def test_weights_that_diverge_are_not_released(tmp_path, monkeypatch):
    monkeypatch.setattr("lidar2pano.train.recipe.LARGEST_RATE", 1e31)
    recipe = override(toy_recipe("toy", validate_minutes=1e-9, steps=3), "networks.generator.optimizer.rate=1e30")
    recipe = override(override(recipe, "networks.generator.optimizer.clip=0"), "networks.generator.optimizer.warmup=0")
    with pytest.raises(FloatingPointError, match="is not finite .* step [123]; the last checkpoint is sound"):
        run(recipe, tmp_path)


def test_a_recipe_that_took_no_step_binds_no_later_run(tmp_path, monkeypatch):
    monkeypatch.setattr(Denoise, "before_step", refuse)
    with pytest.raises(InputError, match="columns"):
        run(toy_recipe("toy", steps=2), tmp_path)
    assert (tmp_path / "recipe.json").exists()
    monkeypatch.setattr(Denoise, "before_step", None)
    run(toy_recipe("toy", steps=1), tmp_path)
    assert left(tmp_path)[0] == 1


def refuse(_):
    raise InputError("options.columns cannot be used")


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(Denoise, "__init__", lambda *_: pytest.fail("the task was made"))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is a file; name a folder"):
        run(toy_recipe("toy"), tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"):
        run(toy_recipe("toy"), tmp_path / "file" / "run")


@pytest.mark.parametrize("change", ["absent", "shape", "optimizer"])
def test_a_checkpoint_of_other_networks_is_refused(tmp_path, change):
    recipe = toy_recipe("toy", steps=2)
    run(recipe, tmp_path)
    progress, weights, optimizers = load_checkpoint(tmp_path)
    key = "network/generator/layers.0.weight"
    if change == "absent":
        del weights[key]
    elif change == "shape":
        weights[key] = weights[key][:1]
    else:
        optimizers = {"generator": {"state": 3}}
    save_checkpoint(tmp_path, progress, weights, optimizers)
    with pytest.raises(InputError, match="does not fit the recipe's networks .*; remove it to start again") as refusal:
        run(toy_recipe("toy", steps=3), tmp_path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("takes_s", "validated"), [(0.5, [5, 10, 12]), (2.0, [5, 12]), (100.0, [5, 12])])
def test_validations_take_their_share_of_the_time(tmp_path, monkeypatch, takes_s, validated):
    """After one of 2 s there is none for 2 / 0.15 - 2 = 11.3 s, however often they are wanted."""
    seconds = [0.0]

    def slow(self):
        seconds[0] += takes_s
        steps.append(self.calls)
        return {"score": 0.0}

    def a_second(_):
        seconds[0] += 1.0

    steps: list[int] = []
    monkeypatch.setattr("lidar2pano.train.engine.clock", lambda used: lambda: used + seconds[0])
    monkeypatch.setattr(Denoise, "validate", slow)
    monkeypatch.setattr(Denoise, "before_step", a_second)
    run(toy_recipe("toy", steps=12, validate_minutes=5 / 60), tmp_path)
    assert steps == validated
