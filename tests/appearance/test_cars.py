from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import car_street
from car_street import ABOVE_M, CAR, FAR_M, ROAD, WALL
from lidar2pano.appearance import cars as module
from lidar2pano.appearance.cars import BLUE, BRIGHTEST, RED, SHADE, TYRE, Boxes, Classes, WholeCars, _paint, whole_cars
from lidar2pano.scene.surfaces import slopes
from lidar2pano.views import VIEWS, View

VIEW = replace(VIEWS["panorama"].scaled(0.375), origin=(0.0, 0.0, 0.0))
POLE, TRUCK = 3, 4
IDS = Classes(CAR, others=(TRUCK,), ground=(ROAD,))
LIKELY = 0.85
PLACES = ((-6.0, 5.0, 0.3), (3.0, 3.0, 0.5), (12.0, -6.0, 1.2), (-9.0, -0.5, math.pi))  # the last one is on the seam


def street(*places: tuple[float, float, float], view: View = VIEW) -> tuple[torch.Tensor, torch.Tensor]:
    return car_street.street(*places, view=view)


def probabilities(ids: torch.Tensor) -> torch.Tensor:
    """(1, 5, H, W) of a network that is nearly sure, and second of all believes in walls."""
    others = torch.where(ids == WALL, ROAD, WALL)
    found = torch.full((5, *ids.shape), 0.005)
    found.scatter_(0, ids[None], LIKELY).scatter_(0, others[None], 1 - LIKELY - 3 * 0.005)
    return found[None]


def completed(
    ids: torch.Tensor,
    radius_m: torch.Tensor,
    pose: np.ndarray | None = None,
    view: View = VIEW,
    earlier: Boxes | None = None,
) -> WholeCars:
    return completed_scene(probabilities(ids), radius_m, pose, view, earlier)


def completed_scene(
    segments: torch.Tensor,
    radius_m: torch.Tensor,
    pose: np.ndarray | None = None,
    view: View = VIEW,
    earlier: Boxes | None = None,
) -> WholeCars:
    depth_m = radius_m * torch.sqrt(1 + slopes(view)[:, None] ** 2)
    return whole_cars(segments, depth_m[None], radius_m[None], torch.tensor([ABOVE_M]), view, pose, IDS, earlier)


def overlap(one: torch.Tensor, other: torch.Tensor) -> float:
    return float((one & other).sum() / (one | other).sum())


def holed(ids: torch.Tensor, radius_m: torch.Tensor, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """What is left of cars when patches of them are taken for a wall, at distances of what is behind."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, ids.shape[0] // 4, ids.shape[1] // 4, generator=generator) < 0.15
    patches = coarse.repeat_interleave(4, 2).repeat_interleave(4, 3)[0, 0] & (ids == CAR)
    return torch.where(patches, WALL, ids), torch.where(patches, radius_m + 3, radius_m)


@pytest.mark.parametrize("place", PLACES)
def test_a_car_with_holes_becomes_whole(place):
    ids, radius_m = street(place)
    torn, torn_m = holed(ids, radius_m)
    true = ids == CAR
    whole = completed(torn, torn_m)
    drawn = whole.segments[0].argmax(0) == CAR
    assert overlap(torn == CAR, true) < 0.9 < overlap(drawn, true)
    both = drawn & true
    depth_m = radius_m * torch.sqrt(1 + slopes(VIEW)[:, None] ** 2)
    off = (whole.depth_m[0] - depth_m).abs()[both]
    assert float(off.median()) < 0.5
    assert torch.allclose(whole.segments.sum(1), torch.ones(1, *ids.shape), atol=1e-5)
    known = whole.tones[0, :, whole.segments[0, CAR] == 1]
    assert known.isfinite().all()


def test_what_is_far_from_cars_stays_as_it_is():
    ids, radius_m = street(PLACES[0])
    whole, far = completed(ids, radius_m), slice(VIEW.columns // 2, VIEW.columns)  # the car is to the left
    assert torch.equal(whole.segments[..., far], probabilities(ids)[..., far])
    assert torch.equal(whole.depth_m[0, :, far], (radius_m * torch.sqrt(1 + slopes(VIEW)[:, None] ** 2))[:, far])
    assert whole.tones[..., far].isnan().all()
    empty_ids, empty_m = street()
    empty = completed(empty_ids, empty_m)
    assert torch.equal(empty.segments, probabilities(empty_ids)) and empty.tones.isnan().all()


def test_bulges_of_a_car_show_what_is_behind():
    ids, radius_m = street(PLACES[0])
    column = int((ids == CAR).nonzero()[:, 1].float().mean())
    roof = int((ids[:, column] == CAR).nonzero().min())
    bulge = torch.zeros_like(ids, dtype=torch.bool)
    bulge[roof - 12 : roof - 1, column - 9 : column + 9] = True
    segments = probabilities(ids)
    segments[0, :, bulge] = torch.tensor([0.05, 0.4, 0.3, 0.0, 0.25])[:, None]
    bulged_m = torch.where(bulge, 6.0, radius_m)
    depth_m = bulged_m * torch.sqrt(1 + slopes(VIEW)[:, None] ** 2)
    whole = whole_cars(segments, depth_m[None], bulged_m[None], torch.tensor([ABOVE_M]), VIEW, None, IDS)
    left = bulge & (whole.segments[0].argmax(0) != CAR)
    assert left.sum() > 0.8 * bulge.sum()
    assert (whole.segments[0].argmax(0)[left] == WALL).all()
    assert (whole.depth_m[0][left] > 0.99 * FAR_M).all()


def test_what_stands_before_a_car_hides_it():
    ids, radius_m = street(PLACES[0])
    middle = int((ids == CAR).nonzero()[:, 1].float().mean())
    pole = torch.zeros_like(ids, dtype=torch.bool)
    pole[:, middle : middle + 4] = True
    whole = completed(torch.where(pole, POLE, ids), torch.where(pole, 3.0, radius_m))
    assert (whole.segments[0].argmax(0)[pole] == POLE).all()
    assert float(whole.depth_m[0][pole].max()) < 3.3
    beside = torch.zeros_like(pole)
    beside[:, middle - 20 : middle + 24] = (ids == CAR)[:, middle - 20 : middle + 24]
    drawn = whole.segments[0].argmax(0) == CAR
    assert overlap(drawn & beside, beside & ~pole) > 0.85


def labelled_otherwise(there: torch.Tensor, label: int, sure: float) -> torch.Tensor:
    """The ids (H, W) of `whole_cars` where a part of a car is labelled otherwise."""
    ids, radius_m = street(PLACES[0])
    segments = probabilities(ids)
    segments[0, :, there] = (1 - sure) / 4
    segments[0, label, there] = sure
    return completed_scene(segments, radius_m).segments[0].argmax(0)


def part_of_a_car(rows: slice, columns: slice) -> torch.Tensor:
    """Pixels (H, W) bool of the car at PLACES[0] that are in hundredths of its height and width."""
    car = street(PLACES[0])[0] == CAR
    part = torch.zeros_like(car)
    (top, bottom), (left, right) = (car.any(axis).nonzero()[[0, -1], 0].tolist() for axis in (1, 0))
    row, column = (
        slice(*(begin + (end - begin) * at // 100 for at in (share.start, share.stop)))
        for share, begin, end in ((rows, top, bottom), (columns, left, right))
    )
    part[row, column] = True
    return part & car


def test_most_cars_are_grey_and_coloured_ones_are_not_bright():
    paint = _paint(torch.rand(2, 20_000, generator=torch.Generator().manual_seed(0)) * 500)
    grey, hue = paint.mean(0), paint[0] - paint[2]
    assert paint.min() >= min(*RED, *BLUE) and paint.max() <= BRIGHTEST
    assert 0.5 < (hue.abs() < 1e-6).float().mean() < 0.8
    for share in ((hue > 0.2).float().mean(), (hue < -0.2).float().mean()):
        assert 0.05 < share < 0.15
    assert grey[hue.abs() > 0.35].max() < 0.05 and grey[hue == 0].std() > 0.1


@pytest.mark.parametrize(("sure", "covered"), [(0.97, False), (0.9, True)])
def test_a_car_does_not_cover_what_is_surely_ground(sure, covered):
    there = part_of_a_car(slice(60, 80), slice(40, 60))
    found = labelled_otherwise(there, ROAD, sure)
    assert there.sum() > 30 and overlap(found == CAR, street(PLACES[0])[0] == CAR) > 0.8
    assert (float((found[there] == CAR).float().mean()) > 0.9) == covered
    assert covered or not (found[there] == CAR).any()


def test_a_lorry_taken_for_a_car_below_keeps_its_upper_part():
    there = part_of_a_car(slice(0, 30), slice(0, 100))
    found = labelled_otherwise(there, TRUCK, LIKELY)
    assert there.sum() > 30 and (found == CAR).any()
    assert (found[there] == TRUCK).all()


def test_the_road_beside_a_car_is_in_its_shadow():
    ids, radius_m = street(PLACES[0])
    whole = completed(ids, radius_m)
    tones = whole.tones[0]
    shadow = (whole.segments[0].argmax(0) == ROAD) & tones[0].isfinite()
    assert shadow.sum() > 50 and float(tones[0][shadow].min()) == pytest.approx(-SHADE, abs=0.05)
    assert float(radius_m[shadow].max()) < 9


def test_a_scene_that_is_turned_gives_turned_cars():
    ids, radius_m = holed(*street(*PLACES))
    shift = VIEW.columns // 12  # by a multiple of the steps in which rectangles are turned
    angle = -shift * 2 * math.pi / VIEW.columns  # scene and columns go to the right, so the world is to the left
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    straight, turned = completed(ids, radius_m), completed(ids.roll(shift, 1), radius_m.roll(shift, 1), pose)
    same = straight.segments[0].argmax(0).roll(shift, 1) == turned.segments[0].argmax(0)
    assert same.float().mean() > 0.995
    one, other = straight.tones[0].roll(shift, 2), turned.tones[0]
    both = one.isfinite() & other.isfinite()
    assert ((one - other).abs()[both] < 0.05).float().mean() > 0.85


def colour_of_a_parked_car(x: float, moved: float) -> torch.Tensor:
    """The tone (3,) of most of a car that stands at (x, 4) in the world, where a sensor has moved along it."""
    pose = np.eye(4)
    pose[:2, 3] = moved, -moved / 4
    ids, radius_m = street((x - moved, 4.0 + moved / 4, 0.0))
    tones = completed(ids, radius_m, pose).tones[0]
    return tones[:, (ids == CAR) & tones[0].isfinite()].median(1).values


def test_parked_cars_keep_their_colours_when_the_sensor_moves():
    """But for one in five, where paint changes from grey to a colour within the half metre that boxes waver."""
    changes = []
    for x in (6.0, 7.0, 8.0, 9.0, 10.0):
        first, *others = (colour_of_a_parked_car(x, moved) for moved in (0.0, 2.0, 4.0))
        changes += [float((other - first).abs().max()) for other in others]
    assert np.median(changes) < 0.1 and np.mean(np.array(changes) < 0.25) >= 0.8


def placed_around(x: float, y: float, heading: float) -> tuple[np.ndarray, tuple[float, float, float]]:
    """A pose, and where the car that stands at (20, 9), heading 0.4 in the world, is around it."""
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    pose[:2, 3] = x, y
    place = pose[:2, :2].T @ np.subtract((20.0, 9.0), (x, y))
    return pose, (float(place[0]), float(place[1]), 0.4 - heading)


def boxes_of_a_drive(followed: bool) -> list[Boxes]:
    """The box of one car, from five places, each with the one before or without."""
    boxes: list[Boxes] = []
    for step in range(5):
        pose, place = placed_around(10 + step, 2 + step / 4, 0.1 * step)
        ids, radius_m = holed(*street(place), seed=step)
        whole = completed(ids, radius_m, pose, earlier=boxes[-1] if boxes and followed else None)
        assert whole.boxes is not None
        assert overlap(whole.segments[0].argmax(0) == CAR, street(place)[0] == CAR) > (0.85 if followed else 0.8)
        assert (whole.boxes.middle[:, 0] - torch.tensor([20.0, 9.0])).norm() < 0.75
        boxes.append(whole.boxes)
    return boxes


def test_a_car_that_stands_keeps_its_box_while_the_sensor_moves():
    followed, alone = (
        {tuple(one.middle[:, 0].round(decimals=4).tolist()) for one in boxes_of_a_drive(each)} for each in (True, False)
    )
    assert len(followed) <= 3 < len(alone)


def test_a_car_that_drove_on_gets_a_new_box():
    there, onward = (6.0, 4.0, 0.0), (7.2, 4.0, 0.0)
    earlier = completed(*street(there)).boxes
    assert earlier is not None
    ids, radius_m = street(onward)
    alone, followed = completed(ids, radius_m), completed(ids, radius_m, earlier=earlier)
    assert torch.equal(alone.segments, followed.segments) and torch.equal(alone.depth_m, followed.depth_m)


def test_a_box_far_in_the_world_stays_exact():
    pose, place = placed_around(10, 2, 0.3)
    ids, radius_m = street(place)
    far = pose.copy()
    far[:2, 3] += 4e6, 5e6
    here, there = completed(ids, radius_m, pose).boxes, completed(ids, radius_m, far).boxes
    assert here is not None and there is not None
    offset = torch.tensor([[4e6], [5e6]], dtype=torch.float64)
    assert torch.allclose(there.middle - offset, here.middle, atol=1e-6)


def test_cars_that_stand_apart_differ_in_colour():
    ids, radius_m = street(*PLACES)
    tones = completed(ids, radius_m).tones[0]
    colours = set()
    for place in PLACES:
        own = (street(place)[0] == CAR) & tones[0].isfinite()
        colours.add(tuple(np.round(tones[:, own].median(1).values.tolist(), 1)))
    assert len(colours) >= 3


def test_a_row_of_parked_cars_is_not_one_long_car():
    row = [(x, 5.0, 0.0) for x in (-6.8, -2.3, 2.2, 6.7)]
    ids, radius_m = street(*row)
    whole = completed(ids, radius_m)
    tyres = ((whole.tones[0, 0] == TYRE) & (radius_m < 12)).any(0)
    wheels = int((tyres & ~tyres.roll(1)).sum())
    assert 6 <= wheels <= 9
    assert overlap(whole.segments[0].argmax(0) == CAR, ids == CAR) > 0.85


def test_no_more_cars_are_drawn_than_the_nearest(monkeypatch):
    monkeypatch.setattr("lidar2pano.appearance.cars.MOST", 1)
    ids, radius_m = street(*PLACES)
    tones = completed(ids, radius_m).tones[0, 0]
    drawn = (tones.isfinite() & (ids == CAR)).any(0)
    near, farther = ((street(*places)[0] == CAR).any(0) for places in (PLACES[1:2], (PLACES[0], *PLACES[2:])))
    assert drawn.any() and not (drawn & farther & ~near).any()


def beside(view: View = VIEW) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A car 1.4 m beside the sensor, whose windows show its far side or a wall; and whether a pixel shows it."""
    ids, radius_m = street((0.4, 2.3, 0.05), view=view)
    car = (ids == CAR) & (radius_m < 6)
    height_m = radius_m * slopes(view)[:, None] + ABOVE_M
    window = car & (height_m > 1.0) & (height_m < 1.35)
    column = torch.arange(view.columns)
    radius_m = torch.where(window & (column % 90 < 45), radius_m + 1.5, radius_m)  # of 1728: 9 degrees and a half
    return ids, torch.where(window & (column % 90 >= 70), 7.0, radius_m), car


def test_a_car_beside_the_sensor_is_one_car_and_nothing_is_left_around_it():
    ids, radius_m, car = beside()
    columns = car.any(0)
    assert columns.sum() > VIEW.columns / 4 and radius_m[-1][columns].min() < 1.6, "its foot is not in view"
    whole = completed(ids, radius_m)
    assert whole.boxes is not None and whole.boxes.middle.shape[1] == 1
    found = whole.segments[0].argmax(0) == CAR
    assert overlap(found, car) > 0.8
    assert whole.tones[0, 0][found].isfinite().float().mean() > 0.95, "hardly anything is left of it but its body"
    assert (whole.boxes.ahead[1].abs() < 0.35).all(), "one sees its side, along which it stands"


def test_a_body_that_covers_too_little_is_not_drawn(monkeypatch):
    ids, radius_m = street(PLACES[0])
    monkeypatch.setattr(module, "COVERED", 0.999)
    whole = completed(ids, radius_m)
    assert torch.equal(whole.segments, probabilities(ids)) and whole.tones.isnan().all()


def test_a_part_of_a_panorama_is_completed_alike():
    ids, radius_m = holed(*street(PLACES[0]))
    columns = (ids == CAR).any(0).nonzero()[:, 0]
    start, wide = int(columns.min()) - 60, int(columns.max() - columns.min()) + 120
    part = slice(start, start + wide)
    whole = completed(ids, radius_m).segments[0, :, :, part].argmax(0) == CAR
    alone = completed(ids[:, part], radius_m[:, part], view=VIEW.window(start, wide)).segments[0].argmax(0) == CAR
    assert overlap(whole, alone) > 0.97


def test_scenes_of_a_batch_do_not_meet():
    one, other = holed(*street(PLACES[0])), holed(*street(PLACES[1]))
    segments = torch.cat([probabilities(one[0]), probabilities(other[0])])
    radius_m = torch.stack([one[1], other[1]])
    depth_m = radius_m * torch.sqrt(1 + slopes(VIEW)[:, None] ** 2)
    both = whole_cars(segments, depth_m, radius_m, torch.tensor([ABOVE_M] * 2), VIEW, None, IDS)
    for number, scene in enumerate((one, other)):
        assert torch.equal(both.segments[number], completed(*scene).segments[0])
