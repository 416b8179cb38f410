"""Panoramas smoothed by those before: moved over by pose and distance, averaged where both agree."""

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.labels import COMMON15
from lidar2pano.memory import MOST, PreviousFrame, smoothed
from lidar2pano.views import View

VIEW = View(rows=24, columns=96, up=0.24, down=-0.2836, kind="cylinder", origin=(0.3, 0.1, -0.1))
ROAD, CAR, SKY = (COMMON15.id_of(name) for name in ("road", "car", "sky"))
STILL = torch.eye(4, dtype=torch.float64)


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
        distance_m=torch.full((rows, columns), 10.0) if distance_m is None else distance_m,
        count=torch.full((rows, columns), count),
        T_world_sensor=pose,
    )


def noise(seed):
    return torch.rand(1, 3, 2 * VIEW.rows, 2 * VIEW.columns, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_a_sensor_that_stands_averages_all_its_images():
    images = [noise(seed) for seed in range(4)]
    memory = frame(images[0])
    for image in images[1:]:
        memory = smoothed(frame(image), memory, VIEW)
    assert torch.allclose(memory.image, torch.stack(images).mean(0), atol=1e-3)
    assert (memory.count == 4).all()


def test_the_newest_image_never_weighs_less_than_one_of_most():
    memory = smoothed(frame(noise(0)), frame(noise(1), count=100.0), VIEW)
    assert (memory.count == MOST).all()
    assert torch.allclose(memory.image, noise(1) + (noise(0) - noise(1)) / MOST, atol=1e-5)


def test_what_was_found_is_moved_over_a_turn_and_across_the_seam():
    """After a turn to the left by 7 columns, everything stands 7 columns further right."""
    before = noise(2)
    now = torch.roll(before, 14, dims=3)
    ids = torch.tensor([ROAD, CAR, SKY], dtype=torch.uint8)[torch.arange(96) * 3 // 96].expand(24, -1)
    memory = smoothed(frame(now, turned(7), torch.roll(ids, 7, dims=1)), frame(before, ids=ids), VIEW)
    assert (memory.count == 2).all()
    assert (memory.image - now).abs().max() < 1e-3
    other = smoothed(frame(now, turned(-7)), frame(before), VIEW)
    assert (other.image - now).abs().mean() > 0.1, "a turn the other way does not fit"


def test_a_step_forward_carries_by_distance():
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
    one = frame(before[0], distance_m=before[1].float())
    memory = smoothed(frame(torch.zeros_like(now[0]), pose, distance_m=now[1].float()), one, VIEW)
    averaged = memory.count == 2
    assert averaged.float().mean() > 0.9
    there = averaged.repeat_interleave(2, 0).repeat_interleave(2, 1)
    moved, right, unmoved = 2 * memory.image[0, 0], now[0][0, 0], before[0][0, 0]
    assert (moved - right)[there].abs().mean() < 0.2 * (unmoved - right)[there].abs().mean()


@pytest.mark.parametrize("what", ["ids", "distance_m"])
def test_where_something_changed_the_image_begins_again(what):
    new = {"ids": torch.full((24, 96), ROAD, dtype=torch.uint8), "distance_m": torch.full((24, 96), 10.0)}
    new[what][5:9, 40:60] = {"ids": CAR, "distance_m": 5}[what]
    memory = smoothed(frame(noise(0), **new), frame(noise(1)), VIEW)
    assert (memory.count[5:9, 40:60] == 1).all() and memory.count[12:, :].min() == 2
    assert torch.equal(memory.image[..., 10:18, 80:120], noise(0)[..., 10:18, 80:120])


def test_the_sky_is_smoothed_by_the_turn_alone():
    ids, far = torch.full((24, 96), SKY, dtype=torch.uint8), torch.full((24, 96), torch.inf)
    pose = turned(3)
    pose[:3, 3] += torch.tensor([5.0, 0.0, 0.0])
    before = noise(4)
    now = torch.roll(before, 6, dims=3)
    memory = smoothed(frame(now, pose, ids, far), frame(before, STILL, ids, far), VIEW)
    assert (memory.count == 2).all() and (memory.image - now).abs().max() < 1e-3
