"""The camera's segmenter: what it says of a picture, how it is trained and on what, and the memory that it takes."""

from __future__ import annotations

import inspect
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import default_collate

from golden_fill import fill
from lidar2pano.data.frames import IGNORE, SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.hardware import has_bfloat16
from lidar2pano.labels import CITYSCAPES
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.supervised import labelled_cross_entropy
from lidar2pano.models import build, camera_teachers
from lidar2pano.models.camera_teachers import CameraSegmenter, CameraTeacher, ImageNormalisation
from lidar2pano.models.card import Card, load, read_card, save
from lidar2pano.models.sdnet import SdNet
from lidar2pano.train.camera_segmentation import (
    PADDING_RGB,
    CameraImageDataset,
    CameraImageSample,
    CameraSegmentation,
    CameraSegmentationOptions,
    augmented,
)
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from miniature import SIZE, camera_view, write_data_set

TINY = {"classes": 19, "scales": [0.5, 1.0], "width": 4, "stem": 8, "blocks": 1, "modules": [1, 1, 1], "context": 16}
ROAD, HOUSE, SKY = 0, 2, 10  # Cityscapes train ids in the made-up pictures


@pytest.fixture
def network() -> torch.nn.Module:
    model = build("sdnet", **TINY)
    model.load_state_dict(fill(model.state_dict(), 1.3))
    return model.eval()


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Float32 whatever the device has."""
    monkeypatch.setattr(camera_teachers, "fast_arithmetic", lambda _: nullcontext())


def random_image(rows: int = 45, columns: int = 71) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


# --- what it says ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scales", [None, (1.0,), (0.5, 1.0, 2.0)])
def test_probabilities_are_the_softmax_of_the_networks_logits(network, exact, scales):
    image = random_image()
    teacher: CameraTeacher = CameraSegmenter(network=network, normalise=ImageNormalisation(), scales=scales)
    x = np.zeros((1, 3, 45, 71), np.float32)
    for channel, (mean, deviation) in enumerate([(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)]):  # R, G, B
        x[0, channel] = (image[:, :, channel] / 255 - mean) / deviation
    with torch.inference_mode():
        expected = network(torch.from_numpy(x), scales or (0.5, 1.0)).softmax(1)[0]
    given = teacher.probabilities(image)
    assert given.dtype == torch.float32 and given.shape == (19, 45, 71)
    torch.testing.assert_close(given, expected, atol=1e-5, rtol=0)
    assert expected.max(0).values.std() > 0.01  # or any answer would do
    torch.testing.assert_close(given.sum(0), torch.ones(45, 71))


@pytest.mark.skipif(not has_bfloat16(torch.device("cpu")), reason="the fast arithmetic is float32 here")
def test_fast_arithmetic_says_nearly_the_same(network, monkeypatch):
    segmenter = CameraSegmenter(network=network, normalise=ImageNormalisation())
    fast = segmenter.probabilities(random_image())
    monkeypatch.setattr(camera_teachers, "fast_arithmetic", lambda _: nullcontext())
    exact = segmenter.probabilities(random_image())
    assert 0 < (fast - exact).abs().max() < 0.1
    assert (fast - exact).abs().mean() < 0.01


def test_a_weight_file_says_how_images_are_normalised_and_looked_at(network, exact, tmp_path):
    colours = ImageNormalisation(mean=(0.1, 0.2, 0.3), deviation=(0.5, 0.6, 0.7))
    card = Card(network="sdnet", settings=TINY, labels=CITYSCAPES.name, normalisation=colours.as_dict())
    save(tmp_path / "camera.safetensors", network, card, torch.float32)
    loaded, card = load(tmp_path / "camera.safetensors", expect="sdnet")
    segmenter = CameraSegmenter.from_card(loaded, card)
    assert segmenter.normalise == colours and segmenter.scales is None
    own = CameraSegmenter(network=network, normalise=colours, scales=(0.5, 1.0))
    assert torch.equal(segmenter.probabilities(random_image()), own.probabilities(random_image()))
    assert CameraSegmenter.from_card(loaded, card, (1.0, 2.0)).scales == (1.0, 2.0)


def test_weights_of_other_labels_are_refused(network):
    card = Card(network="sdnet", settings=TINY, labels="common-15")
    with pytest.raises(InputError, match="weights of network 'sdnet' speak 'common-15', not 'cityscapes'"):
        CameraSegmenter.from_card(network, card)


@pytest.mark.parametrize(
    "image", [np.zeros((8, 9), np.uint8), np.zeros((3, 8, 9), np.uint8), np.zeros((8, 9, 3), np.float32)]
)
def test_what_is_no_rgb_image_is_refused(network, image):
    with pytest.raises(ValueError, match=r"a picture is \(h, w, 3\) uint8 RGB, got"):
        CameraSegmenter(network=network, normalise=ImageNormalisation()).probabilities(image)


def test_read_only_and_mirrored_images_are_taken_as_they_are(network):
    segmenter, image = CameraSegmenter(network=network, normalise=ImageNormalisation()), random_image()
    expected = segmenter.probabilities(image)
    image.flags.writeable = False
    assert torch.equal(segmenter.probabilities(image), expected)
    assert torch.equal(segmenter.probabilities(image[:, ::-1].copy()[:, ::-1]), expected)


MEMORY = """
from contextlib import nullcontext
import numpy as np
from lidar2pano.hardware import keep_buffers
from lidar2pano.models import build, camera_teachers
def peak():  # not ru_maxrss: a process begins with that of the one that started it
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) / 2**20
keep_buffers()
camera_teachers.fast_arithmetic = lambda _: nullcontext()
network = build("sdnet").eval()
colours = camera_teachers.ImageNormalisation()
segmenter = camera_teachers.CameraSegmenter(network=network, normalise=colours, scales=(0.5, 1.0, 2.0))
before = peak()
segmenter.probabilities(np.zeros((376, 310, 3), np.uint8))
print(before, peak())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux")
def test_a_kitti_image_at_three_scales_fits_four_gibibytes():
    """A quarter of the picture in float32, from which the whole follows: activations grow as the pixels do.

    By the quarter the whole 376 x 1241 takes 2.7 GiB; it took 2.84, and 2.12 GiB in bfloat16. By a sixteenth it would
    take 3.7 and more: small tensors leave the allocator more gaps, and what does not grow counts as often.
    """
    printed = subprocess.run([sys.executable, "-c", MEMORY], check=True, capture_output=True, text=True).stdout
    before, peak = (float(number) for number in printed.split())
    assert peak > before + 0.05  # or it measured nothing
    assert before + (peak - before) * 1241 / 310 < 4.0


# --- what it is trained on -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_data_set(tmp_path_factory.mktemp("data"))


def certain_view() -> tuple[np.ndarray, np.ndarray]:
    """The made-up image without its unlabelled strip."""
    ids, colours = camera_view()
    return ids[:, 5:], colours[:, 5:]


def class_of(image: np.ndarray) -> np.ndarray:
    """Ids that the colours of the made-up pictures stand for, IGNORE for the border's."""
    colours = {ROAD: (90, 90, 95), HOUSE: (180, 120, 90), SKY: (150, 190, 240), IGNORE: PADDING_RGB}
    distances = [np.abs(image.astype(int) - colour).sum(-1) for colour in colours.values()]
    return np.array(list(colours))[np.argmin(distances, 0)]


def test_a_plain_sample_is_the_image_with_its_ids(root):
    samples = CameraImageDataset(root, ("train", "val"), CameraSegmentationOptions(rows=8, columns=8))
    ids, colours = camera_view()
    sample = samples[3]
    assert len(samples) == 5
    assert sample.image.dtype == torch.uint8 and sample.labels.dtype == torch.int64
    assert np.array_equal(sample.image.movedim(0, 2).numpy(), colours) and np.array_equal(sample.labels.numpy(), ids)


@pytest.mark.parametrize(("scale", "allowed"), [((1.0, 1.0), 0.0), ((0.4, 2.5), 0.04)])
@pytest.mark.parametrize("crop", [(40, 90), (90, 300), (72, 235)])
def test_image_and_ids_are_changed_alike(crop, scale, allowed):
    ids, colours = certain_view()
    for seed in range(12):
        augmentation = CameraSegmentationOptions(
            rows=crop[0], columns=crop[1], scale_min=scale[0], scale_max=scale[1], colour_jitter=0.0
        )
        image, labels = augmented(colours, ids, augmentation, np.random.default_rng(seed))
        assert image.shape == (*crop, 3) and labels.shape == crop
        assert (class_of(image) != labels).mean() <= allowed  # bilinear edges are of no class
        assert set(np.unique(labels)) <= {ROAD, HOUSE, SKY, IGNORE}


def test_an_image_smaller_than_the_crop_is_padded_with_what_is_unknown():
    ids, colours = certain_view()
    _, labels = augmented(
        colours,
        ids,
        CameraSegmentationOptions(rows=144, columns=480, scale_min=0.5, scale_max=0.5),
        np.random.default_rng(0),
    )
    assert (labels != IGNORE).sum() == 36 * 118
    rows, columns = np.nonzero(labels != IGNORE)
    assert (np.ptp(rows), np.ptp(columns)) == (35, 117)


def test_crops_begin_anywhere_and_half_of_them_are_mirrored():
    ids = np.arange(5 * 7, dtype=np.uint8).reshape(5, 7)
    image = np.zeros((5, 7, 3), np.uint8)
    corners, mirrored = set(), 0
    for seed in range(300):
        _, labels = augmented(
            image,
            ids,
            CameraSegmentationOptions(rows=4, columns=5, scale_min=1.0, scale_max=1.0),
            np.random.default_rng(seed),
        )
        mirrored += labels[0, 0] > labels[0, -1]
        corners.add(int(labels[0].min()))
    assert corners == {0, 1, 2, 7, 8, 9}
    assert 120 < mirrored < 180


def test_sizes_are_drawn_from_the_whole_range():
    image, ids = np.zeros((40, 40, 3), np.uint8), np.zeros((40, 40), np.uint8)
    augmentation = CameraSegmentationOptions(rows=200, columns=200, scale_min=0.5, scale_max=2.0)
    known = [
        (augmented(image, ids, augmentation, np.random.default_rng(s))[1] == 0).sum() ** 0.5 / 40 for s in range(200)
    ]
    assert min(known) < 0.55 and max(known) > 1.95 and 1.15 < np.mean(known) < 1.35


def test_jitter_changes_colours_only():
    ids, colours = camera_view()
    plain, shifted = (
        [
            augmented(
                colours,
                ids,
                CameraSegmentationOptions(rows=SIZE[1], columns=SIZE[0], scale_min=1, scale_max=1, colour_jitter=j),
                np.random.default_rng(s),
            )
            for s in range(40)
        ]
        for j in (0.0, 0.3)
    )
    assert all(np.array_equal(one[1], other[1]) for one, other in zip(plain, shifted, strict=True))
    ratios = [other[0].mean() / one[0].mean() for one, other in zip(plain, shifted, strict=True)]
    assert 0.65 < min(ratios) < 0.8 and 1.2 < max(ratios) < 1.35


def test_a_draw_is_its_seeds(root):
    samples = CameraImageDataset(root, ("train",), CameraSegmentationOptions(rows=32, columns=64))
    one, again, other = (samples[SampleIndex(1, seed)] for seed in (5, 5, 6))
    assert one.image.shape == (3, 32, 64) and one.labels.shape == (32, 64)
    assert torch.equal(one.image, again.image) and torch.equal(one.labels, again.labels)
    assert not torch.equal(one.image, other.image)


def test_labels_of_another_size_are_reported(tmp_path):
    root = write_data_set(tmp_path)
    path = root / "sequences/00/camera_labels/000001.png"
    Image.fromarray(np.zeros((9, 10), np.uint8)).save(path)
    with pytest.raises(InputError, match=r"camera_labels/000001.png: is 10x9 and its image 240x72; label the image"):
        CameraImageDataset(root, ("train",), CameraSegmentationOptions(rows=8, columns=8))[1]


def test_real_images_and_their_labels_fit(kitti_mini):
    samples = CameraImageDataset(kitti_mini, ("val",), CameraSegmentationOptions(rows=8, columns=8))
    sizes = {samples.pair(index)[1].shape for index in range(len(samples))}  # refuses pairs that do not fit
    assert len(sizes) > 1
    assert set(np.unique(samples.pair(0)[1])) <= {*range(len(CITYSCAPES)), IGNORE}


# --- how it is trained -----------------------------------------------------------------------------------------------


def small(*further: str) -> Recipe:
    """The small recipe with a network and crops for a test."""
    recipe = recipe_named("sdnet-mini")
    recipe = replace(recipe, networks={"camera": replace(recipe.networks["camera"], settings=TINY)})
    steps = ["training.steps=1", "training.batch=2", "training.precision=32-true"]
    for assignment in ["options.rows=48", "options.columns=96", *steps, *further]:
        recipe = override(recipe, assignment)
    return recipe


def prepared(root: Path, *further: str) -> tuple[CameraSegmentation, CameraImageSample]:
    task = build_task(small(*further), root)
    assert isinstance(task, CameraSegmentation)
    return task, default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])


def test_the_loss_is_joint_auxiliary_each_and_lovasz(root):
    task, batch = prepared(root, "options.auxiliary=0.4", "options.per_scale=0.05", "options.lovasz=0.7")
    network = task.networks["camera"].eval()
    network.training = True  # itself alone: the same answers twice
    answers = network(ImageNormalisation()(batch.image))
    expected = 0.7 * lovasz_softmax(answers.joint.softmax(1), batch.labels)
    for weight, logits in [(1, answers.joint), (0.4, answers.auxiliary), *((0.05, each) for each in answers.each)]:
        expected = expected + weight * slow_entropy(logits, batch.labels)
    ((name, loss),) = task.updates(batch)
    assert name == "camera" and len(answers.each) == 2
    torch.testing.assert_close(loss, expected)


def slow_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """Minus the mean logarithm of the right class's probability, over the pixels that have a class."""
    total, count = torch.zeros((), dtype=torch.float64), 0
    for b, i, j in np.argwhere(labels.numpy() != IGNORE):
        total = total - logits[b, :, i, j].double().log_softmax(0)[labels[b, i, j]]
        count += 1
    return (total / count).float()


def test_unknown_pixels_teach_nothing():
    logits, labels = torch.randn(1, 19, 4, 6, requires_grad=True), torch.randint(19, (1, 4, 6))
    labels[0, :, :2] = IGNORE
    torch.testing.assert_close(labelled_cross_entropy(logits, labels, IGNORE), slow_entropy(logits, labels))
    nothing = labelled_cross_entropy(logits, torch.full_like(labels, IGNORE), IGNORE)
    nothing.backward()
    assert nothing == 0 and logits.grad is not None and not logits.grad.any()


def test_the_loss_falls(root):
    task, batch = prepared(root)
    optimizer = torch.optim.AdamW(task.networks["camera"].parameters(), lr=3e-3)
    losses = []
    for _ in range(12):
        ((_, loss),) = task.updates(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]


def test_what_is_released_labels_images(root, tmp_path):
    train(small(), root, tmp_path / "run", device="cpu")
    path = tmp_path / "run/weights/camera.safetensors"
    card = read_card(path)
    assert card.recipe == "sdnet-mini" and card.labels == "cityscapes" and card.score["split"] == "val"
    assert 0 <= card.score["miou"] <= 1 and 0 <= card.score["accuracy"] <= 1
    _, colours = camera_view()
    given = CameraSegmenter.from_card(*load(path, expect="sdnet")).probabilities(colours)
    assert given.shape == (19, *colours.shape[:2])
    previews = sorted((tmp_path / "run/preview").glob("*-camera-01-00000?.png"))
    assert [np.array(Image.open(file)).shape for file in previews] == [(3 * SIZE[1], SIZE[0], 3)] * 2


def test_validation_scores_every_known_pixel_and_previews_show_them(root):
    task, _ = prepared(root)
    ids, colours = camera_view()

    class Knowing(torch.nn.Module):
        """Says house everywhere but in the upper rows, where it knows the sky."""

        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(()))

        def forward(self, images: Tensor, scales: object) -> Tensor:
            logits = torch.zeros(len(images), 19, *images.shape[2:])
            logits[:, HOUSE], logits[:, SKY, :12] = 1, 2
            return logits

    task.networks["camera"] = Knowing()
    house, road, known = (ids == HOUSE).sum(), (ids == ROAD).sum(), (ids != IGNORE).sum()
    scores = task.validate()
    assert scores["accuracy"] == pytest.approx(1 - road / known)
    assert scores["miou"] == scores["score"] == pytest.approx((1 + house / (house + road) + 0) / 3)
    previews = task.preview()
    assert list(previews) == ["camera-01-000000", "camera-01-000001"]
    above, middle, below = np.split(previews["camera-01-000000"], 3)
    assert np.array_equal(above, colours) and np.array_equal(middle, CITYSCAPES.paint(ids))
    assert np.array_equal(below[20], np.tile(CITYSCAPES.colours[HOUSE], (SIZE[0], 1)))


def test_the_full_recipe_trains_the_published_network():
    defaults = {name: one.default for name, one in inspect.signature(SdNet).parameters.items()}
    assert dict(recipe_named("sdnet").networks["camera"].settings) == defaults
