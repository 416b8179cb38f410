"""Clips: which frames make one, that all of its frames are cut alike, and that its flow leads to the frame before."""

from __future__ import annotations

from shutil import copytree, rmtree

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data.clips import (
    ClipDataset,
    ClipSample,
    Framing,
    LabelledImage,
    camera_image,
    distances_m,
    flow_to,
    mirrored,
    pan,
    panned,
    panorama_image,
    runs,
)
from lidar2pano.data.frames import SampleIndex
from lidar2pano.data.layouts import frames
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import warp
from lidar2pano.views import VIEWS
from miniature_video import FRAMES, PANORAMA, STEP, TURN, write_video

QUARTER = VIEWS["panorama"].scaled(1 / 4)
WINDOW = Framing(rows=48, columns=96)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video"))


@pytest.fixture(scope="module")
def around(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("around"), panorama=True)


@pytest.fixture
def _opencv():
    pytest.importorskip("cv2", reason="flow between pictures needs opencv: pip install 'lidar2pano[train]'")


def gap(clip: ClipSample, shift: torch.Tensor, *, circular: bool = False) -> float:
    """Mean distance of each frame from the one before it, moved by `shift`, where the flow is known."""
    moved = warp(clip.image[:-1], shift[1:], circular=circular)
    known = clip.known[1:]
    return (((moved - clip.image[1:]).abs().mean(1) * known).sum() / known.sum()).item()


def test_runs_are_of_one_sequence_and_without_gaps():
    names = ["01/000003", "00/000009", "00/000010", "01/000001", "00/000011", "01/000002", "00/000013", "00/start"]
    found = [[names[index] for index in run] for run in runs(names, 2)]
    assert found == [
        ["00/000009", "00/000010"],
        ["00/000010", "00/000011"],
        ["01/000001", "01/000002"],
        ["01/000002", "01/000003"],
    ]
    assert len(runs(names, 3)) == 2
    assert runs(names, 4) == []


@pytest.mark.usefixtures("_opencv")
def test_a_window_is_one_place_in_all_frames(video):
    clips = ClipDataset(video, ("train",), WINDOW, 4)
    assert len(clips) == FRAMES - 3
    clip = clips[SampleIndex(2, 7)]
    assert clip.name == "00/000005"
    assert clip.image.shape == (4, 3, 48, 96) and clip.labels.shape == (4, 48, 96)
    assert clip.shift.shape == (4, 2, 48, 96) and clip.known.shape == (4, 48, 96)
    plain = clips[2]
    whole = [camera_image(frame, 1.0) for frame in frames(video, "train")[2:6]]
    for k, image in enumerate(whole):
        middle = (slice(12, 60), slice(72, 168))
        assert torch.equal(plain.labels[k], image.labels[middle].long())
        assert torch.allclose(plain.image[k], image.image[:, *middle] / 127.5 - 1)
    assert len({tuple(clips[SampleIndex(2, seed)].image[0, :, 0, 0].tolist()) for seed in range(6)}) > 3
    assert torch.equal(clips[SampleIndex(2, 7)].image, clip.image), "a function of the seed alone"


@pytest.mark.usefixtures("_opencv")
def test_flow_of_the_images_leads_to_the_frame_before(video):
    clips = ClipDataset(video, ("train",), WINDOW, 4)
    for clip, way in ((clips[1], 1), (mirrored(clips[1]), -1)):  # what moves left was farther right
        known = clip.known > 0
        assert not known[0].any() and known[1:].float().mean() > 0.9
        assert clip.shift[:, 0][known].median() == pytest.approx(STEP * way, abs=0.2)
        assert (clip.shift * ~known[:, None]).abs().max() == 0
        assert gap(clip, clip.shift) < 0.2 * gap(clip, torch.zeros_like(clip.shift))


@pytest.mark.usefixtures("_opencv")
def test_classes_stay_with_their_colours(video, around):
    """In these data sets a class says where one colour is over 128."""
    for clips, channel, high in (
        (ClipDataset(video, ("train",), Framing(rows=72, columns=96), 2), 0, 9),
        (ClipDataset(around, ("train",), Framing(rows=96, columns=200, view=QUARTER), 2), 1, 15),
        (ClipDataset(around, ("train",), Framing(rows=96, columns=1152, view=QUARTER), 2), 1, 15),
    ):
        starts = set()
        for seed in range(8):
            clip = clips[SampleIndex(1, seed)]
            sure = clip.labels > 0
            assert torch.equal((clip.image[:, channel] * 127.5 > 1)[sure], (clip.labels == high)[sure])
            starts.add(round(clip.image[0, :, :, :4].mean().item(), 4))
        assert len(starts) > 4, "windows begin anywhere"


def test_draws_mirror_half_of_the_clips(around):
    clips = ClipDataset(around, ("train",), Framing(rows=96, columns=96, view=QUARTER), 2)
    ways = [clips[SampleIndex(0, seed)].shift[1, 0].mean().sign().item() for seed in range(40)]
    assert 8 < ways.count(1.0) < 32
    assert set(ways) == {1.0, -1.0}


def test_classes_are_common_ones_and_ignored_is_unlabeled(video):
    clip = ClipDataset(video, ("train",), Framing(rows=72, columns=240), 1 + 1, stills=("train",))[0]
    frame = frames(video, "train")[0]
    image = camera_image(frame, 1.0)
    assert set(image.labels.unique().tolist()) == {0, 7, 9}  # road and building of COMMON15
    assert (image.labels[:5] == 0).all() and (image.labels[5:] > 0).all()
    assert -1 <= clip.image.min() < -0.3 and 0.3 < clip.image.max() <= 1


def test_images_are_scaled_before_they_are_cut(video):
    frame = frames(video, "train")[0]
    image = camera_image(frame, 0.5)
    assert image.image.shape == (3, 36, 120) and image.labels.shape == (36, 120)
    fine = torch.from_numpy(frame.image).movedim(2, 0).float()
    means = fine.unfold(1, 2, 2).unfold(2, 2, 2).mean((-1, -2))
    assert (image.image - means).abs().max() < 1.01
    assert image.raster.K[0, 0] == pytest.approx(70)
    with pytest.raises(InputError, match="36 x 120 pixels, fewer than the window of 48 x 96; set scale"):
        ClipDataset(video, (), Framing(rows=48, columns=96, scale=0.5), 2, stills=("train",))[0]


def test_stills_become_clips_with_exact_flow(video):
    clips = ClipDataset(video, (), WINDOW, 4, stills=("alone",))
    assert len(clips) == 3
    moved = set()
    for seed in range(6):
        clip = clips[SampleIndex(1, seed)]
        assert clip.image.shape == (4, 3, 48, 96) and not clip.known[0].any()
        assert clip.known[1:].mean() > 0.5
        assert gap(clip, clip.shift) < 0.25 * gap(clip, torch.zeros_like(clip.shift))
        assert gap(clip, -clip.shift) > gap(clip, clip.shift)
        moved.add(round(clip.shift[1, 0].mean().item(), 3))
    assert len(moved) == 6


def test_a_still_s_flow_is_what_its_window_did():
    size, middle = pan(np.random.default_rng(1), (90, 300), (48, 96), 3)
    assert len(set(size.tolist())) == 3
    row, column, k = 10, 70, 2
    place = [middle[k, 0] + size[k] * (row - 23.5), middle[k, 1] + size[k] * (column - 47.5)]  # in the whole picture
    was = [(place[0] - middle[1, 0]) / size[1] + 23.5, (place[1] - middle[1, 1]) / size[1] + 47.5]
    grid = torch.from_numpy(np.indices((90, 300)).astype(np.float32))  # a picture of its own coordinates
    assert grid[:, 40, 200].tolist() == [40, 200]
    image = LabelledImage(raster=QUARTER, image=grid, labels=torch.zeros(90, 300, dtype=torch.uint8))
    clip = panned(image, np.random.default_rng(1), WINDOW, 3, "x")
    found = (clip.image[k, :, row, column] + 1) * 127.5
    assert found.tolist() == pytest.approx([float(value) for value in place], abs=1e-2)
    shift = clip.shift[k, :, row, column]
    assert shift.tolist() == pytest.approx([float(was[1]) - column, float(was[0]) - row], abs=1e-3)


@pytest.mark.parametrize("whole", [(48, 96), (50, 200), (300, 97)])
def test_a_pan_stays_inside_the_image(whole):
    for seed in range(30):
        size, middle = pan(np.random.default_rng(seed), whole, (48, 96), 5)
        half = size[:, None] * (torch.tensor([48.0, 96.0]) - 1) / 2
        assert (middle - half >= -1e-3).all() and (middle + half <= torch.tensor(whole) - 1 + 1e-3).all()
        assert size.min() >= 1 and size.max() <= 1.17
        assert (middle.diff(dim=0).abs() <= torch.tensor([2.0, 12.0]) + 0.05 * torch.tensor(whole)).all()


def test_runs_are_repeated_until_they_are_as_many_as_the_stills(video):
    clips = ClipDataset(video, ("train",), WINDOW, FRAMES - 1, stills=("val",))
    lengths = [len(run) for run in clips.clips]
    assert lengths.count(1) == FRAMES and lengths.count(FRAMES - 1) == 2 * 3


def test_splits_without_neighbours_are_refused(video):
    with pytest.raises(InputError, match="no 2 frames of split alone follow each other; choose another split"):
        ClipDataset(video, ("alone",), WINDOW, 2)
    with pytest.raises(InputError, match="has no split 'tain'; did you mean 'train'"):
        ClipDataset(video, ("tain",), WINDOW, 2)


def test_the_panorama_turns_with_the_car(around):
    clips = ClipDataset(around, ("train",), Framing(rows=PANORAMA[0], columns=PANORAMA[1], view=QUARTER), 3)
    for clip in (clips[2], mirrored(clips[2])):
        assert clip.known[1:].all(), "there is no edge to come in at"
        assert gap(clip, clip.shift, circular=True) < 0.01
    plain = clips[2]
    assert torch.allclose(plain.shift[1:, 0], torch.full_like(plain.shift[1:, 0], -TURN), atol=1e-3)
    assert plain.shift[:, 1].abs().max() < 1e-3
    assert set(plain.labels.unique().tolist()) == {7, 15}
    turned = clips[SampleIndex(2, 0)].image[0].sum((0, 1))
    shifts = [(turned - plain.image[0].sum((0, 1)).roll(n)).abs().max() for n in range(PANORAMA[1])]
    mirror = [(turned.flip(0) - plain.image[0].sum((0, 1)).roll(n)).abs().max() for n in range(PANORAMA[1])]
    assert min(*shifts, *mirror) < 1e-3 < shifts[0], "draws turn it"


def test_a_window_of_the_panorama_has_edges(around):
    clip = ClipDataset(around, ("train",), Framing(rows=64, columns=128, view=QUARTER), 3)[0]
    known = clip.known[1:] > 0
    assert known[..., TURN:].all() and not known[..., : TURN - 1].any()
    assert gap(clip, clip.shift) < 0.01


def test_the_panorama_is_resized_to_the_raster(around):
    frame = frames(around, "train")[0]
    half = panorama_image(frame, VIEWS["panorama"].scaled(1 / 8))
    assert half.image.shape == (3, 48, 576) and half.labels.shape == (48, 576)
    assert distances_m(frame, half).unique().tolist() == [10.0]
    with pytest.raises(InputError, match="its panorama is 1152x96; one like 2048x64 is needed"):
        panorama_image(frame, VIEWS["hdl64e"])


def test_the_camera_s_flow_takes_the_panorama_s_depths(around):
    frame = frames(around, "train")[3]
    image = camera_image(frame, 1.0)
    assert distances_m(frame, image)[36].unique().tolist() == [10.0]
    before = frames(around, "train")[2]
    flow = flow_to(before, frame, camera_image(before, 1.0), image)
    angle = TURN * 2 * np.pi / PANORAMA[1]
    assert flow.shift[0, 33, 119].item() == pytest.approx(-140 * np.tan(angle), rel=0.02)  # P2's focal length


def test_flow_leads_from_a_frame_to_the_one_before(around, monkeypatch):
    given = []
    monkeypatch.setattr("lidar2pano.data.clips.ego_flow", lambda *arguments: given.extend(arguments))
    monkeypatch.setattr("lidar2pano.data.clips.distances_m", lambda frame, image: (frame.name, image))
    before, now = frames(around, "train")[2:4]
    was, current = camera_image(before, 1.0), camera_image(now, 1.0)
    flow_to(before, now, was, current)
    assert given[:2] == [(now.name, current), (before.name, was)]
    turn = given[2].numpy()
    assert turn[:3, :3] @ [1, 0, 0] == pytest.approx([np.cos(0.0272708), np.sin(0.0272708), 0], abs=1e-5)
    assert given[3] is current.raster


def test_scans_stand_in_for_depths_and_the_sky_is_far(around, tmp_path):
    frame = frames(around, "train")[0]
    ids = np.full((72, 240), 10, dtype=np.uint8)  # all of it sky, as the camera says
    assert isinstance(frame, SemanticKittiFrame)
    bare = SemanticKittiFrame(tmp_path, frame.stem)
    for part in ("velodyne", "image_2"):
        (tmp_path / part).symlink_to(frame.folder / part)
    (tmp_path / "calib.txt").symlink_to(frame.folder / "calib.txt")
    (tmp_path / "camera_labels").mkdir()
    ids[40:] = 0
    Image.fromarray(ids).save(tmp_path / "camera_labels" / f"{frame.stem}.png")
    distance = distances_m(bare, camera_image(bare, 1.0))
    assert distance[:40].isinf().all()
    road = distance[50:, 20:220]
    assert (road[road > 0] < 60).all() and (road > 0).float().mean() > 0.5
    with pytest.raises(InputError, match="pano/000000.png: is missing"):
        distances_m(bare, panorama_image(frame, QUARTER))


def test_a_panorama_without_depths_is_refused(around, tmp_path):
    copytree(around, tmp_path / "set")
    rmtree(tmp_path / "set/sequences/00/pano_depth")
    with pytest.raises(InputError, match="its panorama has no labels or no depths"):
        panorama_image(frames(tmp_path / "set", "train")[0], QUARTER)


def test_a_missing_panorama_is_named(video):
    with pytest.raises(InputError, match=r"pano/000000.png: is missing; only simulated data sets"):
        ClipDataset(video, ("train",), Framing(rows=96, columns=96, view=QUARTER), 2)[0]


def test_real_frames_of_a_drive(kitti_mini):
    pytest.importorskip("cv2", reason="flow between pictures needs opencv: pip install 'lidar2pano[train]'")
    clips = ClipDataset(kitti_mini, ("drive",), Framing(rows=128, columns=384, scale=0.5), 3)
    assert len(clips) == 10
    clip = clips[4]
    assert clip.known[1:].mean() > 0.7
    assert gap(clip, clip.shift) < 0.5 * gap(clip, torch.zeros_like(clip.shift))
