"""The scene painter's losses, on a made-up batch with small networks and random features."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from lidar2pano.appearance.cars import WholeCars
from lidar2pano.appearance.painter_inputs import OPENINGS, framed, twice
from lidar2pano.data.frames import IGNORE
from lidar2pano.losses import PatchStatistics
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.train import scene_painting
from lidar2pano.train.painter_recipes import ScenePaintingOptions
from lidar2pano.train.painting_frames import PaintingSample
from lidar2pano.train.scene_painting import (
    BUILDING,
    MATCHED,
    ROAD,
    SPREAD,
    VEGETATION,
    ScenePainting,
    teacher_of,
)
from lidar2pano.views import VIEWS

WIDTHS = (4, 6, 8, 10)


class RandomFeatures(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        inputs = (3, *WIDTHS)
        strides = (4, 2, 2, 2)
        layers = zip(inputs, WIDTHS, strides, strict=False)
        self.layers = nn.ModuleList([nn.Conv2d(one, other, 3, step, 1) for one, other, step in layers])
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> list[Tensor]:
        found = []
        for layer in self.layers:
            x = torch.relu(layer(x))
            found.append(x)
        return found


@pytest.fixture
def task() -> ScenePainting:
    torch.manual_seed(0)
    one = object.__new__(ScenePainting)
    one.view, one.options, one.looks = VIEWS["panorama"].scaled(0.5), ScenePaintingOptions(columns=64), ("day", "real")
    one.features = RandomFeatures()
    one.statistics = PatchStatistics(2, WIDTHS[:MATCHED])
    painter = build("scene-painter", looks=one.looks, widths=(8, 12, 16, 8))
    one.unread, one.teacher = painter.unread, None
    one.networks = {"painter": painter, "critic": build("projected-critic", features=WIDTHS, mixed=8, width=8)}
    return one


@pytest.fixture
def batch() -> PaintingSample:
    """Two samples of one crop each: sky above, road below, coloured accordingly."""
    torch.manual_seed(1)
    rows, columns = 32, 64
    labels = torch.ones(2, 1, rows, columns, dtype=torch.int64)
    labels[:, :, :12] = 15
    image = torch.full((2, 1, 3, 2 * rows, 2 * columns), -0.3)
    image[..., :24, :] = 0.8
    return PaintingSample(
        segments=nn.functional.one_hot(labels, 16).movedim(-1, 2).half() * 0.8 + 0.2 / 16,
        depth_m=torch.full((2, 1, rows, columns), 9.0),
        channels=torch.rand(2, 1, 5, rows, columns),
        labels=labels,
        image=image,
        valid=torch.ones(2, 1, 2 * rows, 2 * columns, dtype=torch.bool),
        look=torch.tensor([[0], [1]]),
        tone=torch.zeros(2, 1, 3),
        openings=torch.zeros(2, 1, rows, columns),
        class_tones=torch.zeros(2, 1, 16, 3),
        class_means=torch.full((2, 1, 16, 3), torch.nan),
    )


def test_the_painter_learns_what_the_scene_looks_like(task, batch):
    task.view = replace(task.view, rows=32)
    optimizers = {name: torch.optim.Adam(network.parameters(), 5e-3) for name, network in task.networks.items()}
    course = []
    for _ in range(25):
        names = []
        with torch.autocast("cpu", torch.bfloat16):  # as Fabric does
            for name, loss in task.updates(batch):
                names.append(name)
                for optimizer in optimizers.values():
                    optimizer.zero_grad()
                loss.backward()
                optimizers[name].step()
        assert names == ["critic", "painter"]
        course.append(float(task.logs["pixels"]))
    assert course[-1] < 0.5 * course[0]


def test_unknown_pixels_have_no_loss(task, batch):
    task.view = replace(task.view, rows=32)
    task.options = replace(task.options, adversarial=0.0)
    blind = batch._replace(valid=torch.zeros_like(batch.valid))
    ((name, loss),) = list(task.updates(blind))
    assert name == "painter" and loss.item() == 0


def test_walls_with_invented_openings_need_not_be_equal(task, batch):
    flat = batch.flat()
    flat.openings[0] = torch.nan
    segments = torch.zeros(2, 16, 32, 64)
    segments[:, BUILDING, :, :32] = 1
    nothing = torch.zeros(2, 32, 64)
    known, share, invented = task._counted(flat, segments, twice(nothing), everywhere := flat.valid).unbind(1)
    assert torch.equal(known, flat.valid.float()) and not invented.any()
    assert torch.allclose(share[0, :, :64], torch.tensor(task.options.on_invented)) and (share[0, :, 64:] == 1).all()
    assert (share[1] == 1).all(), "here they are known"
    nothing[1, 10:20] = 1
    _, share, invented = task._counted(flat, segments, twice(nothing), everywhere).unbind(1)
    assert torch.allclose(share[1, 20:40], torch.tensor(task.options.on_invented)) and (share[1, 40:] == 1).all()
    assert (invented[1, 20:40] == 1).all() and not invented[1, 40:].any() and not invented[0].any()
    _, share, _ = task._counted(flat, segments, 0 * twice(nothing), ~everywhere).unbind(1)
    assert (share == 1).all(), "a teacher's picture has the openings that were invented"


def test_a_teachers_image_is_learned_where_no_camera_looked(task, batch):
    flat = batch.flat()._replace(tone=torch.full((2, 3), 0.3))
    flat.valid[:, :, 64:] = False
    inputs = torch.rand(2, 31, 32, 64), torch.rand(2, 3, 64, 128)
    untaught, photographed = task._taught(flat, inputs)
    assert untaught is flat and photographed.all()
    painter = build("scene-painter", looks=task.looks, widths=(8, 12, 16, 8)).eval()
    task.teacher = painter
    task.options = replace(task.options, teacher_probability=0.0)
    with torch.no_grad():
        taught, photographed = task._taught(flat, inputs)
        expected = painter(*framed(*inputs), torch.eye(2), flat.tone)
        assert torch.equal(photographed, flat.valid) and taught.valid.all()
        assert torch.equal(taught.image[..., :64], flat.image[..., :64])
        assert torch.allclose(taught.image[..., 64:], expected[..., 64:])
        assert torch.equal(taught.look, flat.look) and torch.equal(taught.tone, flat.tone)
        task.options = replace(task.options, teacher_probability=1.0)
        taught, photographed = task._taught(flat, inputs)
        assert not photographed.any() and not taught.tone.any()
        assert torch.allclose(taught.image, painter(*framed(*inputs), torch.eye(2)[taught.look], taught.tone))


def test_drawn_crops_have_whole_cars_and_invented_tones(task, batch, monkeypatch):
    def with_cars(scene):
        segments = scene.probabilities
        assert scene.view.columns == segments.shape[3] and scene.T_world_sensor.shape == (4, 4)
        return WholeCars(segments * 0 + 0.5, scene.depth_m + 1, segments[:, :3] * 0 + 0.25)

    monkeypatch.setattr(scene_painting, "with_cars", with_cars)
    task.view = replace(task.view, rows=32)
    flat = batch.flat()
    segments = torch.rand(2, 16, 32, 64)
    drawn = torch.tensor([False, True])[:, None, None]
    found, used, tones = task._with_cars(flat, segments, drawn, *task._somewhere(segments))
    assert torch.equal(used[0], segments[0]) and (used[1] == 0.5).all()
    assert torch.equal(found.depth_m[0], flat.depth_m[0]) and torch.equal(found.depth_m[1], flat.depth_m[1] + 1)
    expected = task._tones(flat, segments)
    assert torch.equal(tones[0].nan_to_num(9), expected[0].nan_to_num(9)) and (tones[1] == 0.25).all()


def test_invented_houses_and_cars_are_hardly_compared(task, batch):
    task.options = replace(task.options, invented_probability=1.0, ground_truth_probability=1.0, on_invented=0.0)
    task.view = replace(task.view, rows=32)
    batch.labels[:], batch.class_means[:] = BUILDING, 0.5
    list(task.updates(batch))
    assert float(task.logs["perceptual"]) == 0 and float(task.logs["pooled"]) == 0 and float(task.logs["pixels"]) == 0
    assert float(task.logs["unseen"]) > 0, "colours are near their class's, as where no camera looked"
    task.options = replace(task.options, invented_probability=0.0)
    list(task.updates(batch))
    assert float(task.logs["perceptual"]) > 0 and float(task.logs["pooled"]) > 0 and float(task.logs["pixels"]) > 0


@pytest.mark.parametrize("bilinear", [False, True])
def test_a_teacher_enlarges_as_its_student(bilinear, tmp_path):
    settings = {"looks": ["day"], "widths": [8, 12, 16, 8]}
    card = Card(network="scene-painter", settings={**settings, "bilinear": not bilinear})
    save(tmp_path / "teacher.safetensors", build(card.network, **card.settings), card)
    student = build("scene-painter", **settings, bilinear=bilinear)
    assert teacher_of(student, str(tmp_path / "teacher.safetensors")).network.bilinear == bilinear


def test_known_openings_are_painted_and_others_are_invented(task, batch, monkeypatch):
    given = []
    inputs = scene_painting.painter_inputs
    monkeypatch.setattr(scene_painting, "painter_inputs", lambda *a, **k: given.append(inputs(*a, **k)) or given[-1])
    task.view = replace(task.view, rows=32)
    flat = batch.flat()
    flat.openings[:] = torch.rand(2, 32, 64)
    flat.openings[1] = torch.nan
    segments = torch.zeros(2, 16, 32, 64)
    segments[:, BUILDING] = 1
    window, pose = task._somewhere(segments)
    task.inputs(flat, segments, task._tones(flat, segments), window, pose)
    ((trained, _),) = given
    assert torch.equal(trained[0, -1], flat.openings[0])
    assert trained[1, -1].isfinite().all()


def test_a_car_has_the_tone_of_the_image_nearby(task, batch, monkeypatch):
    monkeypatch.setattr(scene_painting, "NEARBY", dict.fromkeys(scene_painting.NEARBY, (3, 3, 3)))  # drawn at random
    task.view = replace(task.view, rows=32)
    flat = batch.flat()
    flat.labels[:] = 7
    flat.labels[:, 12:20, 10:30], flat.labels[:, 12:20, 40:50] = 1, 1
    flat.image[:] = 0.1
    flat.image[:, :, 24:40, 20:60] = torch.tensor([0.5, -0.2, 0.0])[:, None, None]
    flat.valid[:, :, 80:] = False
    flat.class_means[:, 1], flat.class_tones[:, 7], flat.class_tones[:, 1] = -0.4, 0.3, 5.0
    segments = nn.functional.one_hot(flat.labels, 16).movedim(-1, 1).float()
    found = task._tones(flat, segments)
    assert torch.allclose(found[:, :, 12:20, 10:30], torch.tensor([0.9, 0.2, 0.4])[:, None, None], atol=1e-5)
    assert found[:, :, 12:20, 40:50].isnan().all(), "no camera looked there"
    assert torch.allclose(found[:, :, 22:], torch.tensor(0.3))
    flat.class_means[:, 1] = torch.nan
    assert task._tones(flat, segments)[:, :, 12:20, 10:30].isnan().all(), "the look's mean car is not known"
    inputs, _ = task.inputs(flat, segments, task._tones(flat, segments), *task._somewhere(segments))
    assert inputs.isfinite().all(), "they are invented"


def test_a_tree_has_the_tone_of_the_image_nearby_and_elsewhere_that_of_all_trees(task, batch, monkeypatch):
    monkeypatch.setattr(scene_painting, "NEARBY", dict.fromkeys(scene_painting.NEARBY, (3, 3, 3)))
    task.view = replace(task.view, rows=32)
    flat = batch.flat()
    flat.labels[:, :, :30] = VEGETATION
    flat.image[:] = 0.1
    flat.image[:, :, 24:40, 20:40] = torch.tensor([0.5, 0.7, 0.0])[:, None, None]
    flat.valid[:, :, 80:] = False
    flat.class_means[:, VEGETATION], flat.class_tones[:, VEGETATION] = -0.2, 0.15
    labels = flat.labels.index_fill(2, torch.arange(40, 64), VEGETATION)
    segments = nn.functional.one_hot(labels, 16).movedim(-1, 1).float()
    found = task._tones(flat, segments)
    assert torch.allclose(found[:, :, 15:17, 14:16], torch.tensor([0.7, 0.9, 0.2])[:, None, None], atol=1e-5)
    assert torch.allclose(found[:, :, 24:, :6], torch.tensor(0.3))
    assert torch.allclose(found[:, :, :, 48:], torch.tensor(0.15)), "no camera looked there"
    drawn = torch.ones(2, 1, 1, dtype=torch.bool)
    _, _, tones = task._with_cars(flat, segments, drawn, *task._somewhere(segments))
    assert torch.equal(tones[:, :, :, :20], found[:, :, :, :20]), "what stands in the sun there is in the photograph"


def test_lines_are_streaks_on_roads_unless_an_image_has_them_and_in_panes(task, batch):
    flat = batch.flat()
    inputs = torch.zeros(2, 31, 32, 64), torch.zeros(2, 3, 64, 128)
    painted = flat.image.clone()
    painted[:, :, 50:54, 20:100] = 0.5
    inputs[0][:, ROAD, 16:] = 1
    assert task._streaks(flat, inputs, painted) > 0.02
    assert task._streaks(flat._replace(image=painted), inputs, painted) == 0
    assert task._streaks(flat._replace(valid=flat.valid & False), inputs, painted) == 0
    inputs[0][:, ROAD], inputs[0][:, OPENINGS, 16:] = 0, 1
    assert task._streaks(flat._replace(image=painted), inputs, painted) > 0.02
    inputs[0][:, OPENINGS] = 0
    assert task._streaks(flat, inputs, painted) == 0


def test_streaks_count_where_they_have_a_weight(task, batch, monkeypatch):
    monkeypatch.setattr(ScenePainting, "_streaks", lambda _task, _batch, _inputs, painted: 0 * painted.mean() + 0.5)
    task.view = replace(task.view, rows=32)
    list(task.updates(batch))
    assert "streaks" not in task.logs
    task.options = replace(task.options, streaks=1e6)
    name, loss = list(task.updates(batch))[-1]
    assert name == "painter" and loss.item() == pytest.approx(0.5e6, rel=0.01)


def test_ground_truth_is_painted_where_it_is_known_and_drawn(task, batch):
    half = batch._replace(labels=batch.labels.clone()).flat()
    half.labels[:, 20:] = IGNORE
    task.options = replace(task.options, ground_truth_probability=1.0, sharpest=1.0)
    segments = task.segments(half)
    assert torch.equal(segments[:, :, :20].max(1).values, torch.ones(2, 20, 64))
    assert torch.allclose(segments[:, :, 20:], half.segments[:, :, 20:].float(), atol=1e-3)
    task.options = replace(task.options, ground_truth_probability=0.0)
    assert torch.allclose(task.segments(half), half.segments.float(), atol=1e-3)


def test_both_images_and_the_condition_are_augmented_alike(task, batch):
    task.options = replace(task.options, augment_probability=1.0)
    image = batch.flat().image
    condition, beside = torch.rand(2, 17, 32, 64), torch.rand(2, 2, 64, 128)
    torch.manual_seed(4)
    real, fake, changed, _ = task._augmented(image, image.clone().requires_grad_(), condition, beside)
    assert torch.equal(real, fake) and not torch.equal(real, image)
    assert fake.requires_grad and not changed.requires_grad
    cut = (changed == 0).all(1)
    assert cut.any() and not cut.all()
    assert torch.equal((fake == 0).all(1), cut), "cut out of both at the same place"


def test_where_no_camera_looked_colours_are_drawn_to_their_classes(task, batch):
    """By hand: cars are painted 0.3 where they are -0.3 + 0.1 on average; the sky's colour is not known.

    Single pixels count beyond SPREAD: they are 0.5 away, so that 0.1 comes to the square of 0.5.
    """
    flat = batch.flat()
    flat.class_means[:, 1] = -0.3
    flat.valid[:, 32:] = False
    tones = torch.full((2, 3, 32, 64), 0.1)
    segments = torch.zeros(2, 16, 32, 64)
    segments[:, 15, :24], segments[:, 1, 24:] = 1, 1
    painted = torch.full((2, 3, 64, 128), 0.3)
    assert task._unseen(flat, segments, tones, painted).item() == pytest.approx(0.25 + 0.5 - SPREAD, abs=1e-6)
    flat.valid[:] = True
    assert task._unseen(flat, segments, tones, painted).item() == 0


def test_one_bright_pixel_that_no_camera_saw_costs_something(task, batch):
    flat = batch.flat()
    flat.class_means[:, 1], flat.valid[:] = 0.0, False
    segments = torch.zeros(2, 16, 32, 64)
    segments[:, 1] = 1
    painted = torch.zeros(2, 3, 64, 128)
    painted[0, 1, 50, ::2], painted[0, 1, 50, 1::2] = 1, -1  # pooled colours are as they should be
    spots = task._unseen(flat, segments, torch.zeros(2, 3, 32, 64), painted).item()
    assert spots == pytest.approx(128 * (1 - SPREAD) / painted.numel(), rel=1e-4)


def test_remission_is_that_of_other_sensors_or_none(task, batch):
    flat = batch.flat()
    flat.channels[:] = 0.5
    before = flat.channels.clone()
    assert torch.equal(task._scanned(flat), before)
    task.options = replace(task.options, remission_scale=0.3)
    found = task._scanned(flat)
    assert torch.equal(found[:, :4], before[:, :4]) and torch.equal(flat.channels, before)
    assert (found[:, 4] >= 0.35).all() and (found[:, 4] <= 0.65).all() and found[:, 4].flatten(1).std(1).max() == 0
    assert len(found[:, 4].unique()) == 2, "each crop has its own"
    task.options = replace(task.options, remission_drop_probability=1.0)
    found = task._scanned(flat)
    assert not found[:, [0, 4]].any(), "nothing was measured"
