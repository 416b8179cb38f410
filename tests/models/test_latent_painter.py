"""The latent painter: its conditions and noise by slow definitions, its steps, and a picture on its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.latent_painter import Clues, class_shares, conditions_of, mirrored, style_of
from lidar2pano.models.world_noise import world_noise
from lidar2pano.scene.record import Scene
from lidar2pano.views import VIEWS, View
from poses import pose_of, somewhere

VIEW = replace(VIEWS["panorama"], rows=32, columns=384)
NARROW = ((4, 6, 8), (1, 1, 1))
SMALL = {"latents": 4, "autoencoder": ((4, 6, 8), (4, 4, 6, 8)), "mean": NARROW, "flow": NARROW, "code": 8}


def scene_of(depth_m: torch.Tensor, view: View = VIEW, pose: np.ndarray | None = None) -> Scene:
    """Sky above the horizon, road below it, half of the pixels measured."""
    torch.manual_seed(3)
    rows, columns = depth_m.shape[1:]
    probabilities = torch.full((1, 16, rows, columns), 0.02)
    probabilities[:, 15, : rows // 3] = 0.7
    probabilities[:, 7, rows // 3 :] = 0.7
    channels = torch.rand(1, 5, rows, columns)
    channels[:, :, :, ::2] = 0
    return Scene(
        view=view,
        channels=channels,
        probabilities=probabilities,
        depth_m=depth_m,
        viewpoint_m=torch.tensor([1.6]),
        T_world_sensor=pose,
    )


def street(columns: int = VIEW.columns) -> torch.Tensor:
    """Distances (1, 32, columns) of a road below and of walls above it."""
    azimuth = torch.linspace(0, 2 * math.pi, columns + 1)[:-1]
    tangent = 0.24 - (torch.arange(32) + 0.5) / 32 * (0.24 + 0.2836)
    road = 1.6 / (-tangent).clamp(min=0.05)
    wall = 8 + 3 * torch.sin(2 * azimuth)
    return torch.minimum(road[:, None], wall)[None] * torch.sqrt(1 + tangent**2)[None, :, None]


def test_conditions_are_what_they_are_said_to_be():
    scene = scene_of(street())
    made = conditions_of(scene)[0]
    assert made.shape == (26, 32, 384)
    for row, column in ((4, 5), (20, 6), (31, 101), (30, 8)):
        tangent = 0.24 - (row + 0.5) / 32 * (0.24 + 0.2836)
        distance = float(scene.depth_m[0, row, column])
        is_sky, is_measured = row < 32 // 3, column % 2 == 1
        height = (distance / math.sqrt(1 + tangent**2) * tangent + 1.6) / 4
        code = math.log1p(distance) / math.log(121)
        assert made[:16, row, column].tolist() == pytest.approx(scene.probabilities[0, :, row, column].tolist())
        assert made[16:18, row, column].tolist() == pytest.approx([0, 0] if is_sky else [code, height], abs=1e-5)
        assert made[21, row, column] == made[24, row, column] == 1
        assert made[22, row, column] == is_measured
        assert float(made[23, row, column]) == pytest.approx(float(scene.channels[0, 4, row, column]))
        assert float(made[25, row, column]) == pytest.approx(tangent / 0.3, abs=1e-6)
    assert made[18:21, 31, 100].tolist() == pytest.approx([0, 0, 1], abs=0.01)  # a level road looks up
    assert not made[18:21, :10].any()


def test_a_mirrored_scene_has_mirrored_conditions():
    scene = scene_of(street())
    flipped = {name: getattr(scene, name).flip(-1) for name in ("channels", "probabilities", "depth_m")}
    torch.testing.assert_close(
        conditions_of(replace(scene, **flipped)), mirrored(conditions_of(scene)), atol=1e-5, rtol=0
    )


def test_noise_is_normal_and_another_seed_is_another_one():
    scene = scene_of(street())
    (_, noise), (_, other) = (world_noise(None, scene, 32, 4, seed=seed) for seed in (0, 1))
    assert noise.shape == (1, 32, 8, 96)
    assert abs(float(noise.mean())) < 0.02
    assert float(noise.std()) == pytest.approx(1, abs=0.02)
    assert float(noise.pow(4).mean()) == pytest.approx(3, abs=0.2)
    assert abs(float((noise * other).mean())) < 0.02
    neighbours = ((noise * noise.roll(1, axis)).mean() for axis in (1, 2, 3))
    assert max(abs(float(mean)) for mean in neighbours) < 0.02


CENTRED = replace(VIEW, origin=(0.0, 0.0, 0.0))


def turned_by(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return pose


def test_noise_stays_where_it_is_while_the_sensor_turns():
    """Three turns to the left, each by a third of a pixel, show the same world one pixel farther to the right."""
    depth_m, third = torch.full((1, 32, 384), 10.0), math.tau / 96 / 3
    particles, first = world_noise(None, scene_of(depth_m, CENTRED, turned_by(0)), 8, 4)
    columns = []
    for number in (1, 2, 3):
        particles, noise = world_noise(particles, scene_of(depth_m, CENTRED, turned_by(number * third)), 8, 4)
        columns += [shift for shift in (0, 1) if torch.equal(noise, first.roll(shift, 3))]
    assert columns == [0, 1, 1]


def test_noise_comes_along_when_the_sensor_moves_ahead():
    """By definition, particle by particle, with depths that waver by a tenth; no noise is used twice."""
    torch.manual_seed(1)
    poses = [np.eye(4) for _ in range(4)]
    particles = None
    for number, pose in enumerate(poses):
        pose[0, 3] = 0.4 * number
        depth_m = street() * (1 + 0.1 * torch.rand(1, 32, 384))
        before, scene = particles, scene_of(depth_m, CENTRED, pose)
        particles, noise = world_noise(before, scene, 2, 4)
        assert len(noise[0, 0].unique()) == noise[0, 0].numel()
        if before is None:
            continue
        nearest: dict[tuple[int, int], tuple[float, float]] = {}
        for row, column in np.ndindex(8, 96):
            distance = float(before.distance_m[row, column])
            place = before.rays[row, column].numpy() * (1 if math.isinf(distance) else distance)
            x, y, z = place - (0 if math.isinf(distance) else 1) * np.array([0.4, 0, 0])
            there = ((0.24 - z / math.hypot(x, y)) / (0.24 + 0.2836) * 8, (math.pi - math.atan2(y, x)) / math.tau * 96)
            cell = (math.floor(there[0]), math.floor(there[1]) % 96)
            if not 0 <= cell[0] < 8:
                continue
            seen = 1 / float(scene.depth_with_sky_m[0, cell[0] * 4 + 2, cell[1] * 4 + 2])
            inverse = 0 if math.isinf(distance) else 1 / math.sqrt(x * x + y * y + z * z)
            if max(seen, inverse) < 1.4 * min(seen, inverse) or seen == inverse == 0:
                offset = math.hypot(there[0] - cell[0] - 0.5, there[1] % 1 - 0.5)
                found = (offset, float(before.noise[0, row, column]))
                nearest[cell] = min(nearest.get(cell, found), found)
        assert len(nearest) > 0.6 * 8 * 96
        carried = {cell: value for cell, (_, value) in nearest.items()}
        old = {float(value) for value in before.noise[0].flatten()}
        for cell in np.ndindex(8, 96):
            value = float(noise[0, 0][cell])
            assert value == carried[cell] if cell in carried else value not in old


def test_noise_is_carried_by_the_motion_between_poses_wherever_they_are():
    """A step ahead and a turn, of a sensor in another corner of the world."""

    def carried(world):
        particles, noise = None, torch.empty(0)
        for pose in (np.eye(4), pose_of(20, 0, 0, (1.5, 0.5, 0))):
            particles, noise = world_noise(particles, scene_of(street(), CENTRED, world @ pose), 2, 4)
        return noise

    same = carried(np.eye(4)) == carried(somewhere())
    assert same.float().mean() > 0.99  # rounding may decide between two pixels


def test_what_comes_before_a_place_has_noise_of_its_own():
    far, near = torch.full((1, 32, 384), 10.0), torch.full((1, 32, 384), 10.0)
    near[:, :, 192:] = 4.0
    particles, before = world_noise(None, scene_of(far, CENTRED, np.eye(4)), 8, 4)
    _, after = world_noise(particles, scene_of(near, CENTRED, np.eye(4)), 8, 4)
    same = (before == after).all(1)[0]
    assert same[:, :48].all() and same[:2].all(), "the sky stays"
    assert not same[3:, 48:].any()


def test_without_poses_noise_hangs_on_directions():
    particles, noise = world_noise(None, scene_of(street()), 8, 4)
    assert particles is None
    assert torch.equal(noise, world_noise(None, scene_of(2 * street()), 8, 4)[1])


def painter(**settings):
    torch.manual_seed(0)
    network = build("latent-painter", **SMALL | settings).eval()
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    return network


def test_a_scan_is_painted_and_another_step_count_paints_another_picture():
    scene = scene_of(street())
    with torch.inference_mode():
        pictures = [painter(steps=steps).paint(None, scene)[1] for steps in (1, 2, 4)]
        again = painter(steps=2).paint(None, scene)[1]
    assert {tuple(picture.shape) for picture in pictures} == {(1, 3, 64, 768)}
    assert all(float(picture.abs().max()) <= 1 for picture in pictures)
    assert torch.equal(pictures[1], again)
    assert not torch.equal(pictures[0], pictures[1])


def moment(time: torch.Tensor, length: float) -> torch.Tensor:
    """Sines and cosines of time and of the step's length, at frequencies from 1 to 1000."""
    frequencies = [1000 ** (i / 31) for i in range(32)]
    parts = [
        function(value * f) for value in (float(time), length) for function in (math.sin, math.cos) for f in frequencies
    ]
    return torch.tensor([parts])


@pytest.mark.parametrize("steps", [1, 4])
def test_steps_are_those_of_the_definition(steps):
    """Steps ask for the mean velocity over their own length."""
    network = painter(steps=steps)
    conditions, shares, noise = torch.randn(1, 26, 16, 32), torch.ones(1, 1), torch.randn(1, 4, 4, 8)
    clues = (torch.randn(1, 5, 4, 8), torch.randn(1, 9))
    with torch.inference_mode():
        mean, x = network.mean(conditions, shares), noise
        for number in range(steps):
            time = torch.tensor([number / steps])
            velocity = network.flow(conditions, shares, mean, x, time, moment(time, 1 / steps), *clues)
            x = x + velocity / steps
        torch.testing.assert_close(
            network.latents_of(conditions, shares, noise, Clues(*clues)), x, atol=1e-4, rtol=1e-4
        )


def test_a_flow_adds_to_the_mean():
    """With a U-Net that answers its first input, the velocity is the mean and what it leaves of the latents."""
    network = painter().flow
    network.unet.forward = lambda conditions, code, inputs: inputs[:, :4]
    mean, noisy = torch.randn(2, 4, 4, 8), torch.randn(2, 4, 4, 8)
    time = torch.tensor([0.25, 1.0])
    with torch.inference_mode():
        made = network(
            torch.randn(2, 26, 16, 32), torch.ones(2, 1), mean, noisy, time, torch.zeros(2, 128), *Clues.empty(noisy)
        )
    torch.testing.assert_close(made, mean + noisy - torch.stack([mean[0] / 4, mean[1]]))


def test_a_style_is_the_mean_and_the_deviation_of_what_is_known():
    latents, mask = torch.randn(2, 4, 3, 5), torch.zeros(2, 3, 5, dtype=torch.bool)
    mask[0, 1, 2:] = True
    style = style_of(latents, mask[:, None].float())
    part = latents[0, :, 1, 2:]
    expected = [*part.mean(1).tolist(), *part.std(1, correction=0).tolist(), 1]
    assert style[0].tolist() == pytest.approx(expected, abs=1e-5)
    assert not style[1].any()
    clues = Clues.of(latents, mask, torch.zeros(2, 16, 3, 5))
    assert torch.equal(clues.style, style)
    assert torch.equal(clues.photograph[0, :4, 1, 2:], part) and clues.photograph[0].count_nonzero() == 5 * 3
    assert not clues.photograph[1].any()
    assert not any(part.any() for part in Clues.empty(latents))


def test_where_no_camera_looks_are_the_latents_of_the_classes_that_one_has_seen():
    """By definition: of each class the sum over what is seen, over one more than its cells; mixed by shares."""
    torch.manual_seed(4)
    latents, mask = torch.randn(1, 4, 3, 5), torch.rand(1, 3, 5) < 0.6
    shares = torch.rand(1, 16, 3, 5).softmax(1) * torch.tensor([1.0, 0] * 8)[None, :, None, None]
    photograph = Clues.of(latents, mask, shares).photograph[0]
    cells = list(np.ndindex(3, 5))
    palette = np.zeros((16, 4))
    for number in range(16):
        seen = [cell for cell in cells if mask[0][cell]]
        count = sum(float(shares[0, number][cell]) for cell in seen)
        total = sum(float(shares[0, number][cell]) * latents[0][:, *cell].numpy() for cell in seen)
        palette[number] = total / (count + 1)
    for cell in cells:
        expected = latents[0][:, *cell].numpy() if mask[0][cell] else shares[0][:, *cell].numpy() @ palette
        assert photograph[:4, *cell].tolist() == pytest.approx(expected.tolist(), abs=1e-5)
    assert torch.equal(photograph[4], mask[0].float())


def test_a_cell_has_the_mean_probabilities_of_its_pixels():
    conditions = torch.rand(2, 26, 8, 12)
    expected = conditions[1, 5, 4:8, 8:12].mean()
    assert float(class_shares(conditions)[1, 5, 1, 2]) == pytest.approx(float(expected))


def test_what_is_known_changes_what_is_painted_in_all_directions():
    """Latents near their place, through the U-Net; the style everywhere, a sector's width away and more."""
    network = painter(steps=1)
    conditions, shares, noise = torch.randn(1, 26, 16, 1152), torch.ones(1, 1), torch.randn(1, 4, 4, 288)
    mask = torch.zeros(1, 4, 288, dtype=torch.bool)
    mask[..., :8] = True
    clues = Clues.of(3 + noise, mask, torch.zeros(1, 16, 4, 288))
    parts = (Clues.empty(noise), Clues(clues.photograph, 0 * clues.style), clues)
    with torch.inference_mode():
        nothing, given, both = (network.latents_of(conditions, shares, noise, part) for part in parts)
    assert not torch.equal(given[..., :8], nothing[..., :8])
    assert torch.equal(given[..., 140:148], nothing[..., 140:148])
    assert not torch.equal(both[..., 140:148], given[..., 140:148])


def test_normalised_latents_have_no_mean_and_unit_deviation():
    network = painter().decoder
    network.scale.copy_(torch.tensor([[1.0, 2, 3, 4], [2.0, 2, 4, 4]]))
    latents = torch.tensor([3.0, 2, -1, 8])[None, :, None, None].expand(1, 4, 2, 2)
    assert network.normalised(latents)[0, :, 0, 0].tolist() == [1, 0, -1, 1]
    with torch.inference_mode():
        picture = network.decoder(torch.tanh(latents / 3) * 3)  # the decoder reads them within +-3, softly
        torch.testing.assert_close(network(network.normalised(latents)), picture)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="takes 1, 2 or 4 steps, not 0"):
        build("latent-painter", **SMALL, steps=0)
    with pytest.raises(InputError, match="knows no look 'dusk'"):
        painter().look_shares("dusk")
    for seed in (-1, 1 << 63):
        with pytest.raises(InputError, match=f"seed {seed}: is not between 0 and 9223372036854775807"):
            painter().variant("fast", seed)
    assert painter().variant("fast", (1 << 63) - 1)


def test_what_cameras_show_is_known_but_for_the_cells_at_its_edge():
    """The encoder reads beyond a cell; azimuth closes."""
    network = painter()
    picture, shown = torch.rand(1, 3, 32, 128), torch.zeros(1, 32, 128, dtype=torch.bool)
    shown[:, :, :40], shown[:, :, 120:] = True, True  # cells 0 to 4 and 15
    with torch.inference_mode():
        given, style = network.clues(picture, shown, torch.full((1, 16, 4, 16), 1 / 16))
        palette, _ = painter(palette=True).clues(picture, shown, torch.full((1, 16, 4, 16), 1 / 16))
        latents = network.decoder.normalised(network.encoder(picture * shown[:, None]))
    assert given[0, 4].tolist() == [[1.0] * 4 + [0.0] * 12] * 4
    torch.testing.assert_close(given[0, :4, :, :4], latents[0, :, :, :4])
    assert not given[0, :4, :, 4:].any(), "it has learned nothing of palettes"
    assert palette[0, :4, :, 4:].any() and torch.equal(palette[..., :4], given[..., :4])
    assert style.shape == (1, 9) and style[0, -1] == 1


def test_a_panorama_goes_on_from_what_cameras_show():
    scene, network = scene_of(street()), painter()
    picture, shown = torch.rand(1, 3, 64, 768), torch.zeros(1, 64, 768, dtype=torch.bool)
    shown[:, :, :96] = True
    with torch.inference_mode():
        alone = network.paint(None, scene)[1]
        nothing = network.paint(None, replace(scene, photographed=(picture, shown & False)))[1]
        helped = network.paint(None, replace(scene, photographed=(picture, shown)))[1]
    torch.testing.assert_close(nothing, alone)
    assert not torch.equal(helped[..., 480:], alone[..., 480:])  # the style is everywhere
