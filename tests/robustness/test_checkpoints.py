"""Training under faults: checkpoints that were tampered with, two processes in one run, killed loaders, empty scans."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from lidar2pano.data.frames import SampleIndex
from lidar2pano.data.range_images import RangeImageDataset, ScanAugmentation
from lidar2pano.errors import InputError
from lidar2pano.losses.supervised import labelled_cross_entropy
from lidar2pano.train.checkpoint import claimed
from lidar2pano.train.engine import train
from random_weights import SEGMENTER_VIEW, write_data_set
from toy_training import Denoise, NoisyImages, Sample, entries, toy_recipe


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A toy's run of two steps."""
    run = tmp_path_factory.mktemp("run") / "toy"
    with pytest.MonkeyPatch.context() as patch:
        for table, name, value in entries():
            patch.setitem(table, name, value)
        train(toy_recipe("toy", steps=2), Path(), run, device="cpu")
        yield run


def optimizers(change: Callable[[dict], object]) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        state = torch.load(folder / "optimizers.pt")
        changed = change(state)
        torch.save(changed if isinstance(changed, list) else state, folder / "optimizers.pt")

    return damage


def weights(change: Callable[[dict], object]) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        tensors = load_file(folder / "weights.safetensors")
        change(tensors)
        save_file(tensors, folder / "weights.safetensors")

    return damage


def state(text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "state.json").write_text(text)


def nan(tensors: dict) -> None:
    next(one for one in tensors.values() if one.is_floating_point()).view(-1)[0] = torch.nan


FIRST = "network/generator/layers.0.weight"
ADAM_STATE = {"step": torch.tensor(1.0), "exp_avg": torch.zeros(1), "exp_avg_sq": torch.zeros(1)}
DAMAGES = {
    "a tensor is missing": weights(lambda t: t.pop(FIRST)),
    "a tensor of another shape": weights(lambda t: t.update({FIRST: torch.zeros(3)})),
    "a weight that is no number": weights(nan),
    "cut weights": lambda folder: (folder / "weights.safetensors").write_bytes(b"\x40" + bytes(40)),
    "no weights": lambda folder: (folder / "weights.safetensors").unlink(),
    "no optimisers": lambda folder: (folder / "optimizers.pt").unlink(),
    "optimisers of another network": optimizers(lambda o: o.update(other=o.pop("generator"))),
    "optimisers that are a list": optimizers(lambda _: [1]),
    "an empty optimiser": optimizers(lambda o: o.update(generator={})),
    "moments of another shape": optimizers(lambda o: o["generator"]["state"].update({0: ADAM_STATE})),
    "moments that are texts": optimizers(lambda o: o["generator"]["state"][0].update(exp_avg="x")),
    "moments that are no numbers": optimizers(lambda o: o["generator"]["state"][0]["exp_avg"].fill_(torch.inf)),
    "moments of a weight that there is not": optimizers(lambda o: o["generator"]["state"].update({99: ADAM_STATE})),
    "a moment is missing": optimizers(lambda o: o["generator"]["state"][0].pop("exp_avg")),
    "a state that is a list": optimizers(lambda o: o["generator"].update(state=[1])),
    "steps that are text": state('{"step": "2"}'),
    "negative seconds": state('{"step": 2, "seconds": -1}'),
    "a state of deep lists": state("[" * 9999 + "]" * 9999),
}


def test_a_run_removes_its_own_older_checkpoints_and_nothing_else(finished, tmp_path, monkeypatch):
    """A process killed before it could remove the last but one leaves two; copies that a user made stay."""
    for table, name, value in entries():
        monkeypatch.setitem(table, name, value)
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    kept = ["000000001 (copy)", "000000002_good", "0x5", "mine"]
    for name in (*kept, "000000001", "000000001.old", "000000007.part"):
        shutil.copytree(run / "checkpoints" / "000000002", run / "checkpoints" / name)
    for steps in (2, 3):
        train(toy_recipe("toy", steps=steps), Path(), run, device="cpu")
        assert sorted(path.name for path in (run / "checkpoints").iterdir()) == sorted([*kept, f"{steps:09d}"])


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_checkpoint_is_an_input_error(finished, tmp_path, damage):
    run = shutil.copytree(finished, tmp_path / "run")
    (folder,) = (run / "checkpoints").iterdir()
    damage(folder)
    with pytest.raises(InputError, match="checkpoints.*remove it to start again"):
        train(toy_recipe("toy", steps=3), Path(), run, device="cpu")


def test_settings_that_an_optimiser_saved_are_not_used(finished, tmp_path):
    run = shutil.copytree(finished, tmp_path / "run")
    (folder,) = (run / "checkpoints").iterdir()
    optimizers(lambda o: o["generator"]["param_groups"][0].update(lr="a", betas=3, weight_decay="x"))(folder)
    train(toy_recipe("toy", steps=3), Path(), run, device="cpu")
    (folder,) = (run / "checkpoints").iterdir()
    assert json.loads((folder / "state.json").read_text())["step"] == 3


def test_no_link_can_be_planted_in_the_place_of_a_runs_curves(finished):
    """Their files have names that nobody can foretell."""
    (curves,) = (finished / "tensorboard").iterdir()
    assert re.search(r"\.[0-9a-f]{16}$", curves.name)


def test_a_second_process_in_a_run_is_refused_and_leaves_it_alone(finished, tmp_path):
    run = shutil.copytree(finished, tmp_path / "run")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with claimed(run), pytest.raises(InputError, match="run: another process trains into it"):
        train(toy_recipe("toy", steps=3), Path(), run, device="cpu")
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    train(toy_recipe("toy", steps=3), Path(), run, device="cpu")


@pytest.mark.parametrize("when", ["it loads", "the network learns"])
def test_a_killed_loader_is_one_line_and_the_command_goes_on(finished, tmp_path, monkeypatch, when):
    run = shutil.copytree(finished, tmp_path / "run")
    taken = NoisyImages.__getitem__

    def loaded(images: NoisyImages, at: SampleIndex) -> Sample:
        if torch.utils.data.get_worker_info():
            if not (tmp_path / "worker").exists():
                (tmp_path / "worker").write_text(str(os.getpid()))
            if when == "it loads":
                os.kill(os.getpid(), signal.SIGKILL)
        return taken(images, at)

    def killed(_: int) -> None:
        os.kill(int((tmp_path / "worker").read_text()), signal.SIGKILL)
        time.sleep(2)  # the system interrupts it

    with monkeypatch.context() as patch:
        patch.setattr(NoisyImages, "__getitem__", loaded)
        patch.setattr(Denoise, "before_step", killed)
        with pytest.raises(InputError, match="a process that prepares samples was killed"):
            train(toy_recipe("toy", steps=3, workers=1), Path(), run, device="cpu")
    train(toy_recipe("toy", steps=3), Path(), run, device="cpu")
    assert len(list((run / "checkpoints").iterdir())) == 1


def test_a_scan_without_usable_points_is_an_empty_sample(tmp_path):
    path = write_data_set(tmp_path / "data", frames=1, size=(60, 20)) / "sequences" / "00" / "velodyne" / "000000.bin"
    scan = np.fromfile(path, "<f4").reshape(-1, 4)
    scan[:, :3] = np.nan
    scan.tofile(path)
    augmentation = ScanAugmentation(chance=1.0, rings=1.0, remission=0.2)
    samples = RangeImageDataset(tmp_path / "data", ("val",), SEGMENTER_VIEW, augmentation=augmentation)
    for seed in range(3):
        sample = samples[SampleIndex(0, seed)]
        assert sample.lidar.isfinite().all() and not sample.labels.any()


def test_an_image_without_labelled_pixels_costs_nothing_instead_of_nan():
    logits, weight = torch.randn(2, 5, 4, 6, requires_grad=True), torch.rand(5) + 0.1
    labels = torch.randint(5, (2, 4, 6))
    expected = torch.nn.functional.cross_entropy(logits, labels, weight, ignore_index=0)
    torch.testing.assert_close(labelled_cross_entropy(logits, labels, 0, weight), expected)
    labels[:, :2] = 255
    expected = torch.nn.functional.cross_entropy(logits, labels, weight, ignore_index=255)
    torch.testing.assert_close(labelled_cross_entropy(logits, labels, 255, weight), expected)
    nothing = labelled_cross_entropy(logits, torch.full_like(labels, 255), 255, weight)
    nothing.backward()
    assert nothing == 0 and logits.grad is not None and not logits.grad.any()
