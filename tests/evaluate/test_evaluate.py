"""What evaluate counts, by hand, with systems whose predictions are given."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import IGNORE, Frame, PanoramaGroundTruth
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError
from lidar2pano.evaluate import MetricConfig, Prediction, SystemInput, report, score, system
from lidar2pano.evaluate.evaluation import ROLL, EvaluatedSystem, rotated
from lidar2pano.evaluate.ground_truth import (
    camera_distances,
    camera_flow,
    follows,
    panorama_flow,
    resampled,
    same_raster,
    windows,
)
from lidar2pano.evaluate.metric_collection import (
    DEFAULT_GROUPS,
    FeatureExtractor,
    ImageSegmenter,
    MetricCollection,
)
from lidar2pano.evaluate.panorama_system import SystemInfo
from lidar2pano.evaluate.pictures import WorstFrames
from lidar2pano.geometry.flow import Flow
from lidar2pano.geometry.projection import project
from lidar2pano.labels import CITYSCAPES, COMMON15
from lidar2pano.models.camera_teachers import CameraSegmenter, ImageNormalisation
from lidar2pano.panorama import Panorama
from lidar2pano.views import VIEWS, View
from poses import pose_of, somewhere
from random_weights import street, write_weights

ROAD, CAR, SKY, BUS = (COMMON15.id_of(name) for name in ("road", "car", "sky", "other-vehicle"))
TARGET = np.array([[ROAD] * 4 + [CAR] * 2, [SKY, IGNORE] + [CAR] * 4], np.uint8)  # of COMMON15
CITY = {ROAD: "road", CAR: "car", SKY: "sky"}  # the same classes of CITYSCAPES
POINTS = np.array([0, 1, 9, 9])  # unlabeled, car, road, road
SCAN = street(points=4)
RASTER = View(rows=16, columns=64, up=0.24, down=-0.24, kind="cylinder")


def camera(width: int = 6, height: int = 2) -> Calibration:
    """A camera at the sensor that looks ahead."""
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    K = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    return Calibration(K=K, T_camera_lidar=T, size=(width, height))


class Fixed:
    """A system with fixed predictions that keeps its inputs; its memory is the number of frames so far."""

    def __init__(self, name: str = "fixed", *, oracle: bool = False, **parts: object) -> None:
        networks = {"translator": {"recipe": "titan-pano-mini", "steps": 7, "hours": 0.5, "commit": "abc"}}
        self.info, self.uses_ground_truth, self.parts = SystemInfo(name=name, networks=networks), oracle, parts
        self.inputs: list[SystemInput] = []
        self.memories: list[object] = []

    def predict(self, inputs, memory=None):
        self.inputs.append(inputs)
        self.memories.append(memory)
        parts = {name: value(inputs) if callable(value) else value for name, value in self.parts.items()}
        if inputs.calibration is None:
            parts = {name: value for name, value in parts.items() if name in ("point_labels", "panorama")}
        return (memory or 0) + 1, Prediction(**parts)


def fixed(camera_labels=None, point_labels=(9, 1, 9, 1), **more) -> Fixed:
    camera_labels = None if camera_labels is None else np.array(camera_labels)
    return Fixed(camera_labels=camera_labels, point_labels=np.array(point_labels), **more)


def cityscapes(ids: np.ndarray) -> np.ndarray:
    """Train ids of CITYSCAPES for ids of COMMON15."""
    found = np.full_like(ids, IGNORE)
    for common, name in CITY.items():
        found[ids == common] = CITYSCAPES.id_of(name)
    return found


def frame_of(name: str = "00/000000", **parts: object) -> Frame:
    """A frame whose image has 6 x 2 pixels, and its scan 4 points; camera labels are ids of COMMON15."""
    known = {"scan": SCAN, "calibration": camera(), "camera_labels": TARGET, "point_labels": POINTS} | parts
    if known["camera_labels"] is not None:
        known["camera_labels"] = cityscapes(known["camera_labels"])
    return Frame(name, **known | {"scan": replace(known["scan"], name=name)})


def changed(frame: Frame, name: str = "", **parts: object) -> Frame:
    """The frame with other parts."""
    return Frame(name or frame.name, **{key: value for key, value in vars(frame).items() if key != "name"} | parts)


def scored(frames, *systems, **more):
    return score(systems, frames, data="mini", split="val", **more)


def value_of(evaluation, sector: str, name: str, which: int = 0) -> float:
    found = {(of, one): part.value for of, one, part in evaluation.values(evaluation.systems[which].metrics)}
    return found[sector, name]


# --- classes ---------------------------------------------------------------------------------------------------------


def test_counted_by_hand():
    one = fixed([[ROAD, ROAD, SKY, 0, CAR, ROAD], [ROAD, ROAD] + [CAR] * 4])
    evaluation = scored([frame_of()], one)
    iou = evaluation.systems[0].metrics.classes("camera").ious()
    assert iou[ROAD] == pytest.approx(2 / 5)  # 2 hits, 4 in the target, 1 more claimed; the last row's do not count
    assert iou[CAR] == pytest.approx(5 / 6)
    assert report.as_dict(evaluation)["results"][0]["score"] == {
        "segmenter": {"point_miou": pytest.approx(0.5), "point_accuracy": pytest.approx(2 / 3), "split": "val"},
        "translator": {
            "camera_miou": pytest.approx((2 / 5 + 5 / 6) / 2),
            "camera_accuracy": pytest.approx(7 / 10),
            "split": "val",
        },
    }
    assert one.inputs[0].calibration.size == (6, 2)


def test_answers_of_absent_classes_do_not_change_what_is_averaged():
    evaluation = scored([frame_of()], fixed([[ROAD] * 6] * 2, [1] * 4), fixed([[BUS] + [ROAD] * 5] * 2, [1] * 4))
    assert evaluation.target_classes() == [CAR, ROAD]
    mious = [one["score"]["translator"]["camera_miou"] for one in report.as_dict(evaluation)["results"]]
    assert mious == [pytest.approx(4 / 10 / 2), pytest.approx(3 / 10 / 2)]
    assert "the 2 of the paper's 14 classes" in report.as_dict(evaluation)["heading"]


def test_frames_with_camera_or_point_labels_only():
    points_only = scored([frame_of(calibration=None, camera_labels=None)], one := fixed([[ROAD] * 6] * 2, [9, 1, 9, 9]))
    assert points_only.counts == {"images": 0, "scans": 1, "camera_images": 0, "panoramas": 0, "following": 0}
    assert value_of(points_only, "points", "accuracy") == 1 and one.inputs[0].calibration is None
    assert "mIoU of 2 SemanticKITTI" in report.table(report.as_dict(points_only)) and "| road" not in report.table(
        report.as_dict(points_only)
    )
    json.dumps(report.as_dict(points_only), allow_nan=False)
    camera_only = scored([frame_of(point_labels=None)], fixed([[ROAD] * 6] * 2))
    assert (camera_only.counts["images"], camera_only.counts["scans"]) == (1, 0)
    assert "SemanticKITTI" not in report.table(report.as_dict(camera_only))
    with pytest.raises(InputError, match="00/000000 has neither camera_labels/ nor labels/"):
        scored([frame_of(calibration=None, camera_labels=None, point_labels=None)], fixed())


def test_only_the_oracle_receives_the_ground_frame_of():
    given = []
    for oracle in (False, True):
        scored([frame_of()], one := Fixed(oracle=oracle))
        given.append(one.inputs[0].camera_labels)
    assert given[0] is None
    assert given[1].tolist() == np.where(TARGET == IGNORE, 0, TARGET).tolist()
    heading = report.as_dict(scored([frame_of()], Fixed("oracle+x", oracle=True)))["heading"]
    assert "Input is the camera's ground-truth labels, not the scan: oracle+x." in heading


def test_the_first_frame_warms_up():
    one = EvaluatedSystem(system=fixed(), metrics=MetricCollection(MetricConfig()), worst=WorstFrames(0))
    one.milliseconds = {"translate": [100.0, 2.0, 4.0], "camera": [7.0]}
    assert one.mean_milliseconds() == {"translate": 3.0, "camera": 7.0}


def test_intervals_need_five_frames():
    other = np.full_like(TARGET, ROAD)
    frames = [frame_of(), *(frame_of(f"00/{number:06d}", camera_labels=other) for number in (7, 9, 11, 13))]
    few, all_five = (scored(frames[:count], fixed([[ROAD] * 6] * 2)) for count in (4, 5))
    assert "In brackets" not in report.as_dict(few)["heading"] and "In brackets" in report.as_dict(all_five)["heading"]
    assert "| accuracy |  | 0.870 |" in report.table(report.as_dict(few))
    found = {(of, one): part for of, one, part in all_five.values(all_five.systems[0].metrics)}["camera", "accuracy"]
    assert (found.value, found.high, found.frames) == (pytest.approx(52 / 58), 1.0, 5) and 0.4 < found.low < 0.8
    assert "| accuracy |  | 0.897 (0." in report.table(report.as_dict(all_five))


@pytest.mark.parametrize(
    ("groups", "parts", "said"),
    [
        (("time",), {}, "camera time, because that needs frames that follow each other, with poses and depths, and"),
        (("points",), {"point_labels": None}, "points, because that needs point labels"),
        (("classes",), {}, "panorama, because that needs ground-truth panoramas"),
    ],
)
def test_metrics_that_cannot_be_measured_are_named_with_their_needs(groups, parts, said):
    config = MetricConfig(groups=groups)
    heading = report.as_dict(scored([frame_of(**parts)], fixed([[ROAD] * 6] * 2), config=config))["heading"]
    assert f"Not measured: {said}" in heading
    assert "camera classes" not in heading


def test_a_steady_system_uses_poses_of_frames_that_follow_each_other():
    (one := fixed()).steady = True
    frames = [frame_of(f"00/{number:06d}", pose=np.eye(4)) for number in (0, 1)]
    assert "Input is the sensor's pose beside the scan: fixed." in report.as_dict(scored(frames, one))["heading"]
    heading = report.as_dict(scored(frames[:1], one))["heading"]
    assert "sensor's pose" not in heading
    assert "Not smoothed over time, because no frame with a pose follows another: fixed." in heading


# --- system inputs ---------------------------------------------------------------------------------------------------


def test_metrics_are_chosen_by_words():
    every = MetricConfig.parse(device="cpu")
    assert every.groups == DEFAULT_GROUPS and "roll" not in every.groups and every.colours
    some = MetricConfig.parse("classes, points,camera", device="cpu")
    assert (some.groups, some.sectors, some.colours) == (("points", "classes"), ("camera",), False)
    assert MetricConfig.parse("roll", device="cpu").groups == ("roll",)
    with pytest.raises(InputError, match="--metrics: nothing is called 'class'; did you mean 'classes'"):
        MetricConfig.parse("class", device="cpu")


@pytest.mark.parametrize(
    ("words", "colours", "sectors"),
    [
        (None, True, {"camera", "panorama", "points"}),
        ("classes", False, {"camera", "panorama"}),
        ("points", False, {"points"}),
        ("camera", True, {"camera", "points"}),
        ("panorama,classes", False, {"panorama"}),
    ],
)
def test_only_the_requested_metrics_are_counted(words, colours, sectors):
    one = fixed([[ROAD] * 6] * 2, panorama=lambda inputs: around(inputs) if inputs.origin else None)
    evaluation = scored([frame_of(panorama=true_panorama())], one, config=MetricConfig.parse(words, device="cpu"))
    assert {sector for sector, _ in evaluation.systems[0].metrics.metrics} == sectors
    assert one.inputs[0].colours is colours
    viewpoints = {"camera": one.inputs[0].calibration, "panorama": one.inputs[0].origin}
    assert {name for name, part in viewpoints.items() if part is not None} == sectors - {"points"}


# --- images ----------------------------------------------------------------------------------------------------------


def noise(seed: int, rows: int = 24, columns: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def with_image(name: str, seed: int, **parts: object) -> Frame:
    known = {"camera_labels": None, "point_labels": None, "image": noise(seed)} | parts
    return frame_of(name, calibration=camera(80, 24), **known)


def test_images_are_compared_with_the_cameras():
    frames = [with_image("00/000000", 0), with_image("00/000005", 1)]
    same = Fixed("same", image=lambda inputs: noise({"00/000000": 0, "00/000005": 1}[inputs.scan.name]))
    other = Fixed("other", image=lambda inputs: noise(7))
    evaluation = scored(frames, same, other, Fixed("nothing"))
    assert evaluation.counts["camera_images"] == 2 and evaluation.counts["images"] == 0
    assert value_of(evaluation, "camera", "ssim") == pytest.approx(1)
    assert value_of(evaluation, "camera", "ssim", 1) < 0.1
    assert value_of(evaluation, "camera", "swd") < value_of(evaluation, "camera", "swd", 1)
    table = report.table(report.as_dict(evaluation))
    assert "no Inception weights" in report.as_dict(evaluation)["heading"] and "| FID |" not in table
    ssim = next(line for line in table.splitlines() if line.startswith("| SSIM"))
    assert ssim.startswith("| SSIM |  | 1.000 | 0.0") and ssim.endswith("| - |")
    assert "against the camera's images (2)" in report.as_dict(evaluation)["heading"]
    assert "mIoU of" not in table
    json.dumps(report.as_dict(evaluation), allow_nan=False)


def test_metrics_by_other_networks(tmp_path):
    calls = []

    def features(images):
        calls.append(images)
        return images.float().mean((2, 3))

    class Road(torch.nn.Module):
        """Predicts road where it is dark and sky elsewhere."""

        def __init__(self) -> None:
            super().__init__()
            self.one = torch.nn.Parameter(torch.ones(()))

        def forward(self, images, scales):
            dark = (images.mean(1) < 0).float()
            logits = torch.zeros(1, len(CITYSCAPES), *images.shape[2:])
            logits[:, CITYSCAPES.id_of("road")], logits[:, CITYSCAPES.id_of("sky")] = 9 * dark, 9 * (1 - dark)
            return logits

    segmenter = CameraSegmenter(network=Road(), normalise=ImageNormalisation(mean=(0.5,) * 3, deviation=(0.5,) * 3))
    extractors = [FeatureExtractor(features=features, sha256=name * 32) for name in ("ab", "cd")]
    image_segmenter = ImageSegmenter(segmenter=segmenter, features=extractors[0], sha256="ab" * 32)
    config = MetricConfig(inception=extractors[1], image_segmenter=image_segmenter)
    ids = np.full((24, 80), ROAD, np.uint8)
    ids[:, 40:] = CAR
    true = np.zeros((24, 80, 3), np.uint8)
    frames = [with_image(name, 0, image=true, camera_labels=ids) for name in ("00/000000", "00/000005")]
    bright = np.where(np.arange(80)[None, :, None] < 20, np.uint8(0), np.uint8(250)) * np.ones((24, 1, 3), np.uint8)
    evaluation = scored(frames, Fixed("a", image=bright), Fixed("b", image=true), config=config)
    assert value_of(evaluation, "camera", "resegmentation_accuracy") == pytest.approx(0.25)
    assert value_of(evaluation, "camera", "fid") == pytest.approx(3 * (250 * 0.75) ** 2, rel=1e-6)
    assert value_of(evaluation, "camera", "fsd") == value_of(evaluation, "camera", "fid")
    assert value_of(evaluation, "camera", "fid", 1) == 0
    (own,) = [part for _, one, part in evaluation.values(evaluation.reference) if one == "resegmentation_accuracy"]
    assert own.value == pytest.approx(0.5)  # all of the camera image is dark, half of it is road
    table = report.table(report.as_dict(evaluation))
    assert "| FSD (features of abababab) |" in table and "| re-segmentation mIoU | ground truth 0.250 |" in table
    assert (report.as_dict(evaluation)["inception"], report.as_dict(evaluation)["camera_segmenter"]) == (
        "cd" * 32,
        "ab" * 32,
    )
    assert len(calls) < 2 * 2 * 2 * 2  # frames, systems, sides, networks: features of the ground truth are cached


def test_a_camera_segmenters_file(tmp_path):
    sdnet = {"width": 4, "stem": 4, "blocks": 1, "modules": [1, 1, 1], "context": 8}
    normal = ImageNormalisation().as_dict()
    write_weights(tmp_path / "weights", "camera", "sdnet", sdnet, labels="cityscapes", normalisation=normal)
    eye = MetricConfig.parse(sdnet=tmp_path, device="cpu").image_segmenter
    assert eye is not None and len(eye.sha256) == 64
    image = noise(3, 64, 96)
    ids = eye.segment(image)
    assert ids.shape == (64, 96) and int(ids.max()) < len(COMMON15)
    features = eye.features(torch.from_numpy(image).movedim(2, 0)[None])
    network, images = eye.segmenter.network, torch.from_numpy(image).movedim(2, 0)[None]
    with torch.inference_mode():
        context = network.ocr(network.backbone(eye.segmenter.normalise(images))).features
    assert features.shape == (1, 8) and torch.allclose(features[0], context[0].flatten(1).mean(1), rtol=1e-4)
    assert context.shape[2] > 1 and context.std((2, 3)).max() > 0
    assert MetricConfig.parse("classes", sdnet=tmp_path, device="cpu").image_segmenter is None  # no metric needs it
    for words in ("pictures", "points"):
        with pytest.raises(InputError, match="no weight file"):
            MetricConfig.parse(words, sdnet=tmp_path / "none", device="cpu")
        with pytest.raises(InputError, match="no such file; FID needs"):
            MetricConfig.parse(words, inception=tmp_path / "none", device="cpu")


def test_depths_are_compared_with_dense_ones_alone():
    parts = {"calibration": camera(8, 4), "camera_labels": np.full((4, 8), ROAD, np.uint8)}
    exact = camera_distances(frame_of(**parts, panorama=true_panorama()), camera(8, 4)).nan_to_num(posinf=0).numpy()
    systems = [
        Fixed(depth_m=factor * exact, panorama=lambda inputs: around(inputs) if inputs.origin else None)
        for factor in (1, 1.5)
    ]
    evaluation = scored([frame_of(**parts, panorama=true_panorama())], *systems)
    assert value_of(evaluation, "camera", "depth_abs_rel") == 0
    assert value_of(evaluation, "camera", "depth_abs_rel", 1) == pytest.approx(0.5)
    gaps = np.where(np.arange(64) % 2, 0, true_panorama().depth_m).astype(np.float32)  # as of a scan, the input
    for panorama in (None, true_panorama(depth_m=gaps)):
        evaluation = scored([frame_of(**parts, panorama=panorama)], *systems)
        assert not [one for _, one, _ in evaluation.values(evaluation.systems[0].metrics) if "depth" in one]
        assert "camera depth" in report.as_dict(evaluation)["heading"]


# --- panoramas --------------------------------------------------------------------------------------------------------


def true_panorama(**parts: object) -> PanoramaGroundTruth:
    ids = np.full((16, 64), ROAD, np.uint8)
    ids[:4] = SKY
    ids[8:, :16] = CAR
    depth_m = np.where(ids == SKY, 0, 10).astype(np.float32)
    image, valid = noise(5, 16, 64), np.ones((16, 64), bool)
    known = {"view": RASTER, "image": image, "valid": valid, "labels": ids, "depth_m": depth_m}
    return PanoramaGroundTruth(**known | parts)


def around(inputs: SystemInput, view: View = RASTER, **parts: object) -> Panorama:
    """A panorama of road everywhere, 8 m away."""
    size = (view.rows, view.columns)
    known = {
        "name": inputs.scan.name,
        "frame": 0,
        "view": replace(view, origin=inputs.origin),
        "colour": noise(5, 16, 64) if size == (16, 64) else np.zeros((*size, 3), np.uint8),
        "segments": np.full(size, ROAD, np.uint8),
        "depth_m": np.full(size, 8, np.float32),
        "labels": np.zeros(len(inputs.scan), np.int64),
    }
    return Panorama(**known | parts)


def test_images_of_a_stitched_panorama_are_counted():
    vars(frame := SurroundFrame("00/000000", RASTER)).update(vars(with_image("a", 0, panorama=true_panorama())))
    vars(frame).update(name="00/000000", camera_names=("front", "left", "right"))
    heading = report.as_dict(scored([frame], Fixed(panorama=around)))["heading"]
    assert "1 images of the front camera" in heading and "ground-truth panoramas (1, of 3 camera images)" in heading


def test_panoramas_by_hand():
    labels = true_panorama().labels.copy()
    labels[5, :7] = IGNORE
    true = true_panorama(labels=labels)
    evaluation = scored([frame_of(panorama=true)], Fixed(panorama=around))
    assert evaluation.counts["panoramas"] == 1
    assert evaluation.target_classes("panorama") == [CAR, ROAD]
    scored_pixels = 12 * 64 - 7
    roads = scored_pixels - 8 * 16
    assert value_of(evaluation, "panorama", "accuracy") == pytest.approx(roads / scored_pixels)
    assert value_of(evaluation, "panorama", "miou") == pytest.approx(roads / scored_pixels / 2)
    assert value_of(evaluation, "panorama", "depth_abs_rel") == pytest.approx(0.2)
    assert value_of(evaluation, "panorama", "depth_rmse_m") == pytest.approx(2)
    assert value_of(evaluation, "panorama", "ssim") == pytest.approx(1)
    table = report.table(report.as_dict(evaluation))
    assert "| panorama: car | 16.8% | 0.000 |" in table and "| panorama: **mIoU of 2** |" in table
    assert (
        "| panorama: seam ratio | ground truth " in table
        and "against ground-truth panoramas (1)" in report.as_dict(evaluation)["heading"]
    )
    assert report.as_dict(evaluation)["panorama_classes"] == ["car", "road"]
    assert report.as_dict(evaluation)["results"][0]["score"]["translator"]["panorama_depth_abs_rel"] == pytest.approx(
        0.2
    )


def test_colours_count_where_they_are_known():
    valid = np.ones((16, 64), bool)
    valid[:, 40:] = False
    image = true_panorama().image.copy()
    image[:, 40:] = 0
    true = true_panorama(valid=valid, image=image)
    frames = [frame_of(panorama=true), frame_of("00/000009", panorama=true)]
    evaluation = scored(frames, Fixed(panorama=around))
    assert value_of(evaluation, "panorama", "ssim") == pytest.approx(1)
    (swd,) = [part for _, one, part in evaluation.values(evaluation.systems[0].metrics) if one == "swd"]
    assert swd.frames == 2 * 3  # quarters of which half is known; the third is
    kept = list(windows(around(SystemInput(scan=SCAN, origin=(0, 0, 0))).colour, image, valid))
    assert [one.shape for one, _ in kept] == [(16, 16, 3)] * 3
    assert all(np.array_equal(one, other) for one, other in kept) and (kept[2][0][:, 8:] == 128).all()
    assert not [one for _, one, _ in evaluation.values(evaluation.reference) if one == "seam_ratio"]  # it is not known


def test_an_unpainted_panorama_has_classes_but_no_colours():
    evaluation = scored([frame_of(panorama=true_panorama())], Fixed(panorama=around, painted=False))
    names = {name for sector, name in evaluation.systems[0].metrics.metrics if sector == "panorama"}
    assert names == {"classes", "depth"}


def test_a_panorama_on_another_raster():
    fine = VIEWS["panorama"].scaled(1 / 24)  # 16 x 192
    coarse = replace(fine, rows=8, columns=96)
    assert same_raster(fine, replace(fine, origin=(1.0, 2.0, 3.0))) and not same_raster(fine, coarse)
    assert not same_raster(fine, replace(fine, kind="sphere"))
    column = np.arange(192)
    ids = np.broadcast_to((column // 2 % 14).astype(np.uint8), (16, 192))
    colour = np.broadcast_to((column // 2).astype(np.uint8)[:, None], (16, 192, 3))
    inputs = SystemInput(scan=SCAN, origin=(0.3, 0.0, 0.0))
    depth_m = np.ones((16, 192), np.float32)
    panorama = around(inputs, fine, segments=ids.copy(), colour=colour.copy(), depth_m=depth_m)
    moved = resampled(panorama, coarse)
    assert moved.labels.shape == (8, 96) and (moved.labels == np.arange(96) % 14).all()
    assert (moved.image[..., 0] == np.arange(96)).all() and (moved.depth_m == 1).all()
    assert resampled(panorama, replace(fine, origin=(9.0, 9.0, 9.0))).image is panorama.colour
    higher = resampled(panorama, replace(fine, rows=32, up=fine.up + (fine.up - fine.down)))
    assert (higher.labels[:16] == 0).all() and (higher.depth_m[:16] == 0).all()  # it does not reach there
    assert np.array_equal(higher.labels[16:], ids) and np.array_equal(higher.image[16:], colour)


# --- videos ----------------------------------------------------------------------------------------------------------


def test_frames_follow_each_other_by_number_and_pose():
    first, second, third = (frame_of(f"00/{number:06d}", pose=np.eye(4)) for number in (3, 4, 6))
    assert follows(first, second) and not follows(second, third) and not follows(None, first)
    assert not follows(first, changed(second, name="01/000004"))
    assert not follows(first, changed(second, pose=None)) and not follows(changed(first, pose=None), second)
    frames = [first, second, third, changed(third, name="00/000007")]
    scored(frames, one := fixed([[ROAD] * 6] * 2))
    assert one.memories == [None, 1, None, 1]


def test_flicker_of_what_stands_still():
    ids = np.full((24, 80), ROAD, np.uint8)
    scan = street(points=6000)
    frames = [
        with_image(f"00/{number:06d}", 0, pose=np.eye(4), panorama=true_panorama(), scan=scan, camera_labels=ids)
        for number in range(3)
    ]
    still = np.full((24, 80, 3), 100, np.uint8)

    def flickering(inputs):
        return still + np.uint8(51 * (next(number) % 2))

    number = iter(range(9))
    evaluation = scored(frames, Fixed(image=still, panorama=around), Fixed(image=flickering))
    assert value_of(evaluation, "camera", "warping_error") == pytest.approx(0, abs=1e-12)
    assert value_of(evaluation, "camera", "warping_error", 1) == pytest.approx(3 * 0.2**2)
    assert value_of(evaluation, "panorama", "warping_error") == pytest.approx(0)
    assert "| warping error x 1000 | ground truth 0.00 | 0.00 | 120.00 |" in (report.table(report.as_dict(evaluation)))


def test_flicker_counts_where_the_flow_is_known():
    known = torch.zeros(24, 80, dtype=torch.bool)
    known[:, :40] = True
    before, now = noise(0), noise(0)
    now[:, 40:] = noise(1)[:, 40:]
    for sector in ("camera", "panorama"):
        flow = Flow(shift=torch.zeros(2, 24, 80), known=known)
        (metrics := MetricCollection(MetricConfig())).warping(sector, now, before, flow, "00/000001")
        metric = metrics.metrics[sector, "warping"]
        assert metric.compute() == pytest.approx(0, abs=1e-12) and metric.circular == (sector == "panorama")


def test_the_flow_follows_the_pose():
    step = np.eye(4)
    step[0, 3] = 1.0  # one metre ahead
    true = true_panorama()
    frames = [frame_of(f"00/{n:06d}", pose=pose, panorama=true) for n, pose in enumerate((np.eye(4), step))]
    flow = panorama_flow(*frames)
    assert flow is not None and flow.shift.shape == (2, 16, 64)
    side = flow.shift[0, 5][flow.known[5]]
    assert side.abs().max() > 0.5  # what is at the side has gone back
    assert flow.known[:3].all()  # of the sky only the direction counts, and that did not turn
    assert flow.shift[:, :3].abs().max() < 1e-4
    hidden = true_panorama(valid=np.zeros((16, 64), bool))
    assert not panorama_flow(changed(frames[0], panorama=hidden), frames[1]).known.any()
    assert panorama_flow(changed(frames[0], panorama=None), frames[1]) is None
    for off, known in ((1e-9, True), (1.0, False)):
        near = true_panorama(view=replace(RASTER, origin=(off, 0.0, 0.0)))
        assert (panorama_flow(changed(frames[0], panorama=near), frames[1]) is not None) == known
    assert camera_flow(changed(frames[0], camera_labels=None), frames[1]) is None
    assert camera_flow(*frames).shift.shape == (2, 2, 6)


@pytest.mark.parametrize("flow_of", [camera_flow, panorama_flow])
def test_the_flow_is_of_the_motion_between_poses_wherever_they_are(flow_of):
    """A turn to the left moves all to the right: it was farther left."""

    def flow(world):
        poses = (world, world @ pose_of(6, 0, 0, (0.2, 0.1, 0)))
        return flow_of(*(frame_of(f"00/{n:06d}", pose=T, panorama=true_panorama()) for n, T in enumerate(poses)))

    found, elsewhere = flow(np.eye(4)), flow(somewhere())
    assert torch.equal(found.known, elsewhere.known)
    torch.testing.assert_close(found.shift, elsewhere.shift, atol=1e-4, rtol=0)
    assert found.known.any() and (found.shift[0][found.known] < 0).all()


def test_the_flow_of_what_may_move_is_not_known():
    # the side of a bus that goes along keeps its depth: poses alone would have it stand
    true = true_panorama()
    some = np.s_[4:7, 10:20]
    pair = [frame_of(f"00/{n:06d}", pose=np.eye(4), panorama=true) for n in (0, 1)]
    assert panorama_flow(*pair).known[some].all()
    for name, known in (("other-vehicle", False), ("car", False), ("person", False), ("building", True)):
        labels = np.array(true.labels)
        labels[some] = COMMON15.id_of(name)
        marked = [changed(one, panorama=replace(true, labels=labels)) for one in pair]
        flow = panorama_flow(*marked)
        assert flow.known[some].any() == known and flow.known[some].all() == known
        assert torch.equal(flow.known[:, 20:], panorama_flow(*pair).known[:, 20:])
    true_ids = np.array(pair[1].camera_labels)
    bus, wall = (CITYSCAPES.id_of(name) for name in ("bus", "building"))
    for name, known in ((bus, False), (wall, True)):
        flow = camera_flow(pair[0], changed(pair[1], camera_labels=np.full_like(true_ids, name)))
        assert flow.known.any() == known


def test_sparse_depths_are_completed_for_the_flow():
    depth_m = np.zeros((16, 64), np.float32)
    depth_m[5, ::7] = 10
    sparse = true_panorama(labels=None, depth_m=depth_m)
    scan = street(points=4000)
    pair = [frame_of(f"00/{n:06d}", pose=np.eye(4), panorama=sparse, scan=scan) for n in (0, 1)]
    flow = panorama_flow(*pair)
    assert flow is not None and flow.known.float().mean() > 0.5 and flow.shift.abs().max() < 1e-3
    ball = true_panorama(labels=None, depth_m=depth_m, view=replace(RASTER, kind="sphere", up=10, down=-10))
    assert panorama_flow(*(changed(one, panorama=ball) for one in pair)) is None  # gaps are filled on a cylinder


def test_depths_of_the_camera_are_the_panoramas_where_it_stands_there():
    here = camera(8, 4)
    frame = frame_of(calibration=here, camera_labels=np.full((4, 8), ROAD, np.uint8), panorama=true_panorama())
    found = camera_distances(frame, here)
    assert set(found.unique().tolist()) <= {0.0, 10.0, float("inf")} and (found == 10).any()
    apart = changed(frame, panorama=true_panorama(view=replace(RASTER, origin=(0.0, 0.0, 1.0))))
    assert not (camera_distances(apart, here) == 10).any()  # only the scan's four points


# --- rotation --------------------------------------------------------------------------------------------------------


def test_a_rotated_scan_makes_a_rotated_range_image():
    view = VIEWS["panorama"].scaled(1 / 8)
    columns = round(ROLL * view.columns)
    scan, R = rotated(street(), columns, view.columns)
    origin = tuple((R @ np.array(view.origin)).tolist())
    straight, other = project(street(), view), project(scan, replace(view, origin=origin))
    same = (straight.index.roll(columns, 1) == other.index).float().mean()
    assert same > 0.999  # some points lie on the border of two pixels
    assert np.allclose(R @ R.T, np.eye(3)) and R[2, 2] == 1


def test_roll_error_of_panoramas_that_rotate_and_that_do_not():
    def rotating(inputs):
        x, y, _ = inputs.scan.xyz[0].astype(float)
        start = int(round(-np.arctan2(y, x) / (2 * np.pi) * 64))
        return around(inputs, colour=np.roll(noise(5, 16, 64), start, 1), segments=np.roll(block, start, 1))

    block = true_panorama().labels
    config = MetricConfig.parse("roll", device="cpu")
    evaluation = scored(
        [frame_of(panorama=true_panorama())], Fixed(panorama=rotating), Fixed(panorama=around), config=config
    )
    assert value_of(evaluation, "panorama", "roll_error") == 0 == value_of(evaluation, "panorama", "roll_error_ids")
    assert value_of(evaluation, "panorama", "roll_error", 1) > 50
    scored([frame_of(panorama=true_panorama())], plain := Fixed(panorama=around))
    assert len(plain.inputs) == 1  # twice only on request


# --- real weights ----------------------------------------------------------------------------------------------------


def test_real_weights_score_through_and_through(random_weights):
    evaluation = scored([frame_of(panorama=true_panorama())], system(random_weights, device="cpu"))
    (one,) = report.as_dict(evaluation)["results"]
    assert one["networks"]["translator"]["network"] == "titan-pano"
    assert {value["sector"] for value in one["values"]} == {"camera", "panorama", "points"}
