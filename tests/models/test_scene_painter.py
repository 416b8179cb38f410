"""The scene painter: every direction alike, noise in the world, several looks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.appearance import painter_inputs as layers
from lidar2pano.appearance.invented_textures import (
    HEAD_M,
    LEAVES,
    LEGS_M,
    LIT,
    LIT_M,
    SUNLIT,
    SUNNY_SIDE,
    VARIED,
    clothing,
    sign_colours,
    smooth_noise,
)
from lidar2pano.appearance.painter_inputs import (
    DEPTH,
    LOWEST_ROW,
    NO_HINTS,
    OBJECT_M,
    OPENINGS,
    TONES,
    VEHICLES,
    Hints,
    framed,
    outlined,
    painter_inputs,
    sharpened,
    twice,
)
from lidar2pano.errors import InputError
from lidar2pano.labels import COMMON15
from lidar2pano.models import build, scene_painter
from lidar2pano.models.scene_painter import GLASS, PANES_M
from lidar2pano.scene.depth import depth_code
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import cylinder_points
from lidar2pano.views import View

VIEW = View(rows=16, columns=64, up=0.24, down=-0.28, kind="cylinder")
SMALL = {"widths": [8, 16, 24, 8], "code": 4}


def scene(columns: int = 0) -> Scene:
    """A street seen after a turn to the left by so many columns."""
    generator = torch.Generator().manual_seed(5)
    segments = torch.rand(1, 16, 16, 64, generator=generator).softmax(1)
    depth_m = 2 + 20 * torch.rand(1, 16, 64, generator=generator)
    image = torch.rand(1, 5, 16, 64, generator=generator)
    angle = columns / 64 * 2 * math.pi
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    segments, depth_m, image = (part.roll(columns, -1) for part in (segments, depth_m, image))
    return Scene.predicted(VIEW, image, segments, depth_m, T_world_sensor=pose)


def layers_of(
    segments, depth_m, channels, view, pose=None, hints=NO_HINTS, **options
) -> tuple[torch.Tensor, torch.Tensor]:
    """The painter's inputs of a scene with these parts."""
    parts = Scene.predicted(view, channels, segments, depth_m, T_world_sensor=pose)
    return painter_inputs(parts, hints, **options)


def painter(looks: tuple[str, ...] = ("day", "evening")) -> torch.nn.Module:
    torch.manual_seed(0)
    network = build("scene-painter", looks=looks, **SMALL).eval()
    for norm in network.modules():
        if isinstance(norm, torch.nn.BatchNorm2d):
            norm.running_mean.normal_(0, 0.2)
    return network


@torch.inference_mode()
def painted(network, one: Scene, look: str = "") -> torch.Tensor:
    return network.paint(None, one, look)[1]


def test_a_turned_scene_is_painted_turned():
    network = painter()
    here, there = (painted(network, scene(columns=columns)) for columns in (0, 8))
    assert here.shape == (1, 3, 32, 128)
    apart = (here.roll(16, 3) - there).abs()
    assert apart.median() < 1e-5 and apart.mean() < 0.02 * here.std(), "but for points on the border of two voxels"


def test_the_mean_of_two_looks_lies_between_them():
    network = painter()
    shares = [network.look_shares(name) for name in ("", "day", "evening", "day+evening")]
    assert shares == [[1, 0], [1, 0], [0, 1], [0.5, 0.5]]
    day, evening, both = (painted(network, scene(), look) for look in ("day", "evening", "day + evening"))
    assert not torch.allclose(day, evening, atol=1e-4)
    codes = network.codes.weight.mean(0, keepdim=True)
    one = painter(("one", "other"))
    with torch.no_grad():
        one.codes.weight.copy_(codes.expand(2, -1))
    assert torch.allclose(painted(one, scene(), "one"), both, atol=1e-5)


def test_a_look_adds_its_colours_to_those_of_a_class_before_the_tanh():
    torch.manual_seed(0)
    one = scene()
    plain = build("scene-painter", looks=["day", "evening"], **SMALL).eval()
    network = build("scene-painter", looks=["day", "evening"], class_colours=True, **SMALL).eval()
    state = plain.state_dict() | {"class_colours.weight": network.class_colours.weight}
    network.load_state_dict(state)
    assert torch.equal(painted(network, one, "evening"), painted(plain, one, "evening")), "at first nothing is added"
    added = torch.tensor([0.3, -0.2, 0.1])
    with torch.no_grad():
        network.class_colours.weight.view(2, 3, 16)[1, :, COMMON15.id_of("sky")] = added
    shares = outlined(one, network.sharp)[:, COMMON15.id_of("sky")]
    expected = torch.atanh(painted(plain, one, "evening")) + twice(shares)[:, None] * added[:, None, None]
    torch.testing.assert_close(painted(network, one, "evening"), torch.tanh(expected), atol=1e-4, rtol=0)
    assert torch.equal(painted(network, scene(), "day"), painted(plain, scene(), "day"))


def test_inside_of_panes_there_is_nothing_but_their_colour():
    """Across the seam and at the upper edge, too: as the network paints them near their borders and far off."""
    torch.manual_seed(0)
    inputs, noise, shares = torch.randn(1, 31, 16, 64), torch.randn(1, 3, 32, 128), torch.tensor([[0.25, 0.75]])
    inputs[:, OPENINGS] = 0
    inputs[:, OPENINGS, 0:9].index_fill_(2, torch.arange(-6, 5) % 64, 1)
    inputs[:, OPENINGS, 10:13, 20:30], inputs[:, OPENINGS, 6, 0] = 1, 0.9
    inputs[:, OPENINGS, 4:14, 32:60] = 1
    inputs[:, DEPTH] = depth_code(14 - 12 * torch.linspace(-1, 1, 64).abs())
    close, far = depth_code(torch.tensor(PANES_M))
    plain = build("scene-painter", looks=["day", "evening"], class_colours=True, **SMALL).eval()
    network = build("scene-painter", looks=["day", "evening"], glass=True, **SMALL).eval()
    for table in (network.glass, network.class_colours):
        torch.nn.init.normal_(table.weight, std=0.2)
    own = {
        name: value for name, value in network.state_dict().items() if name.split(".")[0] in {"glass", "class_colours"}
    }
    plain.load_state_dict({name: value for name, value in own.items() if name != "glass.weight"}, strict=False)
    network.load_state_dict(plain.state_dict() | own)
    with torch.inference_mode():
        before, after = (one(*framed(inputs, noise), shares, torch.zeros(1, 3)) for one in (plain, network))
    table = (shares @ network.glass.weight).view(3, GLASS)
    colour = torch.einsum("kc,bchw->bkhw", table, inputs[:, -GLASS:])
    share = torch.zeros(1, 16, 64)
    for row in range(16):
        for column in range(64):
            rows, columns = range(max(row - 2, 0), min(row + 3, 16)), [(column + step) % 64 for step in range(-2, 3)]
            mean = inputs[0, OPENINGS, rows][:, columns].sum() / 25
            near = ((far - inputs[0, DEPTH, row, column]) / (far - close)).clamp(0, 1)
            share[0, row, column] = ((mean - 0.75) / 0.25).clamp(0, 1) * near
    assert (share == 1).sum() > 10 and ((share > 0) & (share < 1))[..., 34:58].any() and not share[..., 34:40].any()
    expected = torch.lerp(torch.atanh(before), twice(colour), twice(share)[:, None])
    torch.testing.assert_close(torch.atanh(after), expected, atol=1e-3, rtol=1e-3)


def test_an_unknown_look_is_named_with_those_there_are():
    with pytest.raises(InputError, match=r"no look 'nite'.*day, night"):
        painter(("day", "night")).look_shares("day+nite")
    with pytest.raises(InputError, match="no look 'dusk'"):
        build("scene-painter", looks=["day"], look="dusk")


def test_without_a_pose_noise_hangs_on_the_sensor():
    network, one = painter(), scene()
    still = replace(one, T_world_sensor=None)
    assert torch.equal(painted(network, one), painted(network, still))


def test_sharpening_is_a_power():
    segments = torch.tensor([0.5, 0.3, 0.2]).view(1, 3, 1, 1)
    assert sharpened(segments, 2.0).flatten().tolist() == pytest.approx([25 / 38, 9 / 38, 4 / 38])


def test_sizes_that_do_not_divide_are_refused():
    with pytest.raises(InputError, match=r"inputs of \(26, 68\) pixels, of which \(10, 64\).*must divide by 4"):
        painter()(*framed(torch.zeros(1, 31, 10, 64), torch.zeros(1, 3, 20, 128)), torch.ones(1, 2), torch.zeros(1, 3))


def tones(given: torch.Tensor | None = None) -> torch.Tensor:
    """The tones among the inputs (3, H, W) of the scene."""
    one = scene()
    inputs, _ = painter_inputs(one, Hints(given))
    return inputs[0, TONES]


def test_known_tones_are_painted_and_others_are_invented():
    given = torch.rand(1, 3, VIEW.rows, VIEW.columns)
    given[..., :10, :] = torch.nan
    found = tones(given)
    assert torch.equal(found[:, 10:], given[0, :, 10:])
    assert torch.equal(found[:, :10], tones()[:, :10])


def test_where_no_tones_are_given_only_things_that_vary_do():
    assert tones()[0].std() > 0.01
    one = scene()
    for name in ("terrain", "truck", "car", "person"):
        segments = torch.zeros_like(one.probabilities)
        segments[:, COMMON15.id_of(name)] = 1
        inputs, _ = layers_of(segments, one.depth_m, one.channels, VIEW, one.T_world_sensor)
        assert inputs[0, TONES].any() == (name in {*VARIED, "person"})


def test_trees_on_the_left_are_in_the_sun_and_some_beside():
    one, turned = scene(), np.eye(4)
    turned[:2, :2] = [[0, -1], [1, 0]]  # what is ahead of the sensor is on the world's left
    segments = torch.zeros_like(one.probabilities)
    segments[:, COMMON15.id_of("vegetation")] = 0.75
    for pose in (None, one.T_world_sensor, turned):
        inputs, _ = layers_of(segments, one.depth_m, one.channels, VIEW, pose, Hints(sun=True))
        without, _ = layers_of(segments, one.depth_m, one.channels, VIEW, pose)
        radius_m, z_m = cylinder_points(one.depth_m, VIEW)
        noise = smooth_noise(radius_m, z_m, VIEW, OBJECT_M, pose).clamp(-1, 1)[0]
        rotation = np.eye(4) if pose is None else pose
        expected = torch.zeros(3, *noise.shape)
        for column in range(VIEW.columns):
            azimuth = np.pi - (column + 0.5) / VIEW.columns * 2 * np.pi
            left = (rotation[:2, :2] @ [np.cos(azimuth), np.sin(azimuth)])[1]
            near = (2 - radius_m[0, :, column] / LIT_M).clamp(0, 1)
            bright = LIT * near + SUNNY_SIDE * left + SUNLIT * noise[:, column].clamp(min=0)
            expected[:, :, column] = 0.75 * bright * torch.tensor(LEAVES)[:, None]
        alone = 0.75 * SUNLIT * noise.clamp(min=0) * torch.tensor(LEAVES)[:, None, None]
        torch.testing.assert_close(without[0, TONES].float(), alone, atol=1e-3, rtol=0)
        torch.testing.assert_close(inputs[0, TONES].float(), expected, atol=1e-3, rtol=0)
    assert (noise < 0).any() and (noise > 0).any() and radius_m.min() < LIT_M < radius_m.max(), "the test has both"
    quarter = VIEW.columns // 4
    ahead = expected[0, :, 2 * quarter - 3 : 2 * quarter + 3]
    assert ahead.mean() > expected[0, :, :3].mean() + SUNNY_SIDE, (
        "turned, the sunny side is ahead and the shady one behind"
    )


def test_people_wear_clothes_by_their_height_above_the_road():
    one = scene()
    segments = torch.zeros_like(one.probabilities)
    segments[:, COMMON15.id_of("road")] = 1
    segments[:, :, :, 20:24] = 0
    segments[:, COMMON15.id_of("person"), :, 20:24], segments[:, COMMON15.id_of("road"), :, 20:24] = 0.75, 0.25
    depth_m = torch.full_like(one.depth_m, 6.0)
    inputs, _ = layers_of(segments, depth_m, one.channels, VIEW, one.T_world_sensor)
    found, height_m = inputs[0, TONES].float(), inputs[0, 20].float() * 4
    assert not found[:, :, :20].any() and not found[:, :, 24:].any()
    radius_m, z_m = cylinder_points(depth_m, VIEW)
    noise = smooth_noise(radius_m, z_m, VIEW, OBJECT_M, one.T_world_sensor)[0].clamp(-1, 1)
    for row in range(VIEW.rows):
        expected = 0.75 * clothing(height_m[row, 20:24], noise[row, 20:24]).T
        torch.testing.assert_close(found[:, row, 20:24], expected, atol=1e-5, rtol=0)
    worn = height_m[:, 22]
    assert (worn < LEGS_M).any() and ((worn > LEGS_M) & (worn < HEAD_M)).any(), "the test has legs and a trunk"


def test_a_persons_surface_has_no_slope():
    one = scene()
    person = COMMON15.id_of("person")
    segments = torch.zeros_like(one.probabilities)
    segments[:, COMMON15.id_of("road")] = 1
    before, _ = layers_of(segments, one.depth_m, one.channels, VIEW)
    segments[:, :, :, 20:24] *= 0.25
    segments[:, person, :, 20:24] = 0.75
    after, _ = layers_of(segments, one.depth_m, one.channels, VIEW)
    share = (1 - segments[:, person, None]).expand(1, 3, -1, -1)
    assert before[:, 21:24].abs().amax() > 0.1
    torch.testing.assert_close(after[:, 21:24], share * before[:, 21:24], atol=1e-2, rtol=0)


def test_signs_have_colours_of_their_own():
    one = scene()
    segments = torch.zeros_like(one.probabilities)
    segments[:, COMMON15.id_of("road")] = 1
    segments[:, :, 2:6, 20:24] = 0
    segments[:, COMMON15.id_of("traffic-sign"), 2:6, 20:24], segments[:, COMMON15.id_of("road"), 2:6, 20:24] = (
        0.75,
        0.25,
    )
    depth_m = torch.full_like(one.depth_m, 6.0)
    inputs, _ = layers_of(segments, depth_m, one.channels, VIEW, one.T_world_sensor)
    noise = smooth_noise(*cylinder_points(depth_m, VIEW), VIEW, OBJECT_M, one.T_world_sensor)[0, 2:6, 20:24].clamp(
        -1, 1
    )
    expected = torch.zeros(3, *depth_m.shape[1:])
    expected[:, 2:6, 20:24] = 0.75 * sign_colours(noise.flatten()).T.unflatten(1, (4, 4))
    torch.testing.assert_close(inputs[0, TONES].float(), expected, atol=1e-5, rtol=0)


def test_glass_is_no_brighter_than_the_mean_and_keeps_what_is_darker():
    one, building = scene(), COMMON15.id_of("building")
    walls = torch.zeros_like(one.probabilities)
    walls[:, building] = 0.75
    found = []
    for openings in (0.0, 1.0, 0.25):
        hints = Hints(openings=torch.full_like(one.depth_m, openings))
        inputs, _ = layers_of(walls, torch.full_like(one.depth_m, 8.0), one.channels, VIEW, hints=hints)
        found.append(inputs[:, TONES])
    plaster, glass, blind = found
    assert (plaster > 0.05).any() and (plaster < -0.05).any(), "the test has bright and dark houses"
    torch.testing.assert_close(glass, plaster.clamp(max=0))
    torch.testing.assert_close(blind, torch.lerp(plaster, glass, 0.25))


def test_vehicles_people_and_poles_are_given_no_noise():
    one, coarse = scene(), slice(24, 27)
    for number, name in enumerate(COMMON15.classes[:-1]):
        segments = torch.zeros_like(one.probabilities)
        segments[:, number, :, :32], segments[:, COMMON15.id_of("road"), :, 32:] = 1, 1
        inputs, fine = layers_of(segments, one.depth_m, one.channels, VIEW, one.T_world_sensor)
        still = name not in {*VEHICLES, "person", "pole", "traffic-sign"}
        assert inputs[:, coarse, :, :32].any() == still and fine[..., :64].any() == still, name
        assert inputs[:, coarse, :, 32:].any() and fine[..., 64:].any()
    halves = torch.zeros_like(one.probabilities)
    halves[:, [COMMON15.id_of("car"), COMMON15.id_of("road")]] = 0.5
    road = torch.zeros_like(one.probabilities)
    road[:, COMMON15.id_of("road")] = 1
    noises = [layers_of(each, one.depth_m, one.channels, VIEW) for each in (halves, road)]
    torch.testing.assert_close(noises[0][0][:, coarse], noises[1][0][:, coarse] / 2)
    torch.testing.assert_close(noises[0][1], noises[1][1] / 2)


def test_walls_are_given_half_of_the_fine_noise_and_all_of_the_coarse():
    one, coarse, found = scene(), slice(24, 27), []
    for name in ("building", "road"):
        segments = torch.zeros_like(one.probabilities)
        segments[:, COMMON15.id_of(name)] = 1
        found.append(layers_of(segments, one.depth_m, one.channels, VIEW, one.T_world_sensor))
    (walls, on_walls), (road, on_road) = found
    assert on_road.any()
    torch.testing.assert_close(on_walls, on_road / 2)
    torch.testing.assert_close(walls[:, coarse], road[:, coarse])


def test_the_lowest_rows_have_one_number():
    one = scene()
    row = layers_of(one.probabilities, one.depth_m, one.channels, VIEW)[0][0, 19, :, 0]
    expected = [max(1 - 2 * each / (VIEW.rows - 1), LOWEST_ROW) for each in range(VIEW.rows)]
    assert row.tolist() == pytest.approx(expected) and expected[-3] == LOWEST_ROW


def test_every_class_that_varies_exists():
    assert set(VARIED) <= set(COMMON15.classes)


@pytest.mark.parametrize("name", ["road", "traffic-sign", "car", "building", "vegetation", "fence"])
def test_remission_of_some_classes_is_not_read(name):
    one, network = scene(), painter()
    segments = torch.zeros_like(one.probabilities)
    segments[:, COMMON15.id_of(name)] = 1
    brighter = one.channels.clone()
    brighter[:, 4] *= 0.5
    scenes = [replace(one, probabilities=segments, channels=channels) for channels in (one.channels, brighter)]
    assert torch.equal(*(painted(network, each) for each in scenes)) == (name in {"building", "vegetation", "fence"})


def test_which_classes_these_are_is_a_setting():
    assert build("scene-painter", unread=["car"], **SMALL).unread == (COMMON15.id_of("car"),)


def test_what_is_painted_is_raised_to_a_power_and_cut_out_against_the_sky():
    one = scene()
    found, raised = outlined(one, 2.0), sharpened(one.probabilities, 2.0)
    sky = COMMON15.id_of("sky")
    assert torch.allclose(found.sum(1), torch.ones(()), atol=1e-5)
    assert not torch.allclose(found[:, sky], raised[:, sky], atol=0.01)
    assert torch.allclose(found[:, 1] / found[:, 2], raised[:, 1] / raised[:, 2], rtol=1e-3)


def test_no_weave():
    """A flat scene is painted flat: pixel shuffles would show the four pixels of each larger one."""
    network = painter()
    inputs, fine = torch.ones(1, 31, 32, 64), torch.zeros(1, 3, 64, 128)
    with torch.inference_mode():
        found = network(*framed(inputs, fine), torch.tensor([[1.0, 0]]), torch.zeros(1, 3))[0, :, 24:40]
    assert torch.allclose(found, found[..., :1, :1].expand_as(found), atol=1e-5)


def test_the_last_rows_are_painted_as_those_above_them(monkeypatch):
    network, inputs, fine_noise = painter(), torch.ones(1, 31, 64, 64), torch.zeros(1, 3, 128, 128)

    def border() -> float:
        with torch.inference_mode():
            image = network(*framed(inputs, fine_noise), torch.tensor([[1.0, 0]]), torch.zeros(1, 3))
        assert image.shape == (1, 3, 128, 128)
        return (image[:, :, -1] - image[:, :, -30]).abs().max().item()

    with_foot = border()
    for name in ("FOOT", "LEAST_FOOT"):
        monkeypatch.setattr(scene_painter, name, 0)
    monkeypatch.setattr(layers, "INPUTS_FRAME", (0, layers.ENDS))
    monkeypatch.setattr(layers, "NOISE_FRAME", (0, layers.ENDS))
    assert 5 * with_foot < border()


def test_parts_are_joined_with_their_channels_last():
    generator = torch.Generator().manual_seed(6)
    parts = [torch.randn(2, channels, 37, 12, generator=generator) for channels in (3, 1, 5)]  # rows: not whole strips
    for dtype in (torch.float32, torch.bfloat16):
        joined = layers._joined(parts, dtype)
        assert joined.dtype == dtype and joined.is_contiguous(memory_format=torch.channels_last)
        assert torch.equal(joined, torch.cat(parts, 1).to(dtype))


def test_inputs_are_framed_where_they_are_joined():
    one = scene()
    arguments = (one.probabilities, one.depth_m, one.channels, VIEW, one.T_world_sensor)
    plain, frame = layers_of(*arguments), layers_of(*arguments, frame=True)
    for found, expected, rows in zip(frame, plain, (16, 4), strict=True):
        below = torch.cat([expected, expected[:, :, -1:].repeat(1, 1, rows, 1)], 2)
        assert torch.equal(found, torch.cat([below[..., -2:], below, below[..., :2]], 3))
        assert found.is_contiguous(memory_format=torch.channels_last)
    for found, expected in zip(framed(*plain), frame, strict=True):
        assert torch.equal(found, expected)


def test_halving_takes_the_mean_of_four_pixels():
    x = torch.randn(2, 5, 6, 8)
    torch.testing.assert_close(scene_painter._halved(x), torch.nn.functional.avg_pool2d(x, 2))


def test_twice_repeats_each_pixel():
    image = torch.arange(6).view(1, 2, 3)
    assert torch.equal(twice(image), image.repeat_interleave(2, -2).repeat_interleave(2, -1))
