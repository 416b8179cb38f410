"""A look from images without scans: on which raster they lie, what is compared, and a run from files to a panorama."""

from __future__ import annotations

from dataclasses import replace
from math import radians, tan

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data.frames import IGNORE
from lidar2pano.data.layouts import frames_of
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import camera_in_panorama
from lidar2pano.labels import CITYSCAPES, COMMON15
from lidar2pano.losses.patch_statistics import FIRST, DistributionLoss
from lidar2pano.models.card import load
from lidar2pano.models.circular import CircularConv
from lidar2pano.pipeline import load as load_pipeline
from lidar2pano.train.engine import train
from lidar2pano.train.look_painting import LookPainting, patch_classes
from lidar2pano.train.look_samples import LookSamples, level_camera
from lidar2pano.train.options import LookOptions
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.views import VIEWS
from miniature import write_data_set
from random_weights import TRANSLATOR_VIEW, write_family

ROAD, TERRAIN = COMMON15.id_of("road"), COMMON15.id_of("terrain")
FIELD_DEG = 60.0


@pytest.fixture(scope="module")
def family(tmp_path_factory):
    return write_family(tmp_path_factory.mktemp("family"))


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    return write_data_set(tmp_path_factory.mktemp("scans"))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Three images: red sky above the horizon, green road below."""
    root = tmp_path_factory.mktemp("images")
    for name in ("a", "b", "c"):
        image, ids = np.zeros((120, 200, 3), np.uint8), np.full((120, 200), CITYSCAPES.id_of("road"), np.uint8)
        image[:60, :, 0], image[60:, :, 1] = 200, 180
        ids[:60] = CITYSCAPES.id_of("sky")
        for folder, pixels in (("images", image), ("labels", ids)):
            (root / folder).mkdir(exist_ok=True)
            Image.fromarray(pixels).save(root / folder / f"{name}.png")
    return root


def recipe(family, scans, *assignments: str):
    made = recipe_named("scene-look-mini")
    wanted = [
        f"data.train=train,{scans}:train",
        f"options.weights={family}",
        "options.look=ours",
        f"options.field_of_view_deg={FIELD_DEG}",
        "options.columns=112",
        "scale=0.125",
        "training.precision=32-true",
        "training.ema=0",
        *assignments,
    ]
    for assignment in wanted:
        made = override(made, assignment)
    return made


def test_a_level_camera_sees_the_horizon_in_its_middle_and_half_its_angle_to_either_side():
    view = VIEWS["panorama"]
    camera = level_camera((400, 300), FIELD_DEG, view)
    assert camera.centre == pytest.approx(view.origin)
    focal = 200 / tan(radians(FIELD_DEG / 2))
    lookup = camera_in_panorama(view, camera)
    columns = lookup.valid.any(0).nonzero()[:, 0]
    assert (columns[-1] - columns[0] + 1).item() == pytest.approx(view.columns * FIELD_DEG / 360, abs=2)
    left = camera.K @ camera.T_camera_lidar[:3, :3] @ np.array([np.cos(0.4), np.sin(0.4), 0.0])
    assert left[:2] / left[2] == pytest.approx([199.5 - focal * tan(0.4), 149.5])
    up = camera.K @ camera.T_camera_lidar[:3, :3] @ np.array([1.0, 0.0, 0.2])
    assert up[:2] / up[2] == pytest.approx([199.5, 149.5 - focal * 0.2])


def test_images_lie_on_the_panoramas_raster(family, scans, images):
    task = LookPainting(recipe(family, scans), images)
    sample = task.dataset[0]
    assert len(task.dataset) == 3 and sample.image.shape == (3, 2 * task.view.rows, 224)
    middle = sample.labels[:, 56]
    sky, road = (middle == COMMON15.id_of("sky")).nonzero()[:, 0], (middle == ROAD).nonzero()[:, 0]
    horizon = task.view.rows * task.view.up / (task.view.up - task.view.down)
    assert sky[-1] + 1 == road[0] and abs(int(road[0]) - horizon) <= 1
    edge = 2 * int(road[0])
    assert (sample.image[0, edge - 4 : edge - 1, 112] > 0.5).all() and (
        sample.image[1, edge + 1 : edge + 4, 112] > 0.4
    ).all()
    assert (sample.labels[:, 0] == IGNORE).all() and not sample.valid[:, 0].any(), "the image is narrower than a crop"


def test_a_patch_is_of_the_class_that_most_of_it_shows():
    ids = torch.full((1, 16, 32), ROAD)
    ids[:, :, 8:] = TERRAIN
    ids[:, :, 24:28] = IGNORE
    found = patch_classes(ids, (16, 32))[0, 0]  # patches of 8 columns every 4: 0-7, 4-11, 8-15, ...
    assert found.tolist() == [ROAD, IGNORE, TERRAIN, TERRAIN, TERRAIN, IGNORE, IGNORE]
    whole = patch_classes(ids, (16, 32), whole=True)[0, 0]
    assert whole.tolist() == [ROAD, IGNORE, TERRAIN, TERRAIN, TERRAIN, IGNORE, IGNORE]
    ids[:, :, 24:28], ids[:, :, 30:] = TERRAIN, IGNORE
    assert patch_classes(ids, (16, 32))[0, 0].tolist()[-1] == TERRAIN
    assert patch_classes(ids, (16, 32), whole=True)[0, 0].tolist()[-1] == IGNORE


def test_real_and_painted_patches_need_not_come_together():
    torch.manual_seed(0)
    loss, painted = DistributionLoss(3), torch.nn.Parameter(torch.zeros(5, 3))
    for _ in range(FIRST):
        assert loss(torch.randn(7, 3) + 2, painted[:0]) == 0
    for _ in range(FIRST):
        last = loss(torch.zeros(0, 3), painted)
    last.backward()
    assert last > 0 and (painted.grad < 0).all(), "they are drawn up, to the mean of what came before"


@pytest.mark.parametrize(("splits", "reason"), [("train", "no scans"), ("{scans}:train", "no images without scans")])
def test_both_images_and_scans_are_needed(family, scans, images, splits, reason):
    options = LookOptions(look="ours", weights=str(family))
    with pytest.raises(InputError, match=reason):
        LookSamples(frames_of(images, (splits.format(scans=scans),)), load_pipeline(family, "cpu"), options, "x")


def test_the_family_has_to_be_named(family, scans, images):
    with pytest.raises(InputError, match="needs --set options.weights=FAMILY"):
        LookPainting(recipe(family, scans, "options.weights="), images)


def test_a_field_of_view_that_no_camera_has_is_refused():
    with pytest.raises(InputError, match="field_of_view_deg=180 must be"):
        LookOptions(field_of_view_deg=180.0)


def test_roads_are_drawn_to_the_colour_of_the_images_roads(family, scans, images):
    """The random painter's roads become greener than they were; what other looks paint stays."""
    torch.manual_seed(0)
    task = LookPainting(recipe(family, scans, "options.statistics=0"), images)
    sample = task.dataset[0]
    segments = torch.zeros_like(sample.segments)
    segments[ROAD] = 1
    sample = sample._replace(segments=segments, depth_m=torch.full_like(sample.depth_m, 9.0))
    batch = type(sample)(*(part[None] for part in sample))
    painter = task.networks["painter"]
    torch.manual_seed(1)  # of a painter whose roads are grey: those of others are already as colourful as tanh allows
    for part in painter.modules():
        if isinstance(part, CircularConv):
            part.reset_parameters()
    with torch.no_grad():
        painter.colour.weight *= 20  # an untrained painter hardly paints anything but grey
    optimizer = torch.optim.Adam([weight for weight in painter.parameters() if weight.requires_grad], 0.03)

    def greenness() -> float:
        with torch.no_grad():
            image = task.painted(batch)[0]
        return (image[:, 1] - image[:, 0]).mean().item()

    before = greenness()
    for _ in range(FIRST + 60):
        optimizer.zero_grad()
        ((name, loss),) = task.updates(batch)
        loss.backward()
        optimizer.step()
    assert name == "painter" and greenness() > before + 0.2
    assert task.validate()["class colours"] < 0.3


def test_a_run_gives_a_painter_that_knows_one_look_more(family, scans, images, tmp_path):
    made = replace(recipe(family, scans), training=replace(recipe(family, scans).training, steps=2, minutes=0.0))
    out = tmp_path / "run"
    train(made, images, out, device="cpu")
    painter, card = load(out / "weights" / "painter.safetensors")
    assert painter.looks == ("day", "ours") and painter.look == "ours" and card.settings["code"] == 17
    assert card.licence and card.data == f"{images.name}+{scans.name}"
    assert (out / "preview").is_dir()
    pipeline = load_pipeline(f"{family}+{out}", "cpu")
    scan = frames_of(scans, ("train",))[0].scan
    assert pipeline(scan).colour.shape == (2 * TRANSLATOR_VIEW.rows, 2 * TRANSLATOR_VIEW.columns, 3)
    assert pipeline.in_look("day").look == "day"
