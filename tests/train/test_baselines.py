"""Pix2Pix and SC-UNET: against recorded runs, what they read, and that their recipes learn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

from golden_fill import assert_weights_as_recorded, fill, key_rows, sym
from golden_vectors import recorded as recorded_tensors
from lidar2pano.calibration import Calibration
from lidar2pano.data.camera_pairs import CameraProjectionDataset, stretched
from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.geometry.rasters import as_image, in_unit
from lidar2pano.losses.adversarial import pix2pix_updates
from lidar2pano.models import build
from lidar2pano.models.blocks import fold_norms
from lidar2pano.models.card import load
from lidar2pano.scan import Scan
from lidar2pano.train.colour import camera_inputs
from lidar2pano.train.engine import train
from lidar2pano.train.front import Pix2PixOptions, pix2pix_losses
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from lidar2pano.views import VIEWS
from miniature import street, write_data_set
from small_recipes import SIZE, small, without_chance

# network -> settings of the recorded one, its file in the golden folder, gain of the fill rule, shape of the input
RECORDED = {
    "pix2pix": ({"inputs": 25, "outputs": 15}, "pix2pix_unet256", 1.0, (1, 25, 256, 256)),
    "pix2pix-critic": ({}, "pix2pix_patchgan", 1.4, (1, 6, 256, 256)),
    "scunet": (
        {},
        "scunet_assumed",
        1.4,
        (1, 1, 64, 208),
    ),  # a regression vector of an assumption: this network was not published
}


pytestmark = pytest.mark.usefixtures("small_view")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data"))


# --- against recorded runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=RECORDED)
def recorded(request) -> tuple[str, nn.Module]:
    """A network's name, and the network in evaluation mode with the weights of the fill rule."""
    settings, _, gain, _ = RECORDED[request.param]
    model = build(request.param, **settings).eval()
    model.load_state_dict(fill(model.state_dict(), gain))
    return request.param, model


@pytest.mark.parity
def test_outputs_are_the_recorded_ones(golden: Path, recorded: tuple[str, nn.Module]) -> None:
    network, model = recorded
    _, file, _, shape = RECORDED[network]
    lengths: dict[str, float] = {}
    for name, layer in model.named_modules():
        layer.register_forward_hook(lambda _, __, out, name=name: lengths.update({name: out.double().norm().item()}))
    with torch.inference_mode():
        out = model(sym("input.x", shape))
    out = (out + 1) / 2 if network == "scunet" else out  # ours is in [-1, 1]
    recorded_tensors(golden, file)["out.output"].assert_close(out, 1e-4)
    taps = json.loads((golden / f"{file}.taps.json").read_text())
    known = taps.keys() - {"pool"}  # one layer, called at every level
    assert known <= lengths.keys()
    assert {name: lengths[name] for name in known} == pytest.approx(
        {name: taps[name][-1]["l2"] for name in known}, rel=1e-5
    )


@pytest.mark.parity
def test_keys_shapes_and_fill_are_the_recorded_ones(golden: Path, recorded: tuple[str, nn.Module]) -> None:
    network, model = recorded
    state, rows = model.state_dict(), key_rows(golden, RECORDED[network][1])
    assert list(state) == [row[0] for row in rows]
    assert_weights_as_recorded(state, rows)


@pytest.mark.parity
def test_the_three_channel_network_differs_in_its_first_and_last_layers_only(golden: Path) -> None:
    expected = {key: json.loads(shape) for key, shape, *_ in key_rows(golden, "pix2pix_unet256")}
    expected |= {"model.model.0.weight": [64, 3, 4, 4]}
    expected |= {"model.model.3.weight": [128, 3, 4, 4], "model.model.3.bias": [3]}
    with torch.device("meta"):
        state = build("pix2pix").state_dict()
    assert {key: list(tensor.shape) for key, tensor in state.items()} == expected


# --- sizes and statistics --------------------------------------------------------------------------------------------


def unet(**settings: object) -> nn.Module:
    torch.manual_seed(3)
    return build("pix2pix", **{"inputs": 5, "outputs": 2, "width": 4, "depth": 3, **settings}).eval()


def test_sizes_that_do_not_divide_are_padded_by_their_last_pixels_and_cut_back():
    x = torch.randn(1, 5, 13, 30)
    rows, columns = torch.arange(16).clamp(max=12), torch.arange(32).clamp(max=29)
    with torch.inference_mode():
        whole = unet()(x[:, :, rows][..., columns])
        torch.testing.assert_close(unet()(x), whole[..., :13, :30])


def test_an_image_of_another_size_is_stretched_without_losing_a_point():
    network, inputs = unet(size=(13, 30)), []
    network.model.register_forward_hook(lambda _, given, __: inputs.append(given[0]))
    x = torch.zeros(1, 5, 8, 64)
    x[0, :, 3, 41] = 7.0
    with torch.inference_mode():
        assert network(x).shape == (1, 2, 13, 30)
    assert inputs[0].shape == (1, 5, 16, 32)
    assert (inputs[0][0, 0] > 0).sum() == 2  # a row became two, two columns one
    assert inputs[0].max() == 3.5


def test_inputs_are_joined_in_their_order():
    parts = torch.randn(2, 3, 16, 16), torch.randn(2, 2, 16, 16)
    with torch.inference_mode():
        torch.testing.assert_close(unet()(*parts), unet()(torch.cat(parts, 1)))


def test_batch_statistics_are_those_of_training_and_change_nothing():
    network = unet(batch_statistics=True, dropout=0.0)
    x = torch.randn(2, 5, 16, 16) + 3
    before = {key: value.clone() for key, value in network.state_dict().items()}
    with torch.inference_mode():
        now, running = network(x), unet()(x)
        assert all(torch.equal(network.state_dict()[key], value) for key, value in before.items())
        torch.testing.assert_close(fold_norms(network)(x), now)  # what inference folds, this must not lose
        torch.testing.assert_close(network.train()(x), now)
    assert (now - running).abs().max() > 0.05


def test_dropout_is_where_the_published_network_has_it():
    with torch.device("meta"):
        network = build("pix2pix")
    share = {name.count(".model."): part.p for name, part in network.named_modules() if isinstance(part, nn.Dropout)}
    assert share == {5: 0.5, 6: 0.5, 7: 0.5}  # the three levels above the innermost; the outermost is level 1


def test_nonsense_settings_are_refused():
    with pytest.raises(InputError, match="no norm 'layer'; there is batch and instance"):
        build("pix2pix", norm="layer")
    with pytest.raises(InputError, match="depth must be at least 2"):
        build("pix2pix", depth=1)
    with pytest.raises(InputError, match="connected=5 of 5 levels"):
        build("scunet", connected=5)


def test_instance_norms_have_no_weights_and_convolutions_have_biases():
    keys = build("pix2pix", width=2, norm="instance").state_dict().keys()
    assert {key.rpartition(".")[2] for key in keys} == {"weight", "bias"}
    convolutions = sum(isinstance(part, nn.Conv2d | nn.ConvTranspose2d) for part in build("pix2pix", width=2).modules())
    assert len(keys) == 2 * convolutions


def test_scunets_upper_levels_hear_of_the_encoder_only_from_below():
    network = build("scunet", widths=(4, 4, 4, 4), connected=1).eval()
    received = []
    for blocks in network.dec:
        blocks.register_forward_pre_hook(lambda _, inputs: received.append(inputs[0].shape[1]))
    network(torch.rand(1, 1, 16, 16))
    assert received == [8, 4, 4]


# --- what SC-UNET reads ----------------------------------------------------------------------------------------------


def camera(width: int = 40, height: int = 12) -> Calibration:
    """Looks ahead from half a metre behind the LiDAR."""
    T = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.5], [0, 0, 0, 1.0]])
    K = np.array([[20, 0, (width - 1) / 2], [0, 20, (height - 1) / 2], [0, 0, 1.0]])
    return Calibration(K=K, T_camera_lidar=T, size=(width, height))


def raster_slowly(scan: Scan, calibration: Calibration, size: tuple[int, int]) -> np.ndarray:
    """Point by point: where it falls, and whether it is nearer than who is there."""
    raster = np.zeros((2, *size), np.float32)
    for xyz, remission in zip(scan.xyz.astype(np.float64), scan.remission, strict=True):
        if not np.isfinite(xyz).all() or not xyz.any():
            continue
        x, y, z = calibration.T_camera_lidar[:3, :3] @ xyz + calibration.T_camera_lidar[:3, 3]
        if z <= 0:
            continue
        u, v, _ = calibration.K @ (x / z, y / z, 1)
        column = int(np.floor((u + 0.5) * size[1] / calibration.size[0]))
        row = int(np.floor((v + 0.5) * size[0] / calibration.size[1]))
        distance = np.float32(np.linalg.norm((x, y, z)))
        if not (0 <= row < size[0] and 0 <= column < size[1]):
            continue
        if raster[1, row, column] == 0 or distance < raster[1, row, column]:
            raster[:, row, column] = remission, distance
    return raster


@pytest.mark.parametrize("size", [(12, 40), (6, 20), (18, 25)])
def test_the_cameras_raster_agrees_with_its_definition(size):
    scan, calibration = street(7, points=3000), camera()
    expected = raster_slowly(scan, calibration, size)
    assert (expected[1] > 0).sum() > 30
    np.testing.assert_allclose(project_to_camera(scan, calibration, size).numpy(), expected, rtol=1e-5)


def test_the_nearest_point_owns_a_pixel_and_at_equal_range_the_first():
    points = [(9, 0, 0), (5, 0, 0), (5, 0, 0), (-5, 0, 0), (0, 0, 0), (np.nan, 0, 0)]
    points += [(5, 0, 2), (5, 0, -2), (5, 5.8, 0), (5, -5.8, 0)]  # a pixel above, below, left, right of the picture
    remission = np.arange(1, 11, dtype=np.float32) / 10
    raster = project_to_camera(Scan(xyz=np.array(points, np.float32), remission=remission), camera(41, 13), (13, 41))
    assert raster[:, 6, 20].tolist() == pytest.approx([0.2, 5.5])
    assert (raster[1] > 0).sum() == 1


def test_an_empty_scan_is_an_empty_raster():
    nothing = Scan(xyz=np.zeros((0, 3), np.float32), remission=np.zeros(0, np.float32))
    assert not project_to_camera(nothing, camera(), (12, 40)).any()


def test_camera_samples_line_scan_and_image_up_and_flip_them_together(root):
    samples = CameraProjectionDataset(root, ("train",), (36, 120))
    plain = samples[0]
    below, above = plain.lidar[1, 20:], plain.lidar[1, :6]
    assert (below > 0).any() and not (above > 0).any()  # the road is there, the sky gives no echo
    assert plain.image.shape == (3, 36, 120) and plain.image.min() >= -1 and plain.image.max() <= 1
    drawn = [samples[SampleIndex(0, seed)] for seed in range(12)]
    counts = {int((one.lidar[1] > 0).sum()) for one in drawn}
    flipped = [torch.equal(one.image, plain.image.flip(-1)) for one in drawn]
    assert len(counts) > 3 and {True, False} == set(flipped)
    for one, flip in zip(drawn, flipped, strict=True):  # the left strip of the made-up picture is another colour
        kept = one.lidar.flip(-1) if flip else one.lidar
        there = kept[1] > 0
        assert (kept[1] == plain.lidar[1])[there].float().mean() > 0.8  # who lay behind a dropped point differs
    assert torch.equal(samples[SampleIndex(0, 5)].lidar, samples[SampleIndex(0, 5)].lidar)


def test_colours_go_from_minus_one_to_one():
    assert in_unit(torch.tensor([0, 51, 255], dtype=torch.uint8)).tolist() == pytest.approx([-1, -0.6, 1])


def test_stretching_keeps_what_is_even_and_what_has_the_size():
    image = np.full((7, 9, 3), 93, np.uint8)
    assert (stretched(image, (4, 5)) == 93).all()
    image = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    assert (stretched(image, (4, 6)).movedim(0, 2).numpy() == image).all()
    assert (as_image(stretched(image, (4, 6)).float() / 127.5 - 1) == image).all()


def test_what_the_renderer_sees_of_the_camera():
    lidar = torch.rand(2, 2, 3, 4) * torch.tensor([1.0, 120.0])[:, None, None]
    assert torch.equal(camera_inputs(lidar, 1), lidar[:, :1])
    two = camera_inputs(lidar, 2)
    torch.testing.assert_close(two[:, 1], torch.log1p(lidar[:, 1]) / np.log(121))
    with pytest.raises(InputError, match="inputs must be 1 or 2, not 3"):
        camera_inputs(lidar, 3)


# --- the adversarial step --------------------------------------------------------------------------------------------


class Discriminator(nn.Module):
    """Scores a condition and an image."""

    def __init__(self) -> None:
        super().__init__()
        self.scores = nn.Conv2d(3, 1, 3)

    def forward(self, condition: Tensor, image: Tensor) -> Tensor:
        return self.scores(torch.cat([condition, image], 1))


@pytest.mark.parametrize("mode", ["vanilla", "lsgan"])
def test_losses_are_pix2pixs(mode):
    generator, critic = nn.Conv2d(1, 2, 1), Discriminator()
    z, real, condition = torch.randn(2, 1, 8, 8), torch.rand(2, 2, 8, 8), torch.rand(2, 1, 8, 8)
    logs: dict[str, float | Tensor] = {}
    options = Pix2PixOptions(gan_mode=mode, auxiliary="mse", auxiliary_weight=100.0)
    updates = pix2pix_updates(lambda: generator(z), critic, real, condition, *pix2pix_losses(options, real), logs)
    fake = generator(z)
    on_real, on_fake = critic(condition, real), critic(condition, fake)

    def loss_to(scores: Tensor, goal: float) -> Tensor:
        if mode == "lsgan":
            return (scores - goal).square().mean()
        share = scores.sigmoid()
        return -(goal * share.log() + (1 - goal) * (1 - share).log()).mean()

    role, loss = next(updates)
    assert role == "critic"
    torch.testing.assert_close(loss, (loss_to(on_real, 1) + loss_to(on_fake, 0)) / 2)
    loss.backward()
    assert all(weight.grad is None for weight in generator.parameters())
    critic.zero_grad()
    with torch.no_grad():
        critic.scores.weight.mul_(-0.5)
    role, loss = next(updates)
    assert role == "generator"
    torch.testing.assert_close(loss, loss_to(critic(condition, fake), 1) + 100 * (fake - real).square().mean())
    loss.backward()
    assert all(weight.grad.any() for weight in generator.parameters())
    assert all(weight.grad is None or not weight.grad.any() for weight in critic.parameters())
    assert next(updates, None) is None
    assert all(weight.requires_grad for weight in critic.parameters())
    assert set(logs) == {"real", "fake", "adversarial", "auxiliary"}


# --- recipes ---------------------------------------------------------------------------------------------------------

NAMES = ["pix2pix-segments-mini", "pix2pix-rgb-mini", "scunet-mini"]


@pytest.mark.parametrize("name", NAMES)
def test_the_auxiliary_loss_falls(root, name):
    task = build_task(small(name), root)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    optimizers = {role: torch.optim.Adam(net.parameters(), lr=3e-3) for role, net in task.networks.items()}
    losses = []
    for _ in range(4):
        for role, loss in task.updates(batch):
            task.networks[role].zero_grad()
            loss.backward()
            assert all(weight.grad is not None for weight in task.networks[role].parameters())
            optimizers[role].step()
        losses.append(float(task.logs.get("auxiliary", loss.detach())))
    assert 0 < losses[-1] < 0.95 * losses[0]


def test_pix2pixs_auxiliary_loss_is_the_weighted_distance_to_what_the_camera_has(root):
    with without_chance():
        task = build_task(small("pix2pix-segments-mini", "options.auxiliary_weight=7"), root)
        batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
        segments = torch.nn.functional.one_hot(batch.segments, 20).movedim(-1, 1)
        fake = task.networks["translator"](batch.lidar, segments.float()).detach()
        list(task.updates(batch))
        expected = torch.full_like(fake, -1.0).scatter_(1, batch.camera_labels[:, None], 1.0)
        assert float(task.logs["auxiliary"]) == pytest.approx(7 * (fake - expected).abs().mean().item(), rel=1e-4)
        task = build_task(small("pix2pix-rgb-mini", "options.auxiliary_weight=7", "options.auxiliary=mse"), root)
        batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
        fake = task.networks["renderer"](batch.lidar).detach()
        list(task.updates(batch))
        assert float(task.logs["auxiliary"]) == pytest.approx(7 * (fake - batch.image).square().mean().item(), rel=1e-4)


def test_pix2pixs_critic_sees_beside_the_image_what_the_generator_sees(root):
    task, received = build_task(small("pix2pix-segments-mini"), root), []
    task.networks["critic"].register_forward_pre_hook(lambda _, inputs: received.append(inputs))
    batch = default_collate([task.dataset[0]])
    list(task.updates(batch))
    condition_at_input = torch.cat(
        [batch.lidar, torch.nn.functional.one_hot(batch.segments, 20).movedim(-1, 1).float()], 1
    )
    assert len(received) == 3  # a true pair, a made one, and that again for the generator
    for condition, image in received:
        torch.testing.assert_close(condition, torch.nn.functional.adaptive_avg_pool2d(condition_at_input, SIZE))
        assert image.shape == (1, 15, *SIZE) and image.abs().max() <= 1


@pytest.mark.parametrize("name", NAMES)
def test_what_is_released_says_what_it_is(root, name, tmp_path):
    train(small(name), root, tmp_path, device="cpu")
    (path,) = tmp_path.glob("weights/[!.]*[!t].safetensors")
    network, card = load(path)
    assert card.recipe == name and card.steps == 1 and card.score["split"] == "val"
    assert card.labels == ("common-14" if name == "pix2pix-segments-mini" else None)
    if name == "scunet-mini":
        assert card.views == {"camera": {"rows": SIZE[0], "columns": SIZE[1]}}
    else:
        assert card.views == {"input": VIEWS["titan-front-small"].as_dict()} and card.normalisation["mean"][0] == 12.12
    assert bool(card.settings.get("batch_statistics")) == name.startswith("pix2pix")
    if card.labels is None:
        assert card.score["score"] == -card.score["pooled_colour"] and -1 <= card.score["ssim"] <= 1
    inputs = {"pix2pix-segments-mini": 25, "pix2pix-rgb-mini": 5, "scunet-mini": 1}[name]
    assert network(torch.zeros(1, inputs, *SIZE)).shape == (1, 15 if card.labels else 3, *SIZE)
    assert list(tmp_path.glob("preview/*.png"))


def test_a_perfect_renderer_has_no_distance(root):
    task = build_task(small("scunet-mini"), root)
    task.render = lambda index: (task.validation[index].image,) * 2
    assert task.validate() == {"score": 0.0, "pooled_colour": 0.0, "ssim": pytest.approx(1.0)}
    task.render = lambda index: (-torch.ones(3, *SIZE), torch.ones(3, *SIZE))
    assert task.validate()["pooled_colour"] == 1.0


def test_colour_tasks_need_no_labels(root, tmp_path):
    for name in ("pix2pix-rgb-mini", "scunet-mini"):
        bare = write_data_set(tmp_path / name)
        for folder in ("labels", "camera_labels"):
            for path in bare.glob(f"sequences/*/{folder}/*"):
                path.unlink()
        task = build_task(small(name), bare)
        assert task.dataset[SampleIndex(0, 1)].image.shape == (3, *SIZE)
        assert [role for role, _ in task.updates(default_collate([task.dataset[0]]))][-1] == "renderer"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("pix2pix-rgb-mini", "options.auxiliary=l3", "options.auxiliary cannot be 'l3'"),
        ("pix2pix-segments-mini", "options.gan_mode=lsgun", "options.gan_mode cannot be 'lsgun'; did you mean 'lsgan'"),
        ("scunet-mini", "options.size=0,24", "options.size=0 must be at least 1"),
    ],
)
def test_unknown_options_are_refused(name, change, message):
    with pytest.raises(InputError, match=message):
        small(name, change)


def test_the_papers_recipes_have_the_published_sizes():
    for name, role, sizes in (
        ("pix2pix-segments", "translator", (25, 15, 40)),
        ("pix2pix-rgb", "renderer", (5, 3, 8)),
    ):
        recipe = recipe_named(name)
        generator, critic = (recipe.networks[one].settings for one in (role, "critic"))
        assert (generator["inputs"], generator["outputs"], critic["channels"]) == sizes
        assert critic["channels"] == generator["inputs"] + generator["outputs"]
        assert recipe.training.batch == 10 and recipe.networks[role].optimizer.rate == 1e-4  # the paper's, not theirs
