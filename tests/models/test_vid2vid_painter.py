"""Streams painted with vid2vid: how they begin and go on, on any raster, all around."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.labels import CITYSCAPES_IDS, COMMON15
from lidar2pano.models import build
from lidar2pano.models.vid2vid_painter import LabelChannels, Past, Vid2VidPainter, edges
from lidar2pano.scene.record import Scene
from lidar2pano.views import VIEWS

CLASSES = len(COMMON15)
SMALL = replace(VIEWS["panorama"].scaled(1 / 192), rows=8)
LOUD = 3.0  # published starting weights are small: so that what is far away can be seen in the answer


def networks(channels: int = CLASSES, classes: int = CLASSES, scales: int = 1, **more: object):
    """A small generator and a small network for first frames."""
    torch.manual_seed(0)
    settings = {"widths": [8, 4][:scales], "downsamplings": 2, "blocks": (2, 1), "foreground": (1,), **more}
    generator = build("vid2vid", channels=channels, **settings)
    single = build("vid2vid-single", classes=classes, width=8, downsamplings=2, blocks=1, enhancers=1)
    for network in (generator, single):
        for parameter in network.eval().parameters():
            parameter.data.mul_(LOUD if parameter.ndim > 1 else 1)
    return generator, single


def maps(frames: int, rows: int = 16, columns: int = 48, seed: int = 3) -> Tensor:
    """Label maps (frames, rows, columns) uint8 that move to the left from frame to frame."""
    still = torch.randint(0, CLASSES, (rows // 4 + 1, columns // 4 + 1), generator=torch.Generator().manual_seed(seed))
    still = still.repeat_interleave(4, 0).repeat_interleave(4, 1)[:rows, :columns]
    return torch.stack([still.roll(-2 * frame, 1) for frame in range(frames)]).to(torch.uint8)


@torch.inference_mode()
def painted(painter: Vid2VidPainter, ids: Tensor) -> list[Tensor]:
    past, images = None, []
    for one in ids:
        past, image = painter.follow(past, one)
        images.append(image)
    return images


# --- a stream -------------------------------------------------------------------------------------------------------


def test_without_a_network_for_first_frames_the_first_is_painted_again_from_black():
    generator, _ = networks()
    ids = maps(1)
    (image,) = painted(Vid2VidPainter(generator), ids)
    labels = one_hot_layers(ids, CLASSES).expand(3, -1, -1, -1)[None]
    with torch.inference_mode():
        out = generator(labels, torch.zeros(1, 2, 3, 16, 48))
    assert torch.equal(image, out.raw[0])
    assert (out.raw - out.image).abs().max() > 0.01


def test_the_generator_goes_on_from_the_last_two_images_and_label_maps():
    generator, _ = networks()
    ids = maps(4)
    images = painted(Vid2VidPainter(generator), ids)
    one_hot = one_hot_layers(ids, CLASSES)
    black = torch.zeros(3, 16, 48)
    with torch.inference_mode():
        second = generator(one_hot[[0, 0, 1]][None], torch.stack([black, images[0]])[None]).image[0]
        fourth = generator(one_hot[[1, 2, 3]][None], torch.stack(images[1:3])[None]).image[0]
    assert torch.equal(images[1], second) and torch.equal(images[3], fourth)


def test_the_network_for_first_frames_paints_two_and_the_generator_goes_on():
    generator, single = networks()
    ids = maps(4)
    images = painted(Vid2VidPainter(generator, single), ids)
    one_hot = one_hot_layers(ids, CLASSES)
    with torch.inference_mode():
        for frame in (0, 1):  # on some processors a convolution rounds otherwise when its input lies elsewhere
            torch.testing.assert_close(images[frame], single(one_hot[[frame]])[0])
        for frame in (2, 3):
            before = torch.stack(images[frame - 2 : frame])[None]
            expected = generator(one_hot[frame - 2 : frame + 1][None], before).image[0]
            torch.testing.assert_close(images[frame], expected)


def test_every_scale_goes_on_from_its_own_images():
    generator, _ = networks(scales=2)
    painter, ids = Vid2VidPainter(generator), maps(3)
    past = None
    with torch.inference_mode():
        for one in ids[:2]:
            past, _ = painter.follow(past, one)
        levels = past.levels
        assert [tuple(level.shape) for level in levels] == [(1, 2, 3, 8, 24), (1, 2, 3, 16, 48)]
        after, image = painter.follow(past, ids[2])
        labels = generator.pyramid(one_hot_layers(ids, CLASSES)[None])
        coarse, fine = generator.scales(labels, levels)
        pooled = generator.scales(labels, generator.pyramid(levels[-1]))[0]
    assert torch.equal(image, fine.image[0])
    assert torch.equal(after.levels[0][0, -1], coarse.image[0])
    assert (pooled.image - coarse.image).abs().max() > 1e-3, "made smaller they would be others"


def test_a_stream_remembers_its_own_images_whatever_is_done_to_those_it_gave():
    painter, ids = Vid2VidPainter(networks()[0]), maps(2)
    expected = painted(painter, ids)[1]
    with torch.inference_mode():
        past, image = painter.follow(None, ids[0])
        image.zero_()
        assert torch.equal(painter.follow(past, ids[1])[1], expected)
        assert torch.equal(painter.follow(past, ids[1])[1], expected), "the past can be gone on from again"
        assert (painter.follow(None, ids[1])[1] - expected).abs().max() > 1e-3


def test_a_stream_has_one_size():
    painter = Vid2VidPainter(networks()[0])
    with torch.inference_mode():
        past, _ = painter.follow(None, maps(1)[0])
        with pytest.raises(ValueError, match="one size"):
            painter.follow(past, maps(1, columns=64)[0])


# --- rasters --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("begin", ["single", "black"])
@pytest.mark.parametrize("statistics", [False, True])
@pytest.mark.parametrize("turn", [8, -24])
def test_turning_a_stream_turns_its_images(begin: str, statistics: bool, turn: int):
    generator, single = networks(scales=2, batch_statistics=statistics)
    painter = Vid2VidPainter(generator, single if begin == "single" else None)
    ids = maps(4)
    for one, other in zip(painted(painter, ids), painted(painter, ids.roll(turn, 2)), strict=True):
        assert one.std() > 0.01
        # untrained norms on batch statistics make rounding a thousand times as large from frame to frame
        assert (one.roll(turn, 2) - other).abs().max() < (0.1 if statistics else 1e-3) * one.std()


@pytest.mark.parametrize("columns", [48, 50, 65])
def test_beside_the_seam_is_painted_as_anywhere_else(columns: int):
    """Also where columns do not divide: what a turn brings away from the seam does not change."""
    ids, gaps = maps(4, columns=columns), {}
    for closed in (True, False):
        painter = Vid2VidPainter(*networks(scales=2), closed=closed)
        still, turned = painted(painter, ids)[-1], painted(painter, ids.roll(24, 2))[-1]
        gaps[closed] = ((still[..., :-24] - turned[..., 24:]).abs().max() / still.std()).item()
    assert gaps[True] < 1e-3 and gaps[False] > 0.1


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize(("rows", "columns"), [(17, 48), (5, 7), (30, 65), (16, 9)])
def test_any_size_is_painted_in_its_own_size(rows: int, columns: int, closed: bool):
    images = painted(Vid2VidPainter(*networks(scales=2), closed=closed), maps(4, rows, columns))
    assert all(image.shape == (3, rows, columns) and image.isfinite().all() for image in images)


def test_the_raster_fits_the_network_for_first_frames_too():
    painter = Vid2VidPainter(*networks(downsamplings=1))  # the generator's coarsest pixel is 2 wide, the other's 8
    assert [image.shape for image in painted(painter, maps(4, 18, 46))] == [(3, 18, 46)] * 4


def test_what_is_added_below_and_beside_goes_on_and_is_cut_off():
    generator, _ = networks()
    ids = maps(1, 18, 46)
    whole = torch.nn.functional.pad(ids.float(), (0, 2, 0, 2), mode="replicate").to(torch.uint8)
    (image,), (more,) = (painted(Vid2VidPainter(generator, closed=False), one) for one in (ids, whole))
    assert torch.equal(image, more[:, :18, :46])


@pytest.mark.parametrize(("columns", "raster"), [(48, (16, 48)), (24, (8, 24)), (12, (4, 12)), (96, (32, 96))])
def test_panoramas_come_at_twice_the_segments_raster_whatever_they_are_painted_on(
    columns: int, raster: tuple[int, int]
):
    generator, _ = networks()
    painter = Vid2VidPainter.all_around(generator, None, columns, 24)
    segments = one_hot_layers(maps(1, 8, 24), CLASSES)
    with torch.inference_mode():
        depth_m, viewpoint_m = torch.zeros(1, 8, 24), torch.ones(1)
        scene = Scene(
            view=SMALL,
            channels=torch.zeros(1, 5, 8, 24),
            probabilities=segments,
            depth_m=depth_m,
            viewpoint_m=viewpoint_m,
        )
        past, image = painter.paint(None, scene)
        _, first = Vid2VidPainter(generator).follow(None, past.ids[-1, : raster[0], -raster[1] :])
    assert image.shape == (1, 3, 16, 48)
    assert isinstance(past, Past) and past.ids.shape[2] >= raster[1]
    if columns == 48:
        assert torch.equal(image[0], first)


@pytest.mark.parametrize("columns", [36, 72, 25])
def test_a_raster_that_does_not_fit_the_segments_is_named(columns: int):
    with pytest.raises(
        InputError, match=f"panoramas of {columns} columns, .* the translator's 24: .* for 12, 24 or 48"
    ):
        Vid2VidPainter.all_around(networks()[0], None, columns, 24)


# --- label channels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("channels", "labels", "has_edges"),
    [(16, COMMON15, False), (17, COMMON15, True), (35, CITYSCAPES_IDS, False), (36, CITYSCAPES_IDS, True)],
)
def test_the_number_of_channels_says_which_labels_are_read(channels: int, labels: object, has_edges: bool):
    reads = LabelChannels.of(channels)
    assert reads.labels is labels and reads.edges == has_edges
    ids = maps(2)
    given = reads(ids, False)
    assert given.shape == (1, 2, channels, 16, 48) and given.dtype == torch.float32
    assert torch.equal(given[:, :, : len(reads.labels)].sum(2), torch.ones(1, 2, 16, 48))
    pairs = {"car": "car", "sky": "sky", "traffic-sign": "traffic sign", "other-vehicle": "bus"}
    for name, theirs in pairs.items():
        where = ids == COMMON15.id_of(name)
        own = reads.labels.id_of(name if labels is COMMON15 else theirs)
        assert where.any() and torch.equal(given[0, :, own].bool(), where)
    if has_edges:
        assert torch.equal(given[0, :, -1].bool(), edges(ids, False))


@pytest.mark.parametrize("channels", [15, 18, 34, 37])
def test_other_numbers_of_channels_are_refused(channels: int):
    with pytest.raises(InputError, match=rf"reads {channels} label channels; make one that reads 16 .* or 35 "):
        Vid2VidPainter(build("vid2vid", channels=channels, widths=[4], downsamplings=1, blocks=[1, 1], foreground=[]))


def test_networks_that_read_different_classes_are_refused():
    generator, _ = networks()
    single = build("vid2vid-single", classes=35, width=4, downsamplings=1, blocks=1)
    with pytest.raises(InputError, match="first-frame network reads 35 classes and the generator 16"):
        Vid2VidPainter(generator, single)


@pytest.mark.parametrize("closed", [False, True])
def test_edges_are_where_a_neighbour_is_of_another_class(closed: bool):
    ids = maps(2, 8, 12)
    expected = torch.zeros(2, 8, 12, dtype=torch.bool)
    for frame in range(2):
        for row in range(8):
            for column in range(12):
                for i, beside in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                    j = beside % 12 if closed else beside
                    if 0 <= i < 8 and 0 <= j < 12 and ids[frame, i, j] != ids[frame, row, column]:
                        expected[frame, row, column] = True
    assert torch.equal(edges(ids, closed), expected)
    assert expected.any() and not expected.all()


def test_published_shapes_are_painted_with_cityscapes_ids_and_edges():
    generator, single = networks(channels=36, classes=35, foreground=(26,), batch_statistics=True)
    images = painted(Vid2VidPainter(generator, single), maps(3))
    assert all(image.shape == (3, 16, 48) for image in images)
