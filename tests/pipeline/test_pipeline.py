"""The pipeline and its panorama, on a family of untrained networks."""

from __future__ import annotations

import itertools
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

from installed_families import install_only
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import read_image
from lidar2pano.geometry.projection import Normalisation, directions, one_hot_layers, project
from lidar2pano.geometry.rasters import upsample_azimuth, upsample_classes
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.memory import LEAST_IMAGES, Memory, Surroundings, fused
from lidar2pano.models import build
from lidar2pano.models.blocks import fold_norms
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.card import read_card, save
from lidar2pano.models.families import licence_note, weight_files
from lidar2pano.models.vid2vid_painter import Vid2VidPainter
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import PaperPipeline, Pipeline, Segmenter, load
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import measured_depth
from lidar2pano.views import VIEWS, View
from random_weights import CAMERA, LICENCE, PAINTER, TRANSLATOR_VIEW, spread_norms, street, write_scan, write_weights

SKY = COMMON15.id_of("sky")


@pytest.fixture(scope="module")
def pipeline(random_weights):
    return load(random_weights, "cpu")


@pytest.fixture(scope="module")
def panorama(pipeline) -> Panorama:
    return pipeline(street())


def same(one: Panorama, other: Panorama) -> bool:
    same_arrays = all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("colour", "segments", "depth_m", "labels")
    )
    return same_arrays and (one.name, one.frame, one.view) == (other.name, other.frame, other.view)


# --- single, sequence and stream are one function -------------------------------------------------------------------


def test_folding_by_hand_is_the_stream_and_its_first_is_the_single(pipeline):
    scans = [street(seed=seed) for seed in (1, 2)]
    streamed = list(pipeline.stream(iter(scans)))
    memory, folded = Memory(), []
    for scan in scans:
        memory, panorama = pipeline.step(memory, scan)
        folded.append(panorama)
    assert all(itertools.starmap(same, zip(streamed, folded, strict=True)))
    assert [one.frame for one in streamed] == [0, 1]
    assert memory == Memory(frames=2)
    assert same(pipeline(scans[0]), streamed[0])
    assert not same(pipeline(scans[1]), streamed[0])


def test_a_stream_with_poses_is_smoothed(pipeline):
    """The second picture of a sensor that stands, of the same scan by another painter's taste, is mostly the first."""

    class Moody:
        def __init__(self):
            self.moods = iter((-0.5, 0.1, 0.1))

        def paint(self, past, scene, look):
            rows, columns = scene.depth_m.shape[1:]
            return past, torch.full((1, 3, 2 * rows, 2 * columns), next(self.moods))

    scan, still = street(seed=1), np.eye(4)
    plain = [one.colour for one in replace(pipeline, painter=Moody()).stream([scan] * 2)]
    steady = list(replace(pipeline, painter=Moody()).stream([scan] * 2, [still] * 2))
    assert (plain[0] == 64).all() and (plain[1] == 140).all()
    mean = (64 * LEAST_IMAGES + 140) / (LEAST_IMAGES + 1)
    assert (steady[0].colour == 64).all() and (np.abs(steady[1].colour - mean) < 1).mean() > 0.9
    assert list(steady[1].milliseconds)[-4:] == ["fuse", "paint", "steady", "finish"]
    assert (steady[1].segments == steady[0].segments).mean() > 0.999  # but for ties
    memory, _ = replace(pipeline, painter=Moody()).step(Memory(), scan, still)
    assert memory.previous is not None and memory.around is not None
    again, _ = replace(pipeline, painter=Moody()).step(memory, scan)
    assert (again.previous, again.around) == (None, None), "without a pose it begins again"


def test_a_stream_with_poses_paints_the_mean_of_its_scans(pipeline):
    """A sensor that stands and sees two streets: the second picture is painted of what `fused` makes of both."""
    painted = []

    class Noting:
        def paint(self, past, scene, look):
            painted.append(scene)
            return past, torch.zeros(1, 3, *(2 * length for length in scene.depth_m.shape[1:]))

    scans, still = [street(seed=1), street(seed=2)], np.eye(4)
    list(replace(pipeline, painter=Noting()).stream(scans, [still] * 2))
    first, second = (
        Surroundings.of(replace(pipeline.translate(scan, Timer(pipeline.device)), T_world_sensor=still))
        for scan in scans
    )
    mean = fused(second, first, pipeline.view)
    assert (mean.depth_m - second.depth_m).abs().max() > 0.1, "the streets differ"
    for scene, expected in zip(painted, (first, mean), strict=True):
        assert torch.allclose(scene.probabilities, expected.probabilities, atol=1e-5)
        assert torch.allclose(scene.depth_m, expected.depth_m, rtol=1e-4)


def test_streams_share_nothing(pipeline):
    one, other = pipeline.stream([street(seed=1)] * 2), pipeline.stream([street(seed=2)] * 2)
    assert [next(one).frame, next(other).frame, next(one).frame] == [0, 0, 1]


@pytest.mark.parametrize(("poses", "cameras", "missing"), [([None], None, "pose"), (None, [()], "list of cameras")])
def test_a_scan_without_a_pose_or_cameras_of_its_own_is_an_error_and_not_left_out(pipeline, poses, cameras, missing):
    stream = pipeline.stream([street(seed=1), street(seed=2)], poses, cameras)
    next(stream)
    with pytest.raises(InputError, match=f"no {missing} is left for scan 1 .*give one for each scan"):
        next(stream)


def test_the_scans_end_a_stream_whatever_poses_and_cameras_are_left(pipeline):
    assert len(list(pipeline.stream([street()], itertools.repeat(None), itertools.repeat(())))) == 1
    assert len(list(pipeline.stream([street()], [None] * 3, [()] * 3))) == 1


# --- what comes out -------------------------------------------------------------------------------------------------


def test_shapes_and_types(panorama):
    rows, columns = 2 * TRANSLATOR_VIEW.rows, 2 * TRANSLATOR_VIEW.columns
    assert panorama.view == TRANSLATOR_VIEW.scaled(2)
    expected = {
        "colour": ((rows, columns, 3), np.uint8),
        "segments": ((rows, columns), np.uint8),
        "depth_m": ((rows, columns), np.float32),
        "confidence": ((rows, columns), np.float32),
        "measured": ((rows, columns), np.bool_),
        "labels": ((len(street()),), np.int64),
    }
    assert {name: (getattr(panorama, name).shape, getattr(panorama, name).dtype) for name in expected} == expected
    assert panorama.segments.max() < len(COMMON15)
    assert panorama.labels.max() < len(SEMANTIC_KITTI)
    assert list(panorama.milliseconds) == ["project", "segment", "clean_up", "translate", "paint", "finish"]
    assert panorama.colour.std() > 0


def test_confidence_is_the_probability_of_the_class(pipeline, panorama, tmp_path):
    most = pipeline.translate(street(), Timer(pipeline.device)).probabilities.amax(1, keepdim=True)
    assert most.min() > 1 / len(COMMON15) - 1e-6 and panorama.confidence.max() <= 1
    assert np.array_equal(panorama.confidence, upsample_azimuth(most, 2)[0, 0].numpy())
    (path,) = panorama.save(tmp_path, "confidence")
    assert path.name == "street.confidence.png"
    assert np.abs(read_image(path) / 255 - panorama.confidence).max() <= 0.5 / 255 + 1e-6


def test_measured_pixels_have_the_distance_of_their_nearest_point(panorama, tmp_path):
    image = project(street(), panorama.view)
    assert np.array_equal(panorama.measured, image.valid.numpy()) and panorama.measured.any()
    assert np.array_equal(panorama.depth_m[panorama.measured], image.channels[0][image.valid].numpy())
    (path,) = panorama.save(tmp_path, "measured")
    assert path.name == "street.measured.png"
    assert np.array_equal(read_image(path), panorama.measured * np.uint8(255))


def as_paper(pipeline: Pipeline) -> PaperPipeline:
    pipeline.translator.input_view = pipeline.view
    return PaperPipeline(**{part.name: getattr(pipeline, part.name) for part in fields(Pipeline)})


def test_predicted_depths_keep_to_the_measurement(pipeline):
    """Of our translator; a network of the paper predicts its own depths, as its scores are."""
    raw = []
    network = pipeline.translator
    watched = replace(pipeline, translator=lambda *inputs: raw.append(network(*inputs)) or raw[-1])
    scene = watched.translate(street(), Timer(pipeline.device))
    logits, depth_m = raw[0]
    assert torch.equal(scene.probabilities, logits.float().softmax(1)) and not torch.equal(scene.depth_m, depth_m)
    expected = measured_depth(depth_m, scene.channels, scene.ids, scene.viewpoint_m, pipeline.view)
    assert torch.equal(scene.depth_m, expected)
    paper = as_paper(watched).translate(street(), Timer(pipeline.device))
    assert torch.equal(paper.probabilities, raw[1][0].float().softmax(1)) and torch.equal(paper.depth_m, raw[1][1])


def test_networks_see_points_between_the_beams_of_a_sparse_sensor(pipeline):
    """Labels are of the scan's own points; networks of the paper are given the scan as it is."""
    points = 12 * directions(VIEWS["hdl64e"])[1::4].reshape(-1, 3).numpy()
    scan = Scan(xyz=points, remission=np.full(len(points), 0.3, np.float32))
    inputs, network, timer = [], pipeline.translator, Timer(pipeline.device)
    watched = replace(pipeline, translator=lambda *tensors: inputs.append(tensors) or network(*tensors))
    scene = watched.translate(scan, timer)
    sparse = project(scan, pipeline.view)
    assert scene.measured.sum() > 1.3 * sparse.valid.sum()
    assert scene.points.labels.shape == (len(scan),)
    assert torch.equal(scene.points.labels, pipeline.segmenter.points(scan))
    assert (scene.points.dropped, scene.points.beyond_rows) == (0, 0)
    panorama = pipeline(scan)
    assert panorama.points_between == scene.points.points_between > 0
    assert np.array_equal(panorama.measured, project(scan, panorama.view).valid.numpy()), "of the scan's own points"
    labels = np.full(len(scan), 9)
    labelled = watched.translate(scan, timer, labels)
    channels, condition = inputs[1]
    assert labelled.points.labels.tolist() == labels.tolist()
    assert torch.equal(condition[0, 9] == 1, channels[0, 0] > 0), "of the nearest point of the scan"
    paper = as_paper(watched)
    assert torch.equal(paper.translate(scan, timer).channels[0], sparse.channels)


def test_nothing_is_claimed_out_of_view(pipeline):
    panorama = pipeline(replace(street(), gaps_deg=((60.0, -60.0),)))
    assert (panorama.confidence == 0).any() and not panorama.measured[panorama.confidence == 0].any()


def test_every_point_has_a_label_and_dropped_ones_have_none(pipeline):
    scan = street()
    xyz = scan.xyz.copy()
    xyz[3], xyz[5], xyz[7] = np.nan, (np.inf, 0, 0), 0
    broken = pipeline(replace(scan, xyz=xyz))
    assert broken.dropped == 3
    assert broken.labels.shape == (len(scan),)
    assert broken.labels[[3, 5, 7]].tolist() == [0, 0, 0]
    assert (broken.labels != 0).mean() > 0.5


def test_the_vehicle_itself_is_not_in_the_image(pipeline):
    scan = street()
    own = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)).astype(np.float32)  # a roof, or "no echo" as some write
    more = replace(
        scan, xyz=np.concatenate([own, scan.xyz]), remission=np.pad(scan.remission, (400, 0), constant_values=0.5)
    )
    plain, found = pipeline(scan), pipeline(more)
    assert found.dropped == plain.dropped + 400 and not found.labels[:400].any()
    assert np.array_equal(found.labels[400:], plain.labels) and np.array_equal(found.colour, plain.colour)
    assert np.array_equal(found.depth_m, plain.depth_m)


def test_points_beyond_the_segmenters_rows_are_counted(pipeline):
    scan = street()
    plain, xyz = pipeline(scan), scan.xyz.copy()
    xyz[:7, 2] = np.hypot(xyz[:7, 0], xyz[:7, 1])  # 45 degrees above the horizon
    xyz[7:10] = (0.3, 0, -1.7)
    xyz[10:12] = np.nan
    found = pipeline(replace(scan, xyz=xyz))
    assert (found.beyond_rows - plain.beyond_rows, found.dropped) == (10, 2)


def test_nothing_is_claimed_out_of_the_field_of_view(pipeline):
    whole, part = pipeline(street()), pipeline(replace(street(), gaps_deg=((-90.0, -270.0),)))
    quarter = part.segments.shape[1] // 4  # the columns run from 180 down to -180 degrees
    for found in (part.segments, part.depth_m):
        assert not found[:, :quarter].any() and not found[:, -quarter:].any()
    inside = (slice(None), slice(quarter, -quarter))
    assert np.array_equal(part.segments[inside], whole.segments[inside]) and part.segments[inside].any()
    assert np.array_equal(part.depth_m[inside], whole.depth_m[inside])
    assert np.array_equal(part.colour, whole.colour)


@pytest.mark.parametrize("point", [(np.nan, 0, 0), (0, 0, 0), (np.inf, 1, 1), (0.3, 0.3, -0.2)])
def test_a_scan_without_a_usable_point_is_refused(pipeline, point):
    scan = Scan(xyz=np.full((4, 3), point, np.float32), remission=np.zeros(4, np.float32), name="bad")
    with pytest.raises(InputError, match=r"bad: none of its 4 points can be used"):
        pipeline(scan)


def test_a_scan_out_of_view_is_refused(pipeline):
    scan = Scan(xyz=np.full((4, 3), (1, 0, 50), np.float32), remission=np.zeros(4, np.float32), name="up")
    with pytest.raises(InputError, match="up: no point is in view"):
        pipeline(scan)


class Fixed(nn.Module):
    """A translator that says sky above the third row, road below, and 10 m everywhere."""

    def forward(self, image, condition):
        logits = image.new_zeros(1, len(COMMON15), *image.shape[2:])
        logits[:, SKY, :3], logits[:, 7, 3:] = 5, 5
        return logits, image.new_full((1, *image.shape[2:]), 10.0)


def test_the_sky_has_no_depth(pipeline):
    found = replace(pipeline, translator=Fixed())(street())
    assert (found.segments[:6] == SKY).all() and (found.segments[6:] == 7).all()
    assert (found.depth_m[:6] == 0)[~found.measured[:6]].all() and (found.depth_m[6:] > 0).all()
    assert (found.depth_m[found.measured] > 0).all(), "but a point that was measured keeps its distance"


def test_the_viewpoint_can_be_moved_to_a_camera(pipeline):
    moved = pipeline.at(CAMERA)
    assert moved.view.origin == pytest.approx((0.3, 0.1, -0.2))
    assert (moved(street()).segments != pipeline(street()).segments).any()


def test_a_sensor_has_its_own_rows(pipeline):
    assert pipeline.for_sensor("os1-64").segmenter.view == VIEWS["os1-64"]
    with pytest.raises(InputError, match="no sensor 'os1-46'; did you mean 'os1-64'"):
        pipeline.for_sensor("os1-46")
    with pytest.raises(InputError, match="no sensor 'panorama'"):
        pipeline.for_sensor("panorama")


# --- all directions are alike ---------------------------------------------------------------------------------------


def inputs_of(pipeline, scan):
    around = project(scan, pipeline.view)
    classes = torch.randint(0, 20, (len(scan),), generator=torch.Generator().manual_seed(0))
    return around.channels[None], one_hot_layers(around.spread(classes)[None], 20)


@pytest.mark.parametrize("columns", [16, -160])
def test_turning_the_scene_turns_what_is_painted(pipeline, columns):
    def outputs(image, condition):
        with torch.inference_mode():
            logits, depth_m = pipeline.translator(image, condition)
            return logits, depth_m

    image, condition = inputs_of(pipeline, street())
    still, turned = outputs(image, condition), outputs(image.roll(columns, 3), condition.roll(columns, 3))
    for before, after in zip(still, turned, strict=True):
        spread = before.std()
        assert spread > 0
        assert (after - before.roll(columns, -1)).abs().max() < 1e-3 * spread


def test_there_is_no_seam(pipeline):
    image, condition = (found[..., :1].expand_as(found).contiguous() for found in inputs_of(pipeline, street()))
    with torch.inference_mode():  # a scene that is the same in every direction
        logits = pipeline.translator(image, condition)[0][0]
    jump = (logits - logits.roll(1, -1)).abs().mean((0, 1))[::16]  # where one coarsest cell meets the next
    assert jump[0] > 0
    assert torch.allclose(jump, jump[0].expand_as(jump), rtol=1e-3)


# --- parts ----------------------------------------------------------------------------------------------------------


def test_folding_norms_changes_nothing():
    torch.manual_seed(3)
    plain = spread_norms(build("titan-pano", widths=[8] * 5)).eval()
    folded = build("titan-pano", widths=[8] * 5).eval()
    folded.load_state_dict(plain.state_dict())
    fold_norms(folded)
    assert sum(isinstance(layer, nn.BatchNorm2d) for layer in folded.modules()) == 0
    inputs = torch.rand(1, 5, 16, 64), torch.rand(1, 20, 16, 64)
    with torch.inference_mode():
        before, after = plain(*inputs), folded(*inputs)
    for one, other in zip(before, after, strict=True):
        assert (one - other).abs().max() < 1e-3 * one.abs().max()


@pytest.mark.parametrize(("factor", "chunk"), [(2, 7), (2, 1 << 15), (3, 100), (1, 100)])
def test_grown_classes_are_those_of_the_grown_logits(factor, chunk):
    logits = torch.randn(1, 16, 12, 40, generator=torch.Generator().manual_seed(7))
    logits[:, 3, 4:, 15:35] += 9  # inside, all pixels are of one class
    expected = upsample_azimuth(logits, factor)[0].argmax(0).to(torch.uint8)
    for layout in (torch.contiguous_format, torch.channels_last):
        assert torch.equal(upsample_classes(logits.to(memory_format=layout), factor, chunk), expected)
    probabilities = logits.softmax(1)
    expected = upsample_azimuth(probabilities.clamp(min=1e-3).log(), factor)[0].argmax(0).to(torch.uint8)
    assert torch.equal(upsample_classes(probabilities, factor, chunk, least=1e-3), expected)


class Copies(nn.Module):
    """A network whose class is what the range channel says; it keeps what it was shown."""

    def forward(self, x):
        self.inputs = x
        return one_hot_layers(x[:, 0].round().long().clamp(0, 19), 20)


@pytest.mark.parametrize(("turn", "beyond"), [(360.0, [1.0] * 8), (90.0, [0.0] * 8)])
def test_columns_need_not_divide(turn, beyond):
    view = View(rows=16, columns=200, up=10, down=-10, left=turn / 2, right=-turn / 2)
    azimuth = np.radians(turn / 2 - (np.arange(200) + 0.5) * turn / 200)
    range_m = 1 + np.arange(200) // 20
    xyz = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0.01 * range_m], axis=1).astype(np.float32)
    network = Copies()
    plain = Normalisation(mean=(0,) * 5, deviation=(1,) * 5)
    segmenter = Segmenter(network=network, view=view, normalise=plain)
    ids = segmenter.raster(project(Scan(xyz=xyz, remission=np.zeros(200, np.float32)), view))
    assert ids.shape == (16, 200) and ids.dtype == torch.uint8
    assert ids.max(0).values.tolist() == range_m.tolist()
    assert network.inputs.shape == (1, 5, 16, 208)
    assert network.inputs[0, 0].max(0).values[200:].round().tolist() == beyond


def test_a_sensor_that_measures_more_gets_more_rows():
    view = replace(VIEWS["hdl64e"], columns=256)
    azimuth = np.radians(np.tile(np.arange(0, 360, 2.0), 3))
    elevation, range_m = np.radians(np.repeat([-10.0, 0.0, 15.0], 180)), np.repeat([3.0, 5.0, 9.0], 180)
    level = range_m * np.cos(elevation)
    xyz = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)], 1)
    scan = Scan(xyz=xyz.astype(np.float32), remission=np.zeros(540, np.float32))
    network, plain = Copies(), Normalisation(mean=(0,) * 5, deviation=(1,) * 5)
    segmenter = Segmenter(network=network, view=view, normalise=plain, tallest=VIEWS["hdl64e-tall"])
    assert segmenter.points(scan).tolist() == range_m.tolist()
    assert network.inputs.shape == (1, 5, 96, 256)
    fixed = segmenter.at(view)
    assert fixed.points(scan)[360:].tolist() != range_m[360:].tolist(), "out of view"
    assert network.inputs.shape == (1, 5, 64, 256)


def test_rows_must_divide(pipeline):
    view = replace(VIEWS["hdl64e"], rows=40, columns=64)
    with pytest.raises(InputError, match="a range image of 40 x 64 pixels: rows, columns must divide by 16"):
        replace(pipeline.segmenter, view=view).points(street())


# --- files ----------------------------------------------------------------------------------------------------------


def pixels(path: Path, mode: str | None = None) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image.convert(mode) if mode else image)


def test_saved_files_read_back(panorama, tmp_path):
    files = panorama.save(tmp_path / "out", ("rgb", "segments", "labels", "depth"), CAMERA)
    names = ["street.png", "street.camera.png", "street.segments.png", "street.camera-segments.png", "street.label",
             "street.depth.png"]  # fmt: skip
    assert [file.name for file in files] == names
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == sorted(names)
    read = {file.name: pixels(file) for file in files if file.suffix == ".png"}
    assert np.array_equal(read["street.png"], panorama.colour)
    assert np.array_equal(read["street.segments.png"], panorama.segments)
    assert np.array_equal(pixels(tmp_path / "out" / "street.segments.png", "RGB"), COMMON15.paint(panorama.segments))
    depth = read["street.depth.png"]
    assert depth.dtype in (np.uint16, np.int32)
    assert np.abs(depth / 256 - panorama.depth_m).max() <= 1 / 512
    raw = np.fromfile(tmp_path / "out" / "street.label", "<u4")
    assert np.array_equal(SEMANTIC_KITTI.from_raw(raw), panorama.labels) and raw.max() > 20
    camera = panorama.to_camera(CAMERA)
    assert np.array_equal(read["street.camera.png"], camera.colour)
    assert np.array_equal(read["street.camera-segments.png"], camera.segments)
    assert camera.colour.shape == (25, 80, 3) and camera.segments.shape == (25, 80)


def test_where_the_panorama_does_not_reach_in_a_camera_is_a_file(panorama, tmp_path):
    above = np.array([[0.0, 0, 0], [0, 0, 88], [0, 0, 0]])  # rows of the image that look over the panorama
    high = replace(CAMERA, K=CAMERA.K + above, size=(80, 200))
    files = panorama.save(tmp_path, ("rgb", "valid"), high)
    assert [file.name for file in files] == ["street.png", "street.camera.png", "street.camera-valid.png"]
    valid = pixels(files[2])
    assert valid.dtype == np.uint8 and set(np.unique(valid)) == {0, 255}
    assert np.array_equal(valid == 255, panorama.to_camera(high).valid) and not pixels(files[1])[valid == 0].any()
    with pytest.raises(InputError, match="valid is where the panorama reaches in a camera's image"):
        panorama.save(tmp_path, "valid")


def test_deep_depths_do_not_wrap_around(panorama, tmp_path):
    far = replace(panorama, depth_m=np.full_like(panorama.depth_m, 300.0))
    (file,) = far.save(tmp_path, ("depth",))
    assert (pixels(file) == 0xFFFF).all()


def test_nothing_is_left_where_nothing_can_be_written(panorama, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        panorama.save(tmp_path / "file" / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_an_interrupted_save_leaves_nothing(panorama, tmp_path, monkeypatch):
    def interrupted(path, *_, **__):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("lidar2pano.panorama.write_colour", interrupted)
    with pytest.raises(KeyboardInterrupt):
        panorama.save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_to_save_is_checked(panorama, tmp_path):
    with pytest.raises(InputError, match="'colour'; there is rgb"):
        panorama.save(tmp_path, ("colour",))


def test_one_sort_of_output_may_be_given_as_a_word(panorama, tmp_path):
    assert [file.name for file in panorama.save(tmp_path, "depth")] == ["street.depth.png"]


def test_a_scan_file_may_be_given_by_its_path(pipeline, tmp_path):
    file = write_scan(tmp_path / "street.bin")
    assert same(pipeline(file), pipeline(street())) and same(pipeline(str(file)), pipeline(street()))


# --- weights --------------------------------------------------------------------------------------------------------


def test_weights_without_a_painter_say_so(random_weights, tmp_path, monkeypatch):
    install_only(monkeypatch, tmp_path)
    with pytest.raises(InputError, match="no weights for the segmenter and the painter"):
        load(random_weights / "translator.safetensors", "cpu")


def test_a_default_family_fills_what_is_missing(random_weights, tmp_path, monkeypatch):
    install_only(monkeypatch, random_weights.parent)
    own = write_weights(tmp_path, "other", "latent-painter", PAINTER)
    files = weight_files(own)
    assert files == {role: random_weights / f"{role}.safetensors" for role in ("segmenter", "translator")} | {
        "painter": own
    }
    assert weight_files(own, fill=False) == {"painter": own}
    assert weight_files(random_weights.name) == weight_files(random_weights)


def test_two_files_for_one_role_are_refused(random_weights, tmp_path):
    for name in ("a", "b"):
        write_weights(tmp_path, name, "latent-painter", PAINTER)
    with pytest.raises(InputError, match="a.safetensors and b.safetensors are both a painter"):
        weight_files(tmp_path)


def test_of_several_painters_a_look_names_one(random_weights, tmp_path):
    """As the paper has one vid2vid for KITTI's look and one for that of Cityscapes."""
    kitti, city = (write_weights(tmp_path / "both", name, "vid2vid", GENERATOR) for name in ("kitti", "cityscapes"))
    assert weight_files(tmp_path / "both", fill=False, look="kitti") == {"painter": kitti}
    assert weight_files(tmp_path / "both", fill=False, look="cityscapes") == {"painter": city}
    chain = f"{random_weights}+{city}+{kitti}"
    assert weight_files(chain)["painter"] == weight_files(chain, look="day")["painter"] == kitti
    assert weight_files(chain, look="cityscapes")["painter"] == city
    with pytest.raises(InputError, match=r"are both a painter; name one of them \(for painters, --look"):
        weight_files(tmp_path / "both", fill=False, look="day")


def test_looks_that_are_files_are_painted(random_weights, tmp_path, capsys):
    scan = str(write_scan(tmp_path / "a.bin"))
    for number, name in enumerate(("kitti", "cityscapes")):
        torch.manual_seed(number)
        write_weights(tmp_path / "both", name, "vid2vid", GENERATOR)
    for role in ("segmenter", "translator"):
        (tmp_path / "both" / f"{role}.safetensors").symlink_to(random_weights / f"{role}.safetensors")
    command = ["translate", scan, "--device", "cpu", "--weights", str(tmp_path / "both")]
    for look in ("kitti", "cityscapes"):
        assert main([*command, "--look", look, "--out", str(tmp_path / look)]) == 0
    kitti, city = (read_image(tmp_path / look / "a.png") for look in ("kitti", "cityscapes"))
    assert not np.array_equal(kitti, city)
    capsys.readouterr()
    one = f"{random_weights}+{tmp_path / 'both' / 'kitti.safetensors'}"
    assert main([*command[:-1], one, "--look", "dusk", "--out", str(tmp_path / "dusk")]) == 2
    assert "no look 'dusk'" in capsys.readouterr().err


def test_a_latent_painter_has_qualities_and_several_pictures(random_weights, tmp_path, capsys):
    weights, scan = str(random_weights), street()
    plain = load(weights, "cpu", "torch")
    pictures = [plain, *(plain.in_variant(*variant) for variant in (("fast", 0), ("fast", 5), ("best", 0)))]
    usual, again, another, best = (pipeline(scan) for pipeline in pictures)
    assert np.array_equal(usual.colour, again.colour)
    assert not np.array_equal(usual.colour, another.colour) and not np.array_equal(usual.colour, best.colour)
    assert np.array_equal(usual.segments, another.segments) and np.array_equal(usual.depth_m, best.depth_m)
    assert [pipeline.painter.steps for pipeline in pictures] == [2, 2, 2, 4], "the pipeline it came from stays as it is"
    file = write_scan(tmp_path / "a.bin")
    command = ["translate", str(file), "--device", "cpu", "--weights", weights, "--out", str(tmp_path / "out")]
    assert main([*command, "--seed", "5"]) == 0
    assert np.array_equal(read_image(tmp_path / "out" / "a.png"), pictures[2](file).colour)
    capsys.readouterr()
    video = f"{weights}+{write_weights(tmp_path, 'video', 'vid2vid', GENERATOR)}"
    for options, message in (
        (("--quality", "bets"), "no quality 'bets'; did you mean 'best'?"),
        (("--quality", "best", "--weights", video), "these weights paint one picture, in one quality"),
        (("--seed", "1", "--weights", video), "these weights paint one picture, in one quality"),
    ):
        assert main(["translate", str(file), "--weights", weights, "--out", str(tmp_path), *options]) == 2
        assert message in capsys.readouterr().err


def test_a_run_gives_its_best_weights(tmp_path):
    best = write_weights(tmp_path / "weights", "painter", "latent-painter", PAINTER)
    write_weights(tmp_path / "weights", "painter.last", "latent-painter", PAINTER)
    assert weight_files(tmp_path, fill=False) == {"painter": best}


@pytest.mark.parametrize(
    ("views", "said"),
    [
        ({}, r"translator.safetensors: its card has no view 'panorama'"),
        ({"panorama": {"rows": 4}}, "its view 'panorama' needs rows and columns"),
        ({"panorama": 3}, "its 'views'.panorama must be an object"),
    ],
)
def test_a_card_without_its_view_is_refused(random_weights, tmp_path, views, said):
    network, card = load_weights(random_weights / "translator.safetensors")
    for role in ("segmenter", "painter"):
        (tmp_path / f"{role}.safetensors").symlink_to(random_weights / f"{role}.safetensors")
    with pytest.raises(InputError, match=said):
        save(tmp_path / "translator.safetensors", network, replace(card, views=views))
        load(tmp_path, "cpu")


def test_a_strict_licence_is_noted(random_weights, tmp_path):
    assert LICENCE in (licence_note(map(read_card, weight_files(random_weights).values())) or "")
    network, card = load_weights(random_weights / "painter.safetensors")
    save(tmp_path / "painter.safetensors", network, replace(card, licence="Apache-2.0"))
    assert json.loads(read_card(tmp_path / "painter.safetensors").to_json())["licence"] == "Apache-2.0"
    assert licence_note([read_card(tmp_path / "painter.safetensors")]) is None


# --- a painter with a memory ----------------------------------------------------------------------------------------

GENERATOR = {"channels": 16, "widths": [8], "downsamplings": 2, "blocks": [1, 1], "foreground": [1]}
SINGLE = {"classes": 16, "width": 8, "downsamplings": 1, "blocks": 1}


def video_weights(random_weights: Path, folder: Path, single: bool = False, **card) -> Path:
    """A folder with segmenter, translator and an untrained vid2vid that paints on the segments' raster."""
    folder.mkdir()
    for role in ("segmenter", "translator"):
        (folder / f"{role}.safetensors").symlink_to(random_weights / f"{role}.safetensors")
    write_weights(folder, "vid2vid", "vid2vid", GENERATOR, **{"views": {"panorama": TRANSLATOR_VIEW.as_dict()}, **card})
    if single:
        write_weights(folder, "vid2vid-single", "vid2vid-single", SINGLE)
    return folder


@pytest.mark.parametrize("single", [False, True])
def test_a_video_painter_paints_the_stream_frame_after_frame(random_weights, tmp_path, single):
    pipeline = load(video_weights(random_weights, tmp_path / "video", single), "cpu")
    assert isinstance(pipeline.painter, Vid2VidPainter)
    assert (pipeline.painter.single is not None) == single
    scans = [street(seed=seed) for seed in (1, 2, 3)]
    panoramas = list(pipeline.stream(scans))
    shape = (2 * TRANSLATOR_VIEW.rows, 2 * TRANSLATOR_VIEW.columns, 3)
    assert all(one.colour.shape == shape and one.colour.std() > 0 for one in panoramas)
    assert same(pipeline(scans[0]), panoramas[0])
    assert not np.array_equal(pipeline(scans[2]).colour, panoramas[2].colour)
    assert np.array_equal(pipeline(scans[2]).segments, panoramas[2].segments)
    memory = Memory()
    for scan, expected in zip(scans, panoramas, strict=True):
        memory, panorama = pipeline.step(memory, scan)
        assert same(panorama, expected)
    assert same(pipeline.step(memory, scans[0])[1], pipeline.step(memory, scans[0])[1])


def test_the_panorama_is_what_the_video_painter_painted(random_weights, tmp_path):
    pipeline = load(video_weights(random_weights, tmp_path / "video"), "cpu")
    scene = pipeline.translate(street(), Timer(pipeline.device))
    with torch.inference_mode(), fast_arithmetic(pipeline.device):
        _, colours = pipeline.painter.follow(None, upsample_classes(scene.probabilities, 1))
    expected = ((upsample_azimuth(colours[None], 2)[0] + 1) * 127.5).round().movedim(0, 2)
    assert np.array_equal(pipeline(street()).colour, expected.numpy())


def test_a_video_painter_without_a_raster_paints_the_finished_one(random_weights, tmp_path):
    painter = load(video_weights(random_weights, tmp_path / "video", views={}), "cpu").painter
    assert isinstance(painter, Vid2VidPainter) and painter.finer == 2


def test_a_video_painter_that_does_not_fit_is_named(random_weights, tmp_path):
    with pytest.raises(
        InputError, match=r"vid2vid.safetensors: it paints panoramas of 432 columns, .* translator's 576"
    ):
        load(
            video_weights(
                random_weights, tmp_path / "raster", views={"panorama": VIEWS["panorama"].scaled(3 / 32).as_dict()}
            ),
            "cpu",
        )
    folder = video_weights(random_weights, tmp_path / "classes")
    write_weights(folder, "vid2vid-single", "vid2vid-single", {**SINGLE, "classes": 35})
    with pytest.raises(InputError, match=r"vid2vid.safetensors: the first-frame network reads 35 classes"):
        load(folder, "cpu")


def test_first_frames_need_a_video_painter(random_weights, tmp_path):
    for role in ("segmenter", "translator", "painter"):
        (tmp_path / f"{role}.safetensors").symlink_to(random_weights / f"{role}.safetensors")
    single = write_weights(tmp_path, "vid2vid-single", "vid2vid-single", SINGLE)
    with pytest.raises(
        InputError, match=f"{single}: paints the first frames for a 'vid2vid', which .*painter.safetensors"
    ):
        load(tmp_path, "cpu")
    write_weights(tmp_path, "vid2vid", "vid2vid", GENERATOR)
    with pytest.raises(InputError, match=r"painter.safetensors and vid2vid.safetensors are both a painter"):
        load(tmp_path, "cpu")


def test_a_folder_of_scans_is_painted_as_one_stream(random_weights, tmp_path, capsys):
    weights = video_weights(random_weights, tmp_path / "video")
    for name in ("a/0.bin", "a/1.bin", "b/1.bin"):
        write_scan(tmp_path / name, street(seed=int(name[2])))
    folders = [str(tmp_path / name) for name in "ab"]
    assert (
        main(["translate", *folders, "--weights", str(weights), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    )
    assert LICENCE in capsys.readouterr().err
    pipeline = load(weights, "cpu")
    first, second = pipeline.stream([street(seed=0), street(seed=1)])
    expected = {"0": first, "a-1": second, "b-1": pipeline(street(seed=1))}
    for stem, panorama in expected.items():
        assert np.array_equal(pixels(tmp_path / "out" / f"{stem}.png"), panorama.colour)
    assert not np.array_equal(second.colour, expected["b-1"].colour)
