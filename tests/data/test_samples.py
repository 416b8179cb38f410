"""Training samples: what lies where, and that augmentation moves everything together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.calibration import Calibration
from lidar2pano.data.camera_pairs import FrontViewDataset
from lidar2pano.data.frames import IGNORE, Frame, SampleIndex, evenly_spaced
from lidar2pano.data.layouts import frames, frames_of
from lidar2pano.data.panorama_crops import SHIFT_PX, PanoramaDataset, enlarged, mirrored
from lidar2pano.data.range_images import RangeImageDataset, ScanAugmentation, augmented, labelled_scan
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import STAND_IN
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON14, COMMON15, SEMANTIC_KITTI
from lidar2pano.scan import (
    Scan,
    change_sensor_remission,
    drop_above,
    drop_points,
    drop_rings,
    mirror,
    mix,
    tilt,
    turn,
    vary_remission,
)
from lidar2pano.views import VIEWS
from miniature import HOUSE, ROAD, SPLITS, street, write_data_set
from miniature_video import write_video

RASTER = VIEWS["panorama"].scaled(1 / 8)


@pytest.fixture
def root(tmp_path):
    return write_data_set(tmp_path)


def test_points_without_labels_take_the_classes_that_a_camera_shows():
    # a camera a metre to the sensor's left, 100 pixels per radian: cars on its left, road on its right, sky above
    ids = np.full((200, 400), 0, np.uint8)
    ids[:, :200], ids[:50] = 13, 10
    calibration = Calibration(
        K=np.array([[100.0, 0, 199.5], [0, 100.0, 99.5], [0, 0, 1]]),
        T_camera_lidar=np.array([[0.0, -1, 0, 1], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
        size=(400, 200),
    )
    y, z = (places.ravel() for places in np.meshgrid(np.arange(2, 8, 0.04), np.arange(-1, 1, 0.04)))
    wall = np.stack([np.full_like(y, 10.0), y, z], 1)  # in the car's pixels
    places = {
        (20, 5, 0.1): "unlabeled",  # behind the wall
        (30, -5, 0): "road",
        (10, 5, 8): "unlabeled",  # in the sky
        (-10, 5, 0): "unlabeled",  # behind the camera
        (10, 50, 0): "unlabeled",  # beside its image
        (0, 0, 0): "unlabeled",  # no echo
    }
    xyz = np.concatenate([wall, list(places)]).astype(np.float32)
    scan = Scan(xyz=xyz, remission=np.zeros(len(xyz), np.float32))
    parts = {"scan": scan, "camera_labels": ids, "calibration": calibration}
    label = labelled_scan(Frame("0/000000", **parts)).label
    assert label is not None
    names = [SEMANTIC_KITTI.classes[index] for index in label]
    assert set(names[: len(wall)]) == {"car"} and names[len(wall) :] == list(places.values())
    own = np.arange(len(xyz)) % 20
    assert np.array_equal(labelled_scan(Frame("0/000000", **parts, point_labels=own)).label, own)
    with pytest.raises(InputError, match="no point labels"):
        labelled_scan(Frame("0/000000", scan=scan))


def test_frames_come_in_the_order_of_their_split(root):
    assert [frame.name for frame in frames(root, "train")] == SPLITS["train"]


def test_without_a_listing_semantic_kittis_own_splits_hold(root):
    (root / "splits.json").unlink()
    assert [frame.name for frame in frames(root, "train")] == SPLITS["train"] + SPLITS["val"]
    with pytest.raises(InputError, match="has no scan"):
        frames(root, "val")
    with pytest.raises(InputError, match="did you mean 'val'"):
        frames(root, "vall")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: (root / "splits.json").write_text("{"), "is no JSON"),
        (lambda root: (root / "splits.json").write_text('{"a": []}'), "has no split 'train'"),
        (lambda root: (root / "sequences/00/velodyne/000001.bin").unlink(), "000001.bin of split 'train' is missing"),
    ],
)
def test_a_damaged_data_set_is_reported(root, damage, message):
    damage(root)
    with pytest.raises(InputError, match=message):
        frames(root, "train")


def test_missing_and_broken_images_are_reported(root):
    frame = frames(root, "train")[0]
    (root / "sequences/00/camera_labels/000000.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="no readable image"):
        _ = frame.camera_labels
    (root / "sequences/00/image_2/000000.png").unlink()
    with pytest.raises(InputError, match="no image"):
        frames(root, "train")[0].require("image")


def test_range_samples_carry_each_points_label_to_its_pixel(root):
    samples = RangeImageDataset(root, ("train",), VIEWS["hdl64e"], columns=256)
    plain = samples[0]
    image = project(samples.scan(0), VIEWS["hdl64e"])
    assert torch.equal(plain.labels, image.spread(torch.from_numpy(samples.scan(0).label)))
    assert set(plain.labels.unique().tolist()) == {0, ROAD, HOUSE}
    assert samples[SampleIndex(0, 1)].lidar.shape == (5, 64, 256)
    assert torch.equal(samples[SampleIndex(0, 1)].lidar, samples[SampleIndex(0, 1)].lidar)
    assert not torch.equal(samples[SampleIndex(0, 1)].lidar, samples[SampleIndex(0, 2)].lidar)


def test_panorama_samples_line_scan_and_camera_up(root):
    sample = PanoramaDataset(root, ("train",), RASTER, columns=160, shift_px=8)[0]
    known = (sample.camera_labels != IGNORE) & (sample.segments > 0)
    road = sample.camera_labels == COMMON15.id_of("road")
    assert known.sum() > 100
    agree = (road == (sample.segments == ROAD))[known]
    assert agree.float().mean() > 0.8  # the made-up camera's horizon is a straight line, the fronts' foot is not
    assert (sample.depth_m > 0).sum() == (sample.range_image[0] > 0).sum()


@pytest.mark.parametrize(("elsewhere", "near"), [(0.0, 1.0), (0.5, 0.7), (1.0, 0.3)])
def test_crops_begin_near_the_cameras_middle_but_for_a_share(root, elsewhere, near):
    anywhere = (RASTER.columns - 96) // 2
    samples = PanoramaDataset(root, ("train",), RASTER, columns=96, shift_px=anywhere, elsewhere=elsewhere)
    full = samples.window(0).camera_labels != IGNORE
    middle = full[:, anywhere + SHIFT_PX : anywhere + 96 - SHIFT_PX].any(0)
    assert middle.all() and not full.any(0).all()
    crops = [samples[SampleIndex(0, seed)].camera_labels != IGNORE for seed in range(60)]
    inside = np.mean([bool(crop[:, SHIFT_PX:-SHIFT_PX].any(0).all()) for crop in crops])
    assert abs(inside - near) < 0.2 and (inside == 1) == (elsewhere == 0)


def test_mirrored_twice_is_the_sample_again(root):
    sample = PanoramaDataset(root, ("train",), RASTER, columns=160)[0]
    once = mirrored(sample)
    assert torch.equal(once.camera_labels, sample.camera_labels.flip(-1))
    assert torch.equal(once.range_image[2], -sample.range_image[2].flip(-1))
    assert all(torch.equal(a, b) for a, b in zip(mirrored(once)[:4], sample[:4], strict=True))


def test_a_mirrored_scan_projects_to_the_mirrored_range_image():
    scan = street(3)
    plain, flipped = (project(s, VIEWS["hdl64e"]).channels[0] for s in (scan, mirror(scan)))
    assert (plain != flipped.flip(-1)).float().mean() < 1e-3  # points on a pixel's edge


def test_a_turned_scan_projects_to_the_shifted_range_image():
    scan = street(4)
    plain, turned = (project(s, VIEWS["hdl64e"]).valid for s in (scan, turn(scan, 2 * np.pi * 100 / 2048)))
    assert (plain.roll(-100, -1) != turned).float().mean() < 1e-3


def test_what_lies_where_a_sensor_leans_rises_in_its_frame():
    points = np.array([[10, 0, 0], [0, 10, 0], [-10, 0, 0], [0, -10, 0], [0, 0, 2]], np.float32)
    scan = Scan(xyz=points, remission=np.zeros(5, np.float32))
    s, c = np.sin(0.1), np.cos(0.1)
    ahead = [[10 * c, 0, 10 * s], [0, 10, 0], [-10 * c, 0, -10 * s], [0, -10, 0], [-2 * s, 0, 2 * c]]
    assert np.allclose(tilt(scan, 0.0, 0.1).xyz, ahead, atol=1e-5)
    assert np.allclose(tilt(scan, np.pi / 2, 0.1).xyz[1], [0, 10 * c, 10 * s], atol=1e-5)
    anywhere = street(5)
    there_and_back = tilt(tilt(anywhere, 1.0, 0.08), 1.0 + np.pi, 0.08)
    assert np.allclose(there_and_back.xyz, anywhere.xyz, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_mixed_scans_are_half_turns_of_two_and_turned_things_of_the_other(seed):
    scan, other = street(3), replace(street(4), remission=street(4).remission + 2)  # tells the two apart
    assert scan.label is not None and other.label is not None
    mixed = mix(scan, other, np.random.default_rng(seed), (HOUSE,))
    generator = np.random.default_rng(seed)
    middle, *angles = (generator.uniform(-np.pi, np.pi) for _ in range(4))
    parts = []
    for one, wanted in ((scan, False), (other, True)):
        away = (np.arctan2(one.xyz[:, 1], one.xyz[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
        there = (np.abs(away) < np.pi / 2) == wanted
        parts.append((one.xyz[there], one.remission[there], one.label[there]))
    things = other.label == HOUSE
    for angle in angles:
        place = (other.xyz[things, 0] + 1j * other.xyz[things, 1]) * np.exp(1j * angle)
        xyz = np.stack([place.real, place.imag, other.xyz[things, 2]], 1)
        parts.append((xyz, other.remission[things], other.label[things]))
    xyz, remission, label = (np.concatenate(values) for values in zip(*parts, strict=True))
    assert np.allclose(mixed.xyz, xyz, atol=1e-4)
    assert np.array_equal(mixed.remission, remission) and np.array_equal(mixed.label, label)
    assert 0.2 < (mixed.remission < 2).sum() / len(scan) < 0.8, "some of the scan stays"


@pytest.mark.parametrize(("mixed", "expected"), [(0.0, 0.0), (0.5, 1 / 3), (1.0, 2 / 3)])
def test_a_share_of_the_samples_is_mixed_with_any_of_three_scans(root, mixed, expected):
    samples = RangeImageDataset(
        root, ("train",), VIEWS["hdl64e"], augmentation=ScanAugmentation(chance=0.0, mixed=mixed)
    )
    own = (torch.from_numpy(samples.scan(0).remission) - 0.21) / 0.16
    made = [samples[SampleIndex(0, seed)].lidar[4] for seed in range(60)]
    strange = [not torch.isin(remission[remission != 0], own).all() for remission in made]
    assert np.mean(strange) == pytest.approx(expected, abs=0.15)


def test_sensors_stand_higher_or_lower_and_lean():
    scan = street(5)
    by = ScanAugmentation(chance=0.0, turn_deg=0.0, moves=False, places=0.5)
    generator = np.random.default_rng(0)
    made = [augmented(scan, generator, by).xyz for _ in range(200)]
    higher = np.array([xyz[:, 2].mean() - scan.xyz[:, 2].mean() for xyz in made])
    same = [np.array_equal(np.abs(xyz), np.abs(scan.xyz)) for xyz in made]
    assert 0.15 < np.mean(same) < 0.35
    assert higher.min() < -0.9 and higher.max() > 0.9 and np.abs(higher).max() < 1.5
    leaning = []
    for xyz in made:
        ground = scan.label == ROAD
        (a, b, _), *_ = np.linalg.lstsq(np.c_[xyz[ground, :2], np.ones(ground.sum())], xyz[ground, 2], rcond=None)
        leaning.append(np.degrees(np.arctan(np.hypot(a, b))))
    assert 0.4 < np.mean(np.array(leaning) > 0.1) < 0.6 and 4 < max(leaning) < 5.2


def test_another_scale_of_remission_keeps_points_order_and_range():
    scan = Scan(xyz=np.ones((400, 3), np.float32), remission=np.linspace(0, 1, 400, dtype=np.float32))
    means = []
    for seed in range(60):
        changed = vary_remission(scan, np.random.default_rng(seed), 0.5)
        assert changed.xyz is scan.xyz and changed.remission.dtype == np.float32
        assert changed.remission.min() >= 0 and changed.remission.max() <= 1
        assert (np.diff(changed.remission) >= 0).all()
        means.append(changed.remission.mean())
    assert min(means) < 0.33 and max(means) > 0.62 and abs(np.mean(means) - 0.5) < 0.06


def test_another_make_of_sensor_keeps_points_and_the_order_of_remission():
    """Levels spread over octaves; at one range the curve rises; far points are no brighter than near ones."""
    line = np.linspace(0.01, 1, 400, dtype=np.float32)
    near = Scan(xyz=np.full((400, 3), 5, np.float32), remission=line)
    far = Scan(xyz=np.full((400, 3), 50, np.float32), remission=line)
    levels = []
    for seed in range(80):
        one, other = (change_sensor_remission(scan, np.random.default_rng(seed), 3.0) for scan in (near, far))
        assert one.xyz is near.xyz and one.remission.dtype == np.float32
        assert one.remission.min() >= 0 and one.remission.max() <= 1
        assert (np.diff(one.remission) >= 0).all() and (other.remission <= one.remission).all()
        levels.append(np.log2(np.median(one.remission)))
    assert np.ptp(levels) > 2.5 and min(levels) < -2.5
    still = change_sensor_remission(near, np.random.default_rng(0), 0.0)
    assert np.allclose(still.remission, line, atol=1e-6)


def test_remission_of_other_sensors_is_drawn_for_half_of_the_samples(root):
    levels = {"chance": 0.0, "turn_deg": 0.0, "moves": False}
    scan = street(5)
    made = [augmented(scan, np.random.default_rng(i), ScanAugmentation(**levels, sensors=3.0)) for i in range(60)]
    assert 0.3 < np.mean([not np.array_equal(one.remission, scan.remission) for one in made]) < 0.7


def test_most_samples_of_translators_have_the_remission_of_other_sensors_and_some_none(root):
    varied = PanoramaDataset(root, ("train",), RASTER, columns=160, sensors=3.0)
    original = varied.window(0).scan.remission
    made = [varied[SampleIndex(0, seed)].range_image[4] for seed in range(160)]
    same = [np.isin(remission, (0, *original)).all() for remission in made]
    none = [set(remission.unique().tolist()) == {0, 0.25} for remission in made]
    assert 0.05 < np.mean(same) < 0.2 and 0.05 < np.mean(none) < 0.2
    assert not np.logical_and(same, none).any()


def test_half_of_the_samples_of_translators_are_enlarged_all_alike(root):
    plain, varied = (PanoramaDataset(root, ("train",), RASTER, columns=160, sensors=s) for s in (0.0, 3.0))
    least = plain[0].range_image[0, plain[0].range_image[0] > 0].min()
    factors = []
    for seed in range(100):
        image = varied[SampleIndex(0, seed)].range_image
        factors.append((image[0, image[0] > 0].min() / least).item())
    moved = [abs(factor - 1) > 0.02 for factor in factors]
    assert 0.3 < np.mean(moved) < 0.7
    assert min(factors) < 0.8 and 1.25 < max(factors) < 1.5, "from a quarter nearer to a third farther"


def test_an_enlarged_sample_is_that_of_an_enlarged_world(root):
    samples = PanoramaDataset(root, ("train",), RASTER, columns=160, shift_px=8)
    window, sample = samples.window(0), samples[0]
    larger = enlarged(sample, 1.2)
    view = window.view.window(8, 160)
    seen = project(
        replace(window.scan, xyz=window.scan.xyz * np.float32(1.2)),
        replace(view, origin=tuple(1.2 * place for place in view.origin)),
    ).channels
    assert any(view.origin), "the camera stands beside the sensor"
    assert torch.allclose(larger.range_image, seen, rtol=1e-4, atol=1e-4)
    assert torch.allclose(larger.depth_m, sample.depth_m * 1.2) and larger.depth_m.max() > 0
    assert torch.equal(larger.segments, sample.segments) and torch.equal(larger.camera_labels, sample.camera_labels)


def test_the_share_of_scans_that_lose_their_remission():
    scan, generator = street(5), np.random.default_rng(0)
    by = ScanAugmentation(chance=0.0, no_remission=0.25)
    constant = [(augmented(scan, generator, by).remission == STAND_IN).all() for _ in range(200)]
    assert 0.15 < np.mean(constant) < 0.35


def test_where_roughness_is_read_scans_are_not_moved():
    """Moved, the rows of a range image mix beams, and their roughness is that of the mixture."""
    scan = street(5)
    for moves in (True, False):
        by = ScanAugmentation(chance=1.0, moves=moves)
        ranges = [np.linalg.norm(augmented(scan, np.random.default_rng(i), by).xyz, axis=1) for i in range(4)]
        original = np.linalg.norm(scan.xyz, axis=1).round(3)
        assert all(np.isin(each.round(3), original).mean() > 0.99 for each in ranges) == (not moves)


def test_dropping_leaves_out_about_the_given_share_with_their_labels():
    scan = street(5)
    kept = drop_points(scan, np.random.default_rng(0), 0.3)
    assert len(kept) == pytest.approx(0.7 * len(scan), rel=0.05)
    assert kept.label is not None
    assert len(kept.label) == len(kept)
    rings = drop_rings(scan, np.random.default_rng(0), 0.8, 0.5)
    assert 0.2 * len(scan) < len(rings) < 0.8 * len(scan)


def test_what_is_known_of_each_point_goes_with_it():
    xyz = np.array([[10, 0, 0], [10, 0, 5], [0, 10, 1]], np.float32)
    known = {"label": np.array([3, 4, 5]), "ring": np.array([7, 8, 9]), "time_s": np.array([0.1, 0.2, 0.3])}
    remission, light = np.array([[0.1, 0.2, 0.3], [4, 5, 6]], np.float32)
    lower = drop_above(Scan(xyz=xyz, remission=remission, near_infrared=light, **known), 10.0)
    assert np.array_equal(lower.xyz, xyz[[0, 2]])
    for name, values in {**known, "remission": remission, "near_infrared": light}.items():
        assert np.array_equal(getattr(lower, name), values[[0, 2]]), name


def test_a_sensor_whose_beams_end_lower_has_lost_the_points_above():
    # 3 degrees are .524 m in 10 m
    xyz = np.array([[10, 0, 0.5], [0, -10, 0.52], [3, 4, 0.44], [0, 10, -3], [10, 0, 0.53]], np.float32)
    scan = Scan(xyz=xyz, remission=np.arange(5, dtype=np.float32) / 10, label=np.arange(5))
    lower = drop_above(scan, 3.0)
    assert lower.label is not None
    assert lower.label.tolist() == [0, 1, 3]
    assert np.array_equal(lower.xyz, xyz[[0, 1, 3]])
    assert np.allclose(lower.remission, [0, 0.1, 0.3])


def test_beams_end_lower_in_some_crops(root):
    samples = PanoramaDataset(root, ("train",), RASTER, columns=160)
    rows = torch.arange(RASTER.rows)
    tops = [rows[samples[SampleIndex(0, seed)].range_image[0].any(1)].min().item() for seed in range(100)]
    highest = rows[samples[0].range_image[0].any(1)].min().item()
    assert 10 < sum(top > highest + 2 for top in tops) < 50


def test_front_samples_speak_common_14_without_sky(root):
    sample = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], (36, 120))[0]
    assert sample.lidar.shape == (5, 64, 512)
    assert sample.camera_labels.shape == (36, 120)
    found = {COMMON14.classes[i] for i in sample.camera_labels.unique().tolist()}
    assert found == {"unlabeled", "road", "building"}


def test_a_segmenters_labels_take_the_teachers_place(root):
    samples = PanoramaDataset(root, ("train",), RASTER, columns=160)
    (weights := root / "weights").write_bytes(b"1")
    samples.predict(lambda scan: torch.full((len(scan),), 5), weights)
    assert set(samples[0].segments.unique().tolist()) == {0, 5}
    fronts = FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], (36, 120))
    fronts.predict(lambda scan: torch.full((len(scan),), 5), weights)
    assert set(fronts[0].segments.unique().tolist()) == {0, 5}


def test_the_ground_truth_all_around_is_sampled_from_every_direction(tmp_path):
    root = write_video(tmp_path, panorama=True)
    (frame, *_), view = frames(root, "train"), VIEWS["panorama"].scaled(1 / 8)
    samples = PanoramaDataset(root, ("train",), view, columns=96)
    pixels = np.array(Image.open(frame.folder / "pano_labels" / f"{frame.stem}.png"))
    ahead = samples[0]
    crop = slice((576 - 96) // 2, (576 + 96) // 2)
    assert torch.equal(ahead.camera_labels, torch.from_numpy(pixels[1::2, 1::2][:, crop]).long())
    assert torch.allclose(ahead.depth_m, torch.tensor(10.0), atol=0.01)
    whole = samples.window(0).camera_labels.long()
    starts = set()
    for seed in range(40):
        camera = samples[SampleIndex(0, seed)].camera_labels
        found = [
            start
            for start in range(576 - 96 + 1)
            for each in (camera, camera.flip(-1))
            if torch.equal(whole[:, start : start + 96], each)
        ]
        assert found, "each crop is a part of the whole turn"
        starts.add(found[0])
    assert min(starts) < 100 and max(starts) > 380


def test_unknown_classes_all_around_are_ignored(tmp_path):
    root = write_video(tmp_path, panorama=True)
    frame = frames(root, "train")[0]
    path = frame.folder / "pano_labels" / f"{frame.stem}.png"
    ids = np.array(Image.open(path))
    ids[:, 500:600] = 0
    Image.fromarray(ids).save(path)
    samples = PanoramaDataset(root, ("train",), VIEWS["panorama"].scaled(1 / 4), columns=192)
    unknown = samples.window(0).camera_labels == IGNORE
    assert unknown[:, 500:600].all() and unknown.sum() == unknown[:, 500:600].numel()


def test_splits_of_other_data_sets_join(root, tmp_path):
    other = write_video(tmp_path / "other")
    joined = [*frames(root, "train").names, *frames(other, "train").names, *frames(root, "train").names]
    assert list(frames_of(root, ("train", f"{other}:train", "train")).names) == joined
    samples = RangeImageDataset(root, ("train", f"{other}:train"), VIEWS["hdl64e"])
    assert len(samples) == len(frames(root, "train")) + len(frames(other, "train"))
    assert len(samples.scan(len(samples) - 1)) == len(frames(other, "train")[-1].scan)
    with pytest.raises(InputError, match="other2"):
        frames_of(root, (f"{other}2:train",))


def test_beams_are_left_out_whole():
    scan = street(4)
    ring = np.floor((np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(*scan.xyz[:, :2].T))) + 90) / 0.42).astype(int)
    still = {"turn_deg": 0.0, "chance": 0.0}
    kept = []
    for seed in range(20):
        fewer = augmented(scan, np.random.default_rng(seed), ScanAugmentation(**still, rings=1.0))
        there = np.isin(np.abs(scan.xyz).view("f4,f4,f4"), np.abs(fewer.xyz).view("f4,f4,f4")).ravel()
        assert there.sum() == len(fewer) and not set(ring[there]) & set(ring[~there]), "whole beams only"
        kept.append(len(np.unique(ring[there])) / len(np.unique(ring)))
    assert min(kept) < 0.5 and max(kept) > 0.8
    for seed in range(9):
        assert len(augmented(scan, np.random.default_rng(seed), ScanAugmentation(**still, rings=0.0))) == len(scan)


def test_a_point_that_is_nan_or_infinite_trains_like_any_other(root):
    path = root / "sequences/00/velodyne/000000.bin"
    points = np.fromfile(path, "<f4").reshape(-1, 4)
    points[:3, :3] = [[np.nan] * 3, [np.inf, 1, 1], [1, 1, -np.inf]]
    points[3, 3] = np.nan
    points.tofile(path)
    augmentation = ScanAugmentation(rings=1.0, remission=0.5)
    for data in (
        RangeImageDataset(root, ("train",), VIEWS["hdl64e"], augmentation=augmentation),
        PanoramaDataset(root, ("train",), RASTER, columns=160),
    ):
        for seed in range(12):
            with np.errstate(all="ignore"):
                sample = data[SampleIndex(0, seed)]
            assert all(part.isfinite().all() for part in sample if isinstance(part, torch.Tensor))


def test_class_counts_are_of_all_frames_or_of_a_spread_sample(root):
    scans = RangeImageDataset(root, ("train",), VIEWS["hdl64e"])
    counts = sum(np.bincount(street(number).label, minlength=20) for number in range(3))
    assert np.array_equal(scans.class_counts(), counts)
    crops = PanoramaDataset(root, ("train",), RASTER, columns=160)
    labels = torch.cat([crops.window(index).camera_labels.flatten() for index in range(3)])
    assert np.array_equal(crops.class_counts(), np.bincount(labels, minlength=256))
    assert evenly_spaced(3) == [0, 1, 2] and len(set(evenly_spaced(20_000))) == 500
    assert evenly_spaced(20_000)[0] == 0 and evenly_spaced(20_000)[-1] == 19_999


def test_labels_of_another_size_or_type_do_not_train(root):
    path = root / "sequences/00/camera_labels/000000.png"
    for image, message in (
        (Image.new("L", (12, 10)), "is 12x10 and its image 240x72"),
        (Image.new("L", (240, 72), 33), "holds class 33"),
    ):
        image.save(path)
        for data in (
            PanoramaDataset(root, ("train",), RASTER, columns=160),
            FrontViewDataset(root, ("train",), VIEWS["titan-front-512"], (36, 120)),
        ):
            with pytest.raises(InputError, match=message):
                data[0]


def test_class_counts_of_panoramas_are_those_of_their_samples(tmp_path):
    root = write_video(tmp_path, panorama=True)
    crops = PanoramaDataset(root, ("train",), RASTER, columns=96)
    labels = torch.cat([crops.window(index).camera_labels.flatten() for index in range(len(crops))])
    assert np.array_equal(crops.class_counts(), np.bincount(labels, minlength=256))
