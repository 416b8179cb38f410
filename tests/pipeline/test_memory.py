"""Panoramas smoothed by those before: moved over by pose and distance, averaged where both agree."""

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.labels import COMMON15
from lidar2pano.memory import DOUBT, LEAST_IMAGES, MOST, PreviousFrame, Surroundings, fused, smoothed
from lidar2pano.views import View
from poses import somewhere

VIEW = View(rows=24, columns=96, up=0.24, down=-0.2836, kind="cylinder", origin=(0.3, 0.1, -0.1))
NAMES = ("road", "car", "sky", "sidewalk", "vegetation", "pole")
ROAD, CAR, SKY, SIDEWALK, TREE, POLE = map(COMMON15.id_of, NAMES)
STILL = torch.eye(4, dtype=torch.float64)
MEASURED = torch.ones(VIEW.rows, VIEW.columns, dtype=torch.bool)
UNMEASURED = torch.zeros_like(MEASURED)
WORLDS = [pytest.param(STILL, id="world"), pytest.param(torch.from_numpy(somewhere()), id="another-world")]


def turned(columns):
    """The pose of a sensor that has turned left by so many columns about the point that looks."""
    angle = columns * 2 * np.pi / VIEW.columns
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    origin = torch.tensor(VIEW.origin, dtype=torch.float64)
    pose[:3, 3] = origin - pose[:3, :3] @ origin
    return pose


def frame(image, pose=STILL, ids=None, distance_m=None, count=1.0):
    rows, columns = VIEW.rows, VIEW.columns
    return PreviousFrame(
        image=image,
        ids=torch.full((rows, columns), ROAD, dtype=torch.uint8) if ids is None else ids,
        parallax_distance_m=torch.full((rows, columns), 10.0) if distance_m is None else distance_m,
        count=torch.full((rows, columns), count),
        T_world_sensor=pose,
    )


def noise(seed):
    return torch.rand(1, 3, 2 * VIEW.rows, 2 * VIEW.columns, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_a_sensor_that_stands_averages_all_its_images():
    images = [noise(seed) for seed in range(8)]
    memory, mean = frame(images[0]), images[0]
    for number, image in enumerate(images[1:], start=1):
        memory = smoothed(frame(image), memory, VIEW)
        before = min(max(number, LEAST_IMAGES), MOST - 1)
        mean = (mean * before + image) / (before + 1)
        assert torch.allclose(memory.image, mean, atol=1e-3)
        assert (memory.count == min(number + 1, MOST)).all()


def test_the_newest_image_never_weighs_less_than_one_of_most():
    memory = smoothed(frame(noise(0)), frame(noise(1), count=100.0), VIEW)
    assert (memory.count == MOST).all()
    assert torch.allclose(memory.image, noise(1) + (noise(0) - noise(1)) / MOST, atol=1e-3)


@pytest.mark.parametrize("world", WORLDS)
def test_what_was_found_is_moved_over_a_turn_and_across_the_seam(world):
    """After a turn to the left by 7 columns, everything stands 7 columns further right."""
    before = noise(2)
    now = torch.roll(before, 14, dims=3)
    ids = torch.tensor([ROAD, CAR, SKY], dtype=torch.uint8)[torch.arange(96) * 3 // 96].expand(24, -1)
    previous = frame(before, world, ids)
    memory = smoothed(frame(now, world @ turned(7), torch.roll(ids, 7, dims=1)), previous, VIEW)
    assert (memory.count == 2).all()
    assert (memory.image - now).abs().max() < 1e-3
    other = smoothed(frame(now, world @ turned(-7)), previous, VIEW)
    assert (other.image - now).abs().mean() > 0.1, "a turn the other way does not fit"


@pytest.mark.parametrize("world", WORLDS)
def test_a_step_forward_carries_by_distance(world):
    """Three walls of a place: what is smoothed is the pattern on them, not where it was in the image."""

    def look(origin):
        """A cylinder of 12 m around the world's origin, seen from `origin`: (pattern, distance)."""
        rays = directions(VIEW).double()
        flat, start = rays[..., :2], torch.tensor(origin[:2], dtype=torch.float64)
        a, b, c = (flat**2).sum(-1), (flat * start).sum(-1), (start**2).sum() - 144
        far = (-b + (b**2 - a * c).sqrt()) / a
        place = start + far[..., None] * flat
        pattern = torch.sin(3 * torch.atan2(place[..., 1], place[..., 0]))
        return pattern.float()[None, None].expand(1, 3, -1, -1).repeat_interleave(2, 2).repeat_interleave(2, 3), far

    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = 2.0
    origin = np.array(VIEW.origin)
    before, now = look(origin), look(origin + [2, 0, 0])
    one = frame(before[0], world, distance_m=before[1].float())
    memory = smoothed(frame(torch.zeros_like(now[0]), world @ pose, distance_m=now[1].float()), one, VIEW)
    averaged = memory.count == 2
    assert averaged.float().mean() > 0.9
    there = averaged.repeat_interleave(2, 0).repeat_interleave(2, 1)
    moved, right, unmoved = memory.image[0, 0] * (1 + 1 / LEAST_IMAGES), now[0][0, 0], before[0][0, 0]
    assert (moved - right)[there].abs().mean() < 0.2 * (unmoved - right)[there].abs().mean()


@pytest.mark.parametrize(
    ("class_id", "distance_m", "count", "weight"),
    [(CAR, 5.0, 1, 0.0), (CAR, 10.0, 1, 0.75), (POLE, 5.0, 2, 0.75), (ROAD, 5.0, 2, 0.75), (TREE, 5.0, 2, 0.75)],
)
def test_a_class_that_may_move_begins_again(class_id, distance_m, count, weight):
    """It is gone at once at another distance, where it would leave a trail; what stands is averaged."""
    ids, now_m = torch.full((24, 96), ROAD, dtype=torch.uint8), torch.full((24, 96), 10.0)
    ids[5:9, 40:60], now_m[5:9, 40:60] = class_id, distance_m
    now = frame(noise(0), ids=ids, distance_m=now_m)
    for one, other in ((now, frame(noise(1))), (frame(noise(0)), now._replace(image=noise(1)))):
        memory = smoothed(one, other, VIEW)
        assert (memory.count[5:9, 40:60] == count).all() and memory.count[12:, :].min() == 2
        mixed = torch.lerp(noise(0), noise(1), weight)
        assert torch.allclose(memory.image[..., 10:18, 80:120], mixed[..., 10:18, 80:120], atol=1e-3)


def test_a_car_whose_distance_wavers_is_averaged():
    ids = torch.full((24, 96), CAR, dtype=torch.uint8)
    near = frame(noise(0), ids=ids, distance_m=torch.full((24, 96), 5.0))
    assert (smoothed(near, frame(noise(1), ids=ids), VIEW).count == 2).all()


def test_the_sky_is_smoothed_by_the_turn_alone():
    ids, far = torch.full((24, 96), SKY, dtype=torch.uint8), torch.full((24, 96), torch.inf)
    pose = turned(3)
    pose[:3, 3] += torch.tensor([5.0, 0.0, 0.0])
    before = noise(4)
    now = torch.roll(before, 6, dims=3)
    memory = smoothed(frame(now, pose, ids, far), frame(before, STILL, ids, far), VIEW)
    assert (memory.count == 2).all() and (memory.image - now).abs().max() < 1e-3


def test_another_class_of_the_same_surface_goes_on_unless_it_may_move():
    ids = torch.full((24, 96), ROAD, dtype=torch.uint8)
    ids[5:9, 40:60], ids[15:19, 40:60] = SIDEWALK, CAR
    memory = smoothed(frame(noise(0), ids=ids), frame(noise(1)), VIEW)
    assert (memory.count[5:9, 40:60] == 2).all() and (memory.count[15:19, 40:60] == 1).all()


def test_what_is_warped_again_and_again_stays_detailed():
    """Half a pixel left and right, twenty times: a pattern of eight pixels keeps most of its contrast."""
    pattern = torch.sin(torch.arange(2 * VIEW.columns) * 2 * np.pi / 8).expand(1, 3, 2 * VIEW.rows, -1).contiguous()
    memory, nothing = frame(pattern, count=100.0), torch.zeros_like(pattern)
    for number in range(20):
        memory = smoothed(frame(nothing, turned(0.25 if number % 2 == 0 else 0)), memory, VIEW)
    contrast = memory.image[..., VIEW.rows, :].std() / pattern.std() / (1 - 1 / MOST) ** 20
    assert contrast > 0.8


# --- classes and depths -----------------------------------------------------------------------------------------------


def around(share, depth_m=10.0, pose=STILL, count=1.0, class_id=CAR, measured=MEASURED):
    """Surroundings of road and, with probability `share` (H, W), another class."""
    share = torch.as_tensor(share).expand(VIEW.rows, VIEW.columns).float()
    segments = torch.zeros(1, len(COMMON15), VIEW.rows, VIEW.columns)
    segments[0, class_id], segments[0, ROAD] = share, 1 - share
    depth_m = torch.as_tensor(depth_m).float().expand(1, VIEW.rows, VIEW.columns)
    return Surroundings(segments, depth_m, torch.full((VIEW.rows, VIEW.columns), count), measured, pose)


def test_classes_are_averaged_while_a_sensor_stands_and_depths_are_the_newest():
    memory, mean = around(0.2, 10.0), 0.2
    for number, (share, depth_m) in enumerate(((0.6, 11.0), (0.1, 9.0), (0.4, 10.5)), start=1):
        memory = fused(around(share, depth_m), memory, VIEW)
        mean = (mean * number + share) / (number + 1)
        assert (memory.depth_m == depth_m).all()
    assert torch.allclose(memory.probabilities[0, CAR], torch.tensor(mean), atol=1e-4)
    assert (memory.count == 4).all()
    assert torch.equal(memory.T_world_sensor, STILL)


def test_the_newest_scan_never_weighs_less_than_one_of_most():
    memory = fused(around(0.6), around(0.0, count=100.0), VIEW)
    assert (memory.count == MOST).all() and torch.allclose(
        memory.probabilities[0, CAR], torch.tensor(0.6 / MOST), atol=1e-5
    )


@pytest.mark.parametrize("world", WORLDS)
def test_classes_are_moved_over_a_turn_and_across_the_seam(world):
    """After a turn to the left by 7 columns, everything stands 7 columns further right."""
    share = torch.rand(VIEW.rows, VIEW.columns, generator=torch.Generator().manual_seed(0)) * 0.5
    now = share.roll(7, 1)
    memory = fused(around(now, pose=world @ turned(7)), around(share, pose=world), VIEW)
    assert (memory.count == 2).all() and torch.allclose(memory.probabilities[0, CAR], now, atol=1e-3)
    other = fused(around(now, pose=world @ turned(-7)), around(share, pose=world), VIEW)
    assert (other.probabilities[0, CAR] - now).abs().mean() > 0.05, "a turn the other way does not fit"


def cylinder_m(origin):
    """Distances (H, W) from `origin`, in the world, to a cylinder of 12 m about the world's z axis."""
    flat, start = directions(VIEW).double()[..., :2], torch.tensor(origin[:2], dtype=torch.float64)
    a, b, c = (flat**2).sum(-1), (flat * start).sum(-1), (start**2).sum() - 144
    return ((-b + (b**2 - a * c).sqrt()) / a).float()


@pytest.mark.parametrize("world", WORLDS)
def test_walls_are_the_same_after_a_step(world):
    """Two metres ahead they are elsewhere, and at other distances; an error of 8 % does not part them."""
    pose, origin = torch.eye(4, dtype=torch.float64), np.array(VIEW.origin)
    pose[0, 3] = 2.0
    before_m, now_m = cylinder_m(origin), cylinder_m(origin + [2, 0, 0])
    assert (before_m / now_m - 1).abs().max() > 0.1
    for error in (1.0, 1.08):
        memory = fused(around(0.2, error * now_m, world @ pose), around(0.2, before_m, world), VIEW)
        assert (memory.count == 2).float().mean() > 0.9
        assert torch.equal(memory.depth_m[0], error * now_m)


def test_what_is_at_another_distance_begins_again():
    depth_m = torch.full((VIEW.rows, VIEW.columns), 10.0)
    depth_m[5:9, 40:60] = 5
    memory = fused(around(0.6, depth_m), around(0.0), VIEW)
    assert (memory.count[5:9, 40:60] == 1).all() and (memory.count[12:] == 2).all()
    assert torch.equal(memory.probabilities[..., 5:9, 40:60], around(0.6).probabilities[..., 5:9, 40:60])
    assert torch.equal(memory.depth_m[0, 5:9, 40:60], depth_m[5:9, 40:60])


def test_the_sky_moves_by_the_turn_alone_and_keeps_its_depth():
    pose = turned(3)
    pose[:3, 3] += torch.tensor([5.0, 0.0, 0.0])
    share = 0.6 + 0.3 * torch.rand(VIEW.rows, VIEW.columns, generator=torch.Generator().manual_seed(1))
    now = share.roll(3, 1)
    memory = fused(around(now, 80.0, pose, class_id=SKY), around(share, 70.0, class_id=SKY), VIEW)
    assert (memory.count == 2).all() and torch.allclose(memory.probabilities[0, SKY], now, atol=1e-3)
    assert (memory.depth_m == 80).all()


def test_what_may_be_sky_moves_less():
    """The mean of inverse distances; not where the scan measured one, nor where it is the sky."""
    share = torch.full((VIEW.rows, VIEW.columns), 0.4)
    share[:12] = 0.9
    measured = UNMEASURED.clone()
    measured[:, :48] = True
    there = around(share, 10.0, class_id=SKY, measured=measured)
    assert there.parallax_distance_m[:12].isinf().all()
    assert (there.parallax_distance_m[12:, :48] == 10).all()
    assert torch.allclose(1 / there.parallax_distance_m[12:, 48:], torch.tensor(0.6 * (1 / 10) + 0.4 * 0))


# --- what contradicts what was there ----------------------------------------------------------------------------------

CLEARED = around(1.0, 80.0, class_id=SKY, measured=UNMEASURED)


def tree(count, class_id=TREE, pose=STILL):
    """A crown at 10 m in columns 40 to 59, before the sky."""
    there = torch.zeros(VIEW.rows, VIEW.columns)
    there[:, 40:60] = 0.9
    segments = torch.zeros(1, len(COMMON15), VIEW.rows, VIEW.columns)
    segments[0, class_id], segments[0, SKY] = there, 1 - there
    depth_m = torch.where(there > 0, 10.0, 80.0)[None]
    return Surroundings(segments, depth_m, torch.full_like(there, count), UNMEASURED, pose)


def test_a_crown_stays_until_scans_without_it_outweigh_it():
    """A slow definition beside it: the mean of the probabilities, weighted by a count that falls."""
    memory, count, share, scans = tree(4.0), 4.0, 0.9, 0
    while share * 2 > 1:
        memory = fused(CLEARED, memory, VIEW)
        weight = count / (count + 1)
        share, count, scans = share * weight, count - DOUBT, scans + 1
        assert torch.allclose(memory.probabilities[0, TREE, :, 41:59], torch.tensor(share), atol=1e-3)
        if share * 2 > 1:
            assert memory.depth_m[0, :, 41:59].sub(10).abs().max() < 1e-4
    assert scans > 1 and (memory.depth_m[0, :, 41:59] == 80).all() and (memory.count[:, 41:59] == 1).all()


@pytest.mark.parametrize("what", ["measured", "car"])
def test_what_was_measured_or_may_move_does_not_stay(what):
    now = CLEARED._replace(supported=MEASURED if what == "measured" else UNMEASURED)
    memory = fused(now, tree(4.0, CAR if what == "car" else TREE), VIEW)
    assert torch.equal(memory.probabilities[..., 41:59], CLEARED.probabilities[..., 41:59])
    assert (memory.depth_m[0, :, 41:59] == 80).all() and (memory.count[:, 41:59] == 1).all()


def test_a_crown_that_stays_moves_as_the_sensor_does():
    memory = fused(around(1.0, 80.0, turned(7), class_id=SKY, measured=UNMEASURED), tree(4.0), VIEW)
    crown = memory.ids == TREE
    assert crown[:, 48:66].all() and not crown[:, :46].any() and not crown[:, 68:].any()


def test_another_depth_of_one_class_prevails_in_the_end():
    """The probabilities never change: it is `DOUBT` that uses up the count."""
    memory, farther = tree(2.0), tree(1.0)
    farther = farther._replace(depth_m=torch.where(farther.depth_m == 10, 40.0, farther.depth_m))
    depths = []
    for _ in range(6):
        memory = fused(farther, memory, VIEW)
        depths.append(float(memory.depth_m[0, 5, 50]))
    assert depths[:2] == [10.0, 10.0] and depths[-1] == pytest.approx(40)


def test_what_doubt_has_used_up_is_gone_altogether():
    """Scans that are nearly undecided never outweigh the crown: without a count, its class goes with its depth."""
    nearly = around(1.0, 80.0, class_id=SKY, measured=UNMEASURED)
    nearly.probabilities[:, SKY], nearly.probabilities[:, TREE] = 0.55, 0.45
    memory = tree(1.0)
    for scan in range(2):
        memory = fused(nearly, memory, VIEW)
        here = memory.ids[5, 50].item(), memory.depth_m[0, 5, 50].item()
        assert here == ((TREE, 10.0) if scan == 0 else (SKY, 80.0))
    assert torch.equal(memory.probabilities[..., 50], nearly.probabilities[..., 50])
