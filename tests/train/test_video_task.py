"""Training of the painter of videos: its losses, the order of its updates, how videos begin and what is released."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

from lidar2pano.data.clips import ClipSample
from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import warp
from lidar2pano.losses.painting import (
    LAYERS,
    least_squares_critic,
    least_squares_generator,
    masked_l1,
    matched_features,
    perceptual,
)
from lidar2pano.models import build
from lidar2pano.models.card import Card, load, save
from lidar2pano.models.frozen_features import Vgg19, read_vgg
from lidar2pano.models.vid2vid_painter import Vid2VidPainter
from lidar2pano.train.checkpoint import load_checkpoint
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import Network, Recipe, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from lidar2pano.train.video import VideoPainting, one_hot_clip
from miniature_video import write_video

LENGTH = 7
NEVER_BLANK = "options.no_previous_probability=0"
PAINTER = {"channels": 16, "widths": (8,), "downsamplings": 2, "blocks": (2, 1), "foreground": (1,)}
SMALL = [
    "scale=1.0",
    "data.train=train",
    f"options.clip_length={LENGTH}",
    "options.rows=32",
    "options.columns=48",
    "options.single_frame_splits=",
    "training.steps=1",
    "training.batch=1",
    "training.workers=0",
    "training.precision=32-true",
]


def small(*further: str) -> Recipe:
    """The mini recipe with networks and rasters small enough for a test, and critics of videos 1 and 2 frames apart."""
    recipe = recipe_named("vid2vid-mini")
    adam = recipe.networks["painter"].optimizer
    temporal_critic = Network(model="vid2vid-temporal-critic", settings={"width": 4, "layers": 2}, optimizer=adam)
    networks = {
        "painter": Network(model="vid2vid", settings={**PAINTER, "batch_statistics": True}, optimizer=adam),
        "critic": Network(
            model="vid2vid-image-critic", settings={"channels": 19, "width": 4, "layers": 2}, optimizer=adam
        ),
        "temporal_1": temporal_critic,
        "temporal_2": temporal_critic,
    }
    recipe = replace(recipe, networks=networks)
    for assignment in [*SMALL, *further]:
        recipe = override(recipe, assignment)
    return recipe


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video"), panorama=True)


def made(root, *further: str) -> VideoPainting:
    task = build_task(small(*further), root)
    assert isinstance(task, VideoPainting)
    return task


def a_batch(task: VideoPainting, size: int = 2) -> ClipSample:
    return default_collate([task.dataset[SampleIndex(0, seed)] for seed in range(size)])


# --- losses ---------------------------------------------------------------------------------------------------------


def answers(scales: int = 2, depth: int = 3) -> list[list[Tensor]]:
    return [[torch.randn(2, 3, 4 - k, 5 - k) for k in range(depth)] + [torch.randn(2, 1, 2, 2)] for _ in range(scales)]


def test_least_squares_are_those_of_the_paper():
    real, fake = answers(), answers()
    critic = generator = 0.0
    for r, f in zip(real, fake, strict=True):
        scores, others = r[-1].flatten().tolist(), f[-1].flatten().tolist()
        critic += 0.5 * sum((d - 1) ** 2 for d in scores) / len(scores) + 0.5 * sum(d**2 for d in others) / len(others)
        generator += sum((d - 1) ** 2 for d in others) / len(others)
    assert least_squares_critic(real, fake).item() == pytest.approx(critic, rel=1e-5)
    assert least_squares_generator(fake).item() == pytest.approx(generator, rel=1e-5)
    perfect = [[torch.ones(1, 1, 2, 2)]]
    assert least_squares_critic(perfect, [[torch.zeros(1, 1, 2, 2)]]) == 0 == least_squares_generator(perfect)


def test_features_are_weighted_as_published():
    real, fake = answers(), [[x.requires_grad_() for x in scale] for scale in answers()]
    layers_d = 2  # of stride 2, so that there are one more with features: published as 4 / (n_layers_D + 1), 1 / num_D
    slow = 0.0
    for r, f in zip(real, fake, strict=True):
        for one, other in zip(r[:-1], f[:-1], strict=True):
            gaps = [abs(a - b) for a, b in zip(one.flatten().tolist(), other.flatten().tolist(), strict=True)]
            slow += 4 / (layers_d + 1) / 2 * sum(gaps) / len(gaps)
    found = matched_features(real, fake)
    assert found.item() == pytest.approx(slow, rel=1e-5)
    found.backward()
    assert fake[0][0].grad is not None and fake[0][-1].grad is None, "scores are no features"


def test_masked_distances_count_every_pixel():
    one, other, known = torch.rand(2, 3, 4, 5), torch.rand(2, 3, 4, 5), (torch.rand(2, 4, 5) > 0.5).float()
    slow = 0.0
    for b in range(2):
        for c in range(3):
            for i in range(4):
                for j in range(5):
                    slow += known[b, i, j].item() * abs(one[b, c, i, j].item() - other[b, c, i, j].item())
    assert masked_l1(one, other, known).item() == pytest.approx(slow / (2 * 3 * 4 * 5), rel=1e-5)


def test_perceptual_distance_weighs_vgg_s_layers(tmp_path):
    torch.manual_seed(1)
    whole = Vgg19().state_dict() | {"classifier.0.weight": torch.zeros(2, 2)}
    torch.save(whole, tmp_path / "vgg19.pth")
    network = read_vgg(tmp_path / "vgg19.pth")
    assert not any(weight.requires_grad for weight in network.parameters())
    convs = [layer for layer in network.features if isinstance(layer, nn.Conv2d)]
    assert [(c.in_channels, c.out_channels) for c in convs[:3]] == [(3, 64), (64, 64), (64, 128)] and len(convs) == 13
    assert [f"features.{i}.weight" in whole for i in (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28)] == [True] * 13
    real, fake = torch.rand(1, 3, 32, 32), torch.rand(1, 3, 32, 32)
    ours, theirs = network(fake), network(real)
    assert [x.shape[1:] for x in ours] == [(64, 32, 32), (128, 16, 16), (256, 8, 8), (512, 4, 4), (512, 2, 2)]
    assert all((x >= 0).all() for x in ours), "after the activation"
    slow = sum(w * (a - b).abs().mean().item() for w, a, b in zip(LAYERS, ours, theirs, strict=True))
    assert perceptual(ours, theirs).item() == pytest.approx(slow, rel=1e-5)
    for content in (b"not a checkpoint", None):
        if content is None:
            torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "wrong.pth")
        else:
            (tmp_path / "wrong.pth").write_bytes(content)
        with pytest.raises(InputError, match="holds no weights of VGG-19"):
            read_vgg(tmp_path / "wrong.pth")


# --- updates --------------------------------------------------------------------------------------------------------


def test_every_frame_moves_critics_and_then_the_painter(root):
    task = made(root)
    order = []
    for role, loss in task.updates(a_batch(task)):
        order.append(role)
        for network in task.networks.values():
            network.zero_grad()
        loss.backward()
        assert loss.isfinite()
        missing = [name for name, weight in task.networks[role].named_parameters() if weight.grad is None]
        assert missing == []
    early = ["critic", "painter"]
    later = ["critic", "temporal_1", "painter"]
    assert order == early * 2 + later * 2 + ["critic", "temporal_1", "temporal_2", "painter"]
    assert set(task.logs) == {"flow", "coherence", "mask", "pixels", "adversarial", "feature_matching"}
    assert all(isinstance(value, Tensor) and value.isfinite() for value in task.logs.values())


def calls_of(network: nn.Module) -> list[tuple[Tensor, ...]]:
    """What the network is called with from now on, and what it answers, call by call."""
    calls: list[tuple[Tensor, ...]] = []
    network.register_forward_hook(lambda _, given, answer: calls.append((*given, *answer)) if len(given) > 1 else None)
    return calls


def test_the_painter_sees_its_own_last_images(root):
    task = made(root, NEVER_BLANK)
    batch = a_batch(task)
    calls = calls_of(task.networks["painter"])
    for _ in task.updates(batch):
        pass
    assert len(calls) == LENGTH - 2
    one_hot = one_hot_clip(batch)
    assert one_hot.shape == (2, LENGTH, 16, 32, 48)
    assert torch.equal(one_hot.argmax(2), batch.labels) and torch.equal(one_hot.sum(2), torch.ones(2, LENGTH, 32, 48))
    for number, (labels, previous, *_) in enumerate(calls):
        assert torch.equal(labels, one_hot[:, number : number + 3])
        assert not previous.requires_grad, "no gradient goes back in time"
    assert torch.equal(calls[0][1], batch.image[:, :2])
    assert torch.equal(calls[1][1], torch.stack([batch.image[:, 1], calls[0][2].detach()], 1))
    assert torch.equal(calls[4][1], torch.stack([calls[2][2], calls[3][2]], 1))


def test_blank_clips_begin_from_nothing_and_are_painted_again(root):
    task = made(root, "options.no_previous_probability=1")
    batch = a_batch(task)
    calls = calls_of(task.networks["painter"])
    for _ in task.updates(batch):
        pass
    assert not calls[0][1].any()
    raw = calls[0][-1]
    assert torch.equal(calls[1][1], torch.stack([torch.zeros_like(raw), raw], 1)), "as published with --no_first_img"
    assert torch.equal(calls[2][1], torch.stack([raw, calls[1][2]], 1)), "the second is a picture like any other"
    first = torch.tensor([True, False])
    frame = task.frame(batch, one_hot_clip(batch), batch.image[:, :2], 2, first)
    assert not frame.coherent[0].any() and torch.equal(frame.coherent[1], batch.known[1, 2])
    assert torch.equal(frame.fake[0], frame.raw[0]) and not torch.equal(frame.fake[1], frame.raw[1])
    assert torch.equal(frame.flow.known, batch.known[:, 2]), "the flow is asked for all the same"


def test_losses_weigh_what_the_recipe_says(root):
    task = made(
        root,
        "options.flow=3",
        "options.coherence=5",
        "options.mask=0",
        "options.pixels=7",
        NEVER_BLANK,
    )
    batch = a_batch(task, 1)
    frame = task.frame(batch, one_hot_clip(batch), batch.image[:, :2], 2, torch.tensor([False]))
    losses = task.reconstruction(frame)
    shift, known = batch.shift[:, 2], batch.known[:, 2]
    flow = masked_l1(frame.fake_flow, shift, known)
    flow += masked_l1(warp(batch.image[:, 1], frame.fake_flow), batch.image[:, 2], known)
    slow = {
        "flow": 3 * flow,
        "coherence": 5 * masked_l1(frame.fake, warp(batch.image[:, 1], shift), known),
        "pixels": 7 * sum((image - batch.image[:, 2]).abs().mean() for image in (frame.fake, frame.raw)),
    }
    assert {name: loss.item() for name, loss in losses.items()} == pytest.approx({k: v.item() for k, v in slow.items()})

    again = task.frame(batch, one_hot_clip(batch), batch.image[:, :2], 2, torch.tensor([True]))
    task.options = replace(task.options, mask=1.0)
    first = task.reconstruction(again)
    assert first["coherence"] == 0 == first["mask"], "there was no picture before it"
    assert first["flow"] > 0
    before = batch.image[:, 1].clone().requires_grad_()
    losses = task.reconstruction(frame._replace(fake_before=before))
    losses["mask"].backward(retain_graph=True)
    assert losses["mask"].item() == pytest.approx((frame.weight[:, 0] * frame.coherent).mean().item(), rel=1e-5)
    losses["coherence"].backward()
    assert before.grad is None, "no gradient goes into the image before"


def test_critics_score_the_image_and_what_is_painted_again(root):
    task = made(root, NEVER_BLANK, "options.feature_matching=2")
    batch = a_batch(task, 1)
    frame = task.frame(batch, one_hot_clip(batch), batch.image[:, :2], 2, torch.tensor([False]))
    critic = task.networks["critic"]
    real, *fakes = (
        critic(torch.cat([one_hot_clip(batch)[:, 2], image], 1)) for image in (batch.image[:, 2], frame.fake, frame.raw)
    )
    turns = task.frame_updates(frame, {})
    role, loss = next(turns)
    assert role == "critic"
    assert loss.item() == pytest.approx(sum(least_squares_critic(real, fake).item() for fake in fakes), rel=1e-4)
    role, loss = next(turns)
    slow = sum(value.item() for value in task.reconstruction(frame).values())
    slow += sum((least_squares_generator(fake) + 2 * matched_features(real, fake)).item() for fake in fakes)
    assert role == "painter" and loss.item() == pytest.approx(slow, rel=1e-4)


def test_micro_batches_in_turns_have_losses_of_their_own(root):
    task = made(root, "options.no_previous_probability=0")
    one, other = a_batch(task), default_collate([task.dataset[SampleIndex(0, 7)]])
    for _ in task.updates(other):
        pass
    expected = task.logs
    for pair in zip(task.updates(one), task.updates(other), strict=True):
        assert pair[0][0] == pair[1][0]
    assert {name: value.item() for name, value in task.logs.items()} == pytest.approx(
        {name: value.item() for name, value in expected.items()}, rel=1e-4
    )


def test_videos_are_three_images_and_the_flows_between_them(root):
    task = made(root)
    batch = a_batch(task)
    painted = [torch.full_like(batch.image[:, 0], number) for number in range(5)]  # frames 2 to 6
    real, fake = task.temporal(batch, painted, 2)
    assert real.shape == fake.shape == (2, 13, 32, 48)
    assert [fake[:, 3 * k].mean().item() for k in range(3)] == [0, 2, 4]
    assert torch.equal(real[:, :9], torch.cat([batch.image[:, now] for now in (2, 4, 6)], 1))
    assert torch.equal(real[:, 9:], fake[:, 9:])
    for place, now in ((9, 4), (11, 6)):
        shift = real[:, place : place + 2] * 20
        near = warp(batch.shift[:, now - 1], batch.shift[:, now])
        both = (shift != 0).any(1, keepdim=True)
        assert both.float().mean() > 0.5
        assert torch.allclose(shift * both, (batch.shift[:, now] + near) * both, atol=1e-4)
    known = torch.ones_like(batch.known)
    apart = torch.arange(LENGTH).float()[None, :, None, None, None].expand_as(batch.shift)
    uniform = task.temporal(batch._replace(shift=apart, known=known), painted, 2)[0][0, :, 4, 4] * 20
    assert uniform[9:].tolist() == pytest.approx([3 + 4, 3 + 4, 5 + 6, 5 + 6]), "frame 4 to 2, then 6 to 4"
    near, _ = task.temporal(batch, painted, 1)
    assert torch.allclose(near[:, 9:] * 20, torch.cat([batch.shift[:, 5], batch.shift[:, 6]], 1), atol=1e-5)


def test_the_loss_falls(root):
    task = made(root, "options.no_previous_probability=0.5", "options.flow=1")
    batch = a_batch(task, 1)
    adams = {name: torch.optim.Adam(net.parameters(), 2e-3, (0.5, 0.999)) for name, net in task.networks.items()}
    logged = []
    for _ in range(6):
        for role, loss in task.updates(batch):
            adams[role].zero_grad()
            loss.backward()
            adams[role].step()
        logged.append((task.logs["pixels"], task.logs["flow"]))
    assert logged[-1][0] < 0.8 * logged[0][0] and logged[-1][1] < logged[0][1]


# --- scoring and what is released ------------------------------------------------------------------------------------


def test_videos_begin_as_the_pipeline_s_do(root, tmp_path, monkeypatch):
    monkeypatch.setattr("lidar2pano.train.video.fast_arithmetic", lambda device: nullcontext())
    settings = {"classes": 16, "width": 4, "downsamplings": 2, "blocks": 1, "batch_statistics": True}
    single = build("vid2vid-single", **settings)
    card = Card(network="vid2vid-single", settings=settings, labels="common-15")
    save(tmp_path / "single", single, card, torch.float32)
    save(tmp_path / "other", single, replace(card, labels="cityscapes"), torch.float32)
    with pytest.raises(InputError, match="it reads cityscapes classes, not common-15"):
        made(root, f"options.first_frame_weights={tmp_path / 'other'}")
    for further in ((), (f"options.first_frame_weights={tmp_path / 'single'}",)):
        task = made(root, *further)
        network = task.networks["painter"].eval()
        clip = task.validation[0]
        images, flows = task.paint(clip)
        assert images.shape == (LENGTH, 3, 32, 48) and flows.shape == (LENGTH, 2, 32, 48)
        painter = Vid2VidPainter(network, task.first, closed=False).eval()
        past = None
        begun = slice(4)  # norms by batch statistics make rounding six times larger with every further frame
        for ids, image in zip(clip.labels[begun], images[begun], strict=True):
            with torch.inference_mode():
                past, theirs = painter.follow(past, ids)
            assert torch.allclose(theirs, image, atol=1e-4)
    given = made(root, NEVER_BLANK)
    given.networks["painter"].eval()
    assert torch.equal(given.paint(clip)[0][:2], clip.image[:2])


def test_scores_say_how_far_and_how_restless(root, monkeypatch):
    task = all_around(root)
    clip = task.validation[0]
    assert task.flicker(clip.image, clip) < 0.002, "the seam is no edge"
    assert task.flicker(torch.rand_like(clip.image) * 2 - 1, clip) > 0.1
    monkeypatch.setattr(task, "paint", lambda clip: (clip.image, clip.shift))
    ideal = task.validate()
    assert ideal["pooled_colour"] == 0 == ideal["flow_px"] and ideal["flicker"] == ideal["flicker_of_real"]
    off = torch.tensor([3.0, 4.0])[:, None, None]
    monkeypatch.setattr(task, "paint", lambda clip: (clip.image + 0.5, clip.shift + off))
    found = task.validate()
    assert found["pooled_colour"] == pytest.approx(0.25, abs=1e-4) and found["flow_px"] == pytest.approx(5, abs=1e-4)
    monkeypatch.setattr(task, "paint", lambda clip: (torch.rand_like(clip.image), clip.shift))
    noise = task.validate()
    assert noise["flicker"] > 0.1 and noise["score"] == pytest.approx(-noise["pooled_colour"] - noise["flicker"])


def test_a_run_releases_a_painter_that_says_what_it_is(root, tmp_path):
    train(small("options.no_previous_probability=0.5"), root, tmp_path, device="cpu")
    network, card = load(tmp_path / "weights/painter.safetensors", expect="vid2vid")
    assert card.labels == "common-15" and card.settings["batch_statistics"] is True
    assert card.views["panorama"]["columns"] == 4608 and card.score["split"] == "val"
    assert {"pooled_colour", "flicker", "flow_px"} <= set(card.score)
    assert [path.name for path in (tmp_path / "preview").iterdir()] == ["0000001-video.png"]
    Vid2VidPainter(network, closed=False).follow(None, torch.zeros(32, 48, dtype=torch.uint8))


def all_around(root) -> VideoPainting:
    changes = [
        "options.source=panorama",
        "scale=0.25",
        "options.rows=96",
        "options.columns=1152",
        "options.clip_length=5",
    ]
    recipe = small(*changes)
    recipe = replace(recipe, networks={role: one for role, one in recipe.networks.items() if role != "temporal_2"})
    task = build_task(recipe, root)
    assert isinstance(task, VideoPainting)
    return task


def test_the_panorama_is_painted_all_around(root):
    task = all_around(root)
    clip = task.dataset[0]
    assert clip.image.shape == (5, 3, 96, 1152) and task.framing.circular and clip.known[1:].all()
    assert task.card("painter")["views"]["panorama"]["columns"] == 1152
    real, fake = task.temporal(default_collate([clip]), [clip.image[None, now] for now in (2, 3, 4)], 1)
    assert torch.equal(real, fake)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("options.source=camra", "options.source cannot be 'camra'; did you mean 'camera'"),
        (
            "options.clip_length=6",
            "of 4 painted frames no three are 2 apart; set options.clip_length to 7 or more",
        ),
        ("options.clip_length=8", "no 8 frames of split train follow each other"),
        ("options.first_frame_weights=nowhere", "no weight file nowhere"),
        ("options.vgg_weights=nowhere", "nowhere holds no weights of VGG-19"),
    ],
)
def test_what_cannot_be_is_named(root, change, message):
    with pytest.raises(InputError, match=message):
        build_task(small(change), root)


def test_temporal_critics_are_named_by_their_step(root):
    recipe = small()
    networks = {**recipe.networks, "temporal_x": recipe.networks["temporal_1"]}
    with pytest.raises(InputError, match="temporal_x: its name must end in a number of frames"):
        build_task(replace(recipe, networks=networks), root)


@pytest.mark.usefixtures("one_thread")
def test_two_processes_equal_one_that_takes_two_turns(root, tmp_path):
    """Batch norms see one clip at a time either way; their running statistics are each process's own."""
    changes = [
        *SMALL,
        "options.clip_length=5",
        "options.no_previous_probability=1",
        "training.batch=2",
        "training.ema=0",
    ]
    changes += [f"networks.painter.settings.{name}" for name in ("widths=4", "downsamplings=2", "blocks=1,1")]
    changes += [f"networks.{role}.settings.width=4" for role in ("critic", "temporal_1")]
    recipe = recipe_named("vid2vid-mini")
    for change in [*changes, "training.accumulate=2"]:
        recipe = override(recipe, change)
    train(recipe, root, tmp_path / "one", device="cpu")
    words = [word for change in changes for word in ("--set", change)]
    command = [sys.executable, "-m", "lidar2pano", "train", "vid2vid-mini", "--data", str(root), "--device", "cpu"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "two"), "--devices", "2", *words],
        capture_output=True, text=True, check=False, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    one, two = (load_checkpoint(tmp_path / name) for name in ("one", "two"))
    assert one is not None and two is not None
    fresh = build_task(recipe, root).networks
    apart, moved = 0.0, 0.0
    for role, network in fresh.items():
        for name, weight in network.named_parameters():
            ours, theirs = (found[1][f"network/{role}/{name}"] for found in (one, two))
            apart, moved = (
                max(apart, (ours - theirs).abs().max().item()),
                max(moved, (ours - weight).abs().max().item()),
            )
    assert apart < 1e-4 < moved
