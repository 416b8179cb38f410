"""TITAN-Net without one of its parts, and TITAN-Next: what each still sees, and what it is trained by."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.utils.data import default_collate

from lidar2pano.data.camera_pairs import FrontViewDataset, SampleParts
from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.losses import lovasz_softmax
from lidar2pano.models import build
from lidar2pano.models.card import load
from lidar2pano.scene.depth import depth_code
from lidar2pano.train.checkpoint import load_checkpoint
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import resolved
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.task import Task
from lidar2pano.train.tasks import build_task
from lidar2pano.views import VIEWS
from miniature import write_data_set
from small_recipes import FRONT, alike, small, without_chance

ABLATIONS = ["titan-no-lovasz-mini", "titan-no-range-mini", "titan-no-segments-mini"]
SIZE = (36, 120)
PROGRAM = Path(__file__).parents[1] / "support" / "small_recipes.py"


pytestmark = pytest.mark.usefixtures("small_view")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data"))


def batch_of(task: Task, size: int = 2) -> tuple:
    return default_collate([task.dataset[SampleIndex(index, index)] for index in range(size)])


# --- networks --------------------------------------------------------------------------------------------------------


def titan(**settings: object) -> nn.Module:
    torch.manual_seed(1)
    return build("titan", size=(24, 40), **settings).eval()


def test_the_networks_without_an_input_lack_its_layers_and_no_others():
    with torch.device("meta"):
        whole, blind, mute = (
            set(build("titan", **settings).state_dict()) for settings in ({}, {"channels": 0}, {"conditions": 0})
        )
        squashed = set(build("titan", picture=True).state_dict())
    assert whole - blind == {"project_z.0.weight", "project_z.0.bias"}
    assert whole - mute == {"project_cond.0.weight", "project_cond.0.bias"}
    assert blind < whole and mute < whole and squashed == whole


def test_without_an_input_its_content_does_not_matter():
    z, condition = torch.randn(1, 5, 32, 64), torch.rand(1, 20, 32, 64)
    with torch.inference_mode():
        for network, changed, bare in (
            (titan(channels=0), (2 * z, condition), (None, condition)),
            (titan(conditions=0), (z, 2 * condition), (z,)),
        ):
            assert torch.equal(network(z, condition), network(*changed))
            assert torch.equal(network(z, condition), network(*bare))
        assert not torch.equal(titan()(z, condition), titan()(-z, condition))
        assert not torch.equal(titan()(z, condition), titan()(z, condition.flip(1)))
    with pytest.raises(InputError, match="titan needs an input"):
        build("titan", channels=0, conditions=0)


def test_an_image_is_the_logits_squashed():
    z, condition = torch.randn(1, 5, 32, 64), torch.rand(1, 20, 32, 64)
    with torch.inference_mode():
        torch.testing.assert_close(titan(picture=True)(z, condition), titan()(z, condition).tanh())


def test_the_pyramid_is_a_convolution_over_all_levels_at_the_images_size():
    torch.manual_seed(0)
    network, levels = build("titan-next", width=4, size=(24, 40)).eval(), []
    for block in network.pyramid:
        block.register_forward_hook(lambda _, __, out: levels.append(out))
    images: list[Tensor] = []
    network.logits.register_forward_hook(lambda _, inputs, __: images.append(inputs[0]))
    with torch.inference_mode():
        network(torch.randn(1, 5, 32, 64), torch.rand(1, 20, 32, 64))
        grown = [interpolate(level, (24, 40), mode="bilinear", align_corners=True) for level in levels]
        weight = torch.cat([merge.weight for merge in network.merge], 1)
        slow = nn.functional.conv2d(torch.cat(grown, 1), weight, network.merge[0].bias)
    assert [tuple(level.shape[-2:]) for level in levels] == [(4, 8), (8, 16), (16, 32), (32, 64)]
    torch.testing.assert_close(images[0], slow, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("level", "depth_m"), [(-100.0, 0.0), (0.0, 10.0), (100.0, 120.0)])
def test_depths_are_bounded_and_coded_by_their_logarithm(level, depth_m):
    network = build("titan-next", width=4, size=(24, 40)).eval()
    nn.init.zeros_(network.depth[-1].weight)
    nn.init.constant_(network.depth[-1].bias, level)
    with torch.inference_mode():
        _, found_m = network(torch.randn(1, 5, 32, 64), torch.rand(1, 20, 32, 64))
    torch.testing.assert_close(found_m, torch.full((1, 24, 40), depth_m), atol=1e-4, rtol=1e-4)  # sqrt(121) - 1 is 10


# --- samples ---------------------------------------------------------------------------------------------------------


def test_front_samples_carry_what_is_wanted_and_nothing_else(root):
    plain = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], SIZE)[0]
    assert plain.camera_labels.shape == SIZE and not plain.image.numel() and not plain.depth_m.numel()
    whole = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], SIZE, SampleParts(image=True, depth=True))[0]
    assert all(
        torch.equal(getattr(plain, name), getattr(whole, name)) for name in ("lidar", "segments", "camera_labels")
    )
    assert whole.image.shape == (3, *SIZE) and whole.depth_m.shape == SIZE
    bare = FrontViewDataset(
        root, ("train",), VIEWS["titan-front-512"], SIZE, SampleParts(labels=False, image=True, depth=True)
    )[0]
    assert not bare.segments.numel() and not bare.camera_labels.numel()
    assert torch.equal(bare.image, whole.image) and torch.equal(bare.depth_m, whole.depth_m)


def test_colours_and_depths_lie_where_the_classes_are(root):
    samples = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], SIZE, SampleParts(image=True, depth=True))
    sample, road = samples[0], 7
    grey = (sample.image[0] - sample.image[2]).abs() < 0.1
    inner = slice(8, -8)  # the left edge is unsure, and edges are mixed
    assert (grey == (sample.camera_labels == road))[:, inner].float().mean() > 0.9
    frame = samples.frames[0]
    assert torch.equal(sample.depth_m, project_to_camera(frame.scan, frame.calibration, SIZE)[1])
    assert 0.02 < (sample.depth_m > 0).float().mean() < 0.6


def test_both_sides_of_a_front_sample_are_mirrored_together(root):
    samples = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], SIZE, SampleParts(image=True, depth=True))
    plain, found = samples[0], set()
    for seed in range(12):
        drawn = samples[SampleIndex(0, seed)]
        flip = torch.equal(drawn.camera_labels, plain.camera_labels.flip(-1))
        assert flip or torch.equal(drawn.camera_labels, plain.camera_labels)
        assert torch.equal(drawn.depth_m, plain.depth_m.flip(-1) if flip else plain.depth_m)
        assert torch.equal(drawn.image, plain.image.flip(-1) if flip else plain.image)
        segments = drawn.segments.flip(-1) if flip else drawn.segments
        there = segments > 0  # points may have been dropped, and some lie on the edge of a pixel
        assert (segments == plain.segments)[there].float().mean() > 0.9
        found.add((flip, bool(there.sum() < 0.95 * (plain.segments > 0).sum())))
    assert found == {(False, False), (False, True), (True, False), (True, True)}


# --- recipes and tasks -----------------------------------------------------------------------------------------------


def flat(tree: dict, above: str = "") -> dict:
    values: dict = {}
    for name, value in tree.items():
        values |= flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return values


@pytest.mark.parametrize("end", ["", "-mini"])
@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("titan-no-lovasz", {"options.lovasz": 0.0}),
        ("titan-no-range", {"networks.translator.settings.channels": 0}),
    ],
)
def test_an_ablation_differs_in_one_value_from_the_whole(name, changed, end):
    whole, other = (flat(resolved(recipe_named(one + end))) for one in ("titan", name))
    differing = {key: other[key] for key in other if key not in whole or whole[key] != other[key]}
    assert differing == {"name": name + end, **changed}
    assert set(whole) <= set(other)


def test_without_segments_all_but_the_goal_is_titans():
    for end in ("", "-mini"):
        whole, other = (recipe_named(f"{one}{end}") for one in ("titan", "titan-no-segments"))
        assert (whole.training, whole.view, whole.data) == (other.training, other.view, other.data)
        for role, theirs in (("renderer", "translator"), ("critic", "critic")):
            assert other.networks[role].optimizer == whole.networks[theirs].optimizer
        assert other.networks["critic"].settings["conditions"] == 5  # the range view: there are no segments


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablations_move_critic_and_generator_in_turn(root, name):
    task, order = build_task(small(name), root), []
    for role, loss in task.updates(batch_of(task)):
        order.append(role)
        task.networks[role].zero_grad()
        loss.backward()
        assert all(weight.grad is not None for weight in task.networks[role].parameters())
        if role != "critic":
            auxiliary = float(task.logs.get("auxiliary", 0.0))
            assert loss.item() == pytest.approx(float(task.logs["adversarial"]) + auxiliary, rel=1e-4, abs=1e-6)
    assert order == ["critic", task.released[0]]
    assert ("auxiliary" in task.logs) == (name != "titan-no-lovasz-mini")


def test_without_lovasz_the_camera_s_classes_do_not_matter(root):
    losses = {}
    for name in ("titan-mini", "titan-no-lovasz-mini"):
        with without_chance():
            torch.manual_seed(0)
            task = build_task(small(name), root)
            losses[name] = [loss.item() for _, loss in task.updates(batch_of(task))]
    critic, translator = (losses["titan-mini"][i] - losses["titan-no-lovasz-mini"][i] for i in (0, 1))
    assert critic == 0 and translator > 500  # a thousand times Lovasz of an untrained network


def test_without_segments_the_auxiliary_loss_is_the_squared_error(root):
    task = build_task(small("titan-no-segments-mini", "options.mse=3"), root)
    batch = batch_of(task)
    with without_chance():
        fake = task.networks["renderer"](batch.lidar).detach()
        list(task.updates(batch))
    assert float(task.logs["auxiliary"]) == pytest.approx(3 * (fake - batch.image).square().mean().item(), rel=1e-4)
    assert fake.shape == batch.image.shape and fake.abs().max() <= 1


def test_without_range_only_segments_are_translated(root):
    task = build_task(small("titan-no-range-mini"), root)
    task.networks["translator"].eval()
    sample = task.validation[0]
    moved = sample._replace(lidar=-sample.lidar), sample._replace(segments=sample.segments.flip(0))
    ids = task.predict(sample)
    assert torch.equal(ids, task.predict(moved[0])) and not torch.equal(ids, task.predict(moved[1]))


def test_titan_next_s_auxiliary_losses_count_where_depth_was_measured(root):
    weights = {"lovasz": 2.0, "cross_entropy": 3.0, "depth": 5.0}
    task = build_task(small("titan-next-mini", *(f"options.{name}={value}" for name, value in weights.items())), root)
    batch, order = batch_of(task), []
    with without_chance():
        torch.manual_seed(0)
        for role, loss in task.updates(batch):
            order.append(role)
            task.networks[role].zero_grad()
            loss.backward()
            assert all(weight.grad is not None and weight.grad.any() for weight in task.networks[role].parameters())
        logits, depth_m = task.networks["translator"](batch.lidar, one_hot(batch.segments))
    shares, measured = logits.softmax(1), batch.depth_m > 0
    expected = {
        "lovasz": lovasz_softmax(shares, batch.camera_labels, ignore=0),
        "cross_entropy": nn.functional.cross_entropy(logits, batch.camera_labels, ignore_index=0),
        "depth": (depth_code(depth_m) - depth_code(batch.depth_m)).abs()[measured].mean(),
    }
    assert order == ["critic", "translator"] and 0 < measured.float().mean() < 1
    for part, value in expected.items():
        assert float(task.logs[part]) == pytest.approx(value.item(), rel=1e-4), part
    assert float(task.logs["auxiliary"]) == pytest.approx(
        sum(weights[part] * value.item() for part, value in expected.items()), rel=1e-4
    )


def one_hot(segments: Tensor) -> Tensor:
    return nn.functional.one_hot(segments, 20).movedim(-1, 1).float()


def test_titan_next_scores_classes_and_depths(root):
    task = build_task(small("titan-next-mini"), root)
    task.networks["translator"].eval()
    samples = {sample.name: sample for sample in map(task.validation.__getitem__, range(2))}
    task.predict_both = lambda sample: (samples[sample.name].camera_labels, 1.25 * samples[sample.name].depth_m)
    assert task.validate() == {"score": 1.0, "miou": 1.0, "accuracy": 1.0, "depth_abs_rel": pytest.approx(0.25)}
    previews = task.preview()
    assert previews["segments"].shape == previews["depth"].shape == (4 * 68, 100, 3)


# titan-no-lovasz-mini differs from titan-mini in a weight of the loss, which no card holds
@pytest.mark.parametrize("name", ["titan-no-range-mini", "titan-no-segments-mini", "titan-next-mini"])
def test_what_is_released_says_what_it_is(root, name, tmp_path):
    recipe = small(name)
    train(recipe, root, tmp_path, device="cpu")
    role = "renderer" if name == "titan-no-segments-mini" else "translator"
    network, card = load(tmp_path / "weights" / f"{role}.safetensors")
    assert card.recipe == name and card.labels == (None if role == "renderer" else "common-14")
    assert card.views["input"] == FRONT.as_dict() and card.normalisation["mean"][0] == 12.12
    assert card.settings == {key: list(value) if isinstance(value, tuple) else value
                             for key, value in recipe.networks[role].settings.items()}  # fmt: skip
    with torch.inference_mode():
        answer = network(torch.zeros(1, 5, 32, 128), torch.zeros(1, 20, 32, 128))
    answer = answer[0] if isinstance(answer, tuple) else answer
    assert answer.shape == (1, 3 if role == "renderer" else 15, 68, 100)


# --- two processes ---------------------------------------------------------------------------------------------------


def gradients(out: Path) -> dict[str, Tensor]:
    """Per network, Adam's mean gradient after the first step: all weights in one vector."""
    found = load_checkpoint(out)
    assert found is not None
    states = {name: state["state"].values() for name, state in found[2].items()}
    return {name: torch.cat([one["exp_avg"].flatten() for one in state]) for name, state in states.items()}


def apart(one: Path, other: Path) -> float:
    """The largest difference of two runs' gradients, as a share of their length."""
    ours, theirs = gradients(one), gradients(other)
    return max(((ours[name] - theirs[name]).norm() / theirs[name].norm()).item() for name in ours)


@pytest.mark.usefixtures("one_thread")
def test_two_processes_equal_one(root, tmp_path):
    """Each sees half of the batch, as one process does in two turns; test_engine.py has a critic with a penalty."""
    name = "pix2pix-segments-mini"
    command = [sys.executable, "-W", "error", str(PROGRAM), name, str(root), str(tmp_path / "two"), "2"]
    two = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False
    )
    assert two.returncode == 0, two.stderr
    with without_chance():
        train(alike(name, "training.accumulate=2"), root, tmp_path / "one", device="cpu")
        train(alike(name, "training.batch=1"), root, tmp_path / "half", device="cpu")
    assert apart(tmp_path / "two", tmp_path / "one") < 1e-3
    assert apart(tmp_path / "two", tmp_path / "half") > 0.05  # what one process alone would have seen
