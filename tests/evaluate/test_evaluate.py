"""What evaluate counts, by hand, with systems that answer what they are told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.data.sequences import UNSURE
from lidar2pano.data.truths import TruePanorama, Truth
from lidar2pano.errors import InputError
from lidar2pano.evaluate import Measures, Question, Seen, score, system
from lidar2pano.evaluate.contenders import ROLL, Contender, turned
from lidar2pano.evaluate.measures import DEFAULT_KINDS, CameraEye, Extractor
from lidar2pano.evaluate.questions import Origin
from lidar2pano.evaluate.rasters import between, carried, same_raster, windows
from lidar2pano.evaluate.streams import camera_flow, follows, panorama_flow
from lidar2pano.evaluate.tallies import Moved, Tally
from lidar2pano.evaluate.worst import Worst
from lidar2pano.geometry.flow import Flow
from lidar2pano.geometry.projection import project
from lidar2pano.labels import CITYSCAPES, COMMON15
from lidar2pano.models.camera_segmenter import CameraSegmenter, Colours
from lidar2pano.panorama import Panorama
from lidar2pano.views import VIEWS, View
from random_weights import street, write_weights

ROAD, CAR, SKY, BUS = (COMMON15.id_of(name) for name in ("road", "car", "sky", "other-vehicle"))
TARGET = np.array([[ROAD] * 4 + [CAR] * 2, [SKY, UNSURE] + [CAR] * 4], np.uint8)
POINTS = np.array([0, 1, 9, 9])  # unlabeled, car, road, road
SCAN = street(points=4)
RASTER = View(rows=16, columns=64, up=0.24, down=-0.24, kind="cylinder")


def camera(width: int = 6, height: int = 2) -> Calibration:
    """A camera at the sensor that looks ahead."""
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    K = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    return Calibration(K=K, T_camera_lidar=T, size=(width, height))


class Told:
    """A system that gives fixed answers and keeps the questions; its past is how many frames it has seen."""

    def __init__(self, name: str = "told", *, told: bool = False, **seen: object) -> None:
        networks = {"translator": {"recipe": "titan-pano-mini", "steps": 7, "hours": 0.5, "commit": "abc"}}
        self.origin, self.told, self.answer = Origin(name=name, networks=networks), told, seen
        self.asked: list[Question] = []
        self.pasts: list[object] = []

    def see(self, question, past=None):
        self.asked.append(question)
        self.pasts.append(past)
        answer = {name: value(question) if callable(value) else value for name, value in self.answer.items()}
        if question.calibration is None:
            answer = {name: value for name, value in answer.items() if name in ("labels", "panorama")}
        return (past or 0) + 1, Seen(**answer)


def told(ids=None, labels=(9, 1, 9, 1), **more) -> Told:
    answer = {"ids": None if ids is None else np.array(ids), "labels": np.array(labels), **more}
    return Told(**answer)


def truth(name: str = "00/000000", **parts: object) -> Truth:
    """A frame whose image has 6 x 2 pixels, and its scan 4 points."""
    known = {"calibration": camera(), "camera_ids": TARGET, "point_ids": POINTS} | parts
    return Truth(name=name, scan=replace(SCAN, name=name), **{k: v for k, v in known.items() if v is not None})


def scored(truths, *systems, **more):
    return score(systems, truths, data="mini", split="val", **more)


def figure(evaluation, sector: str, name: str, which: int = 0) -> float:
    found = {(one.sector, one.name): one.value for one in evaluation.figures(evaluation.contenders[which].tally)}
    return found[sector, name]


# --- classes ---------------------------------------------------------------------------------------------------------


def test_counted_by_hand():
    one = told([[ROAD, ROAD, SKY, 0, CAR, ROAD], [ROAD, ROAD] + [CAR] * 4])
    evaluation = scored([truth()], one)
    iou = evaluation.contenders[0].tally.classes("camera").confusion().iou()
    assert iou[ROAD] == pytest.approx(2 / 5)  # 2 hits, 4 in the target, 1 more claimed; the last row's do not count
    assert iou[CAR] == pytest.approx(5 / 6)
    assert evaluation.as_dict()["results"][0]["score"] == {
        "segmenter": {"point_miou": pytest.approx(0.5), "point_accuracy": pytest.approx(2 / 3), "split": "val"},
        "translator": {
            "camera_miou": pytest.approx((2 / 5 + 5 / 6) / 2),
            "camera_accuracy": pytest.approx(7 / 10),
            "split": "val",
        },
    }
    assert one.asked[0].calibration.size == (6, 2)


def test_answers_of_absent_classes_do_not_change_what_is_averaged():
    evaluation = scored([truth()], told([[ROAD] * 6] * 2, [1] * 4), told([[BUS] + [ROAD] * 5] * 2, [1] * 4))
    assert evaluation.counted() == [CAR, ROAD]
    mious = [one["score"]["translator"]["camera_miou"] for one in evaluation.as_dict()["results"]]
    assert mious == [pytest.approx(4 / 10 / 2), pytest.approx(3 / 10 / 2)]
    assert "the 2 of the paper's 14 classes" in evaluation.heading()


def test_frames_with_one_kind_of_label():
    points_only = scored([truth(calibration=None, camera_ids=None)], one := told([[ROAD] * 6] * 2, [9, 1, 9, 9]))
    assert (points_only.images, points_only.scans) == (0, 1)
    assert figure(points_only, "points", "accuracy") == 1 and one.asked[0].calibration is None
    assert "mIoU of 2 SemanticKITTI" in points_only.table() and "| road" not in points_only.table()
    json.dumps(points_only.as_dict(), allow_nan=False)
    camera_only = scored([truth(point_ids=None)], told([[ROAD] * 6] * 2))
    assert (camera_only.images, camera_only.scans) == (1, 0)
    assert "SemanticKITTI" not in camera_only.table()
    with pytest.raises(InputError, match="00/000000 has neither camera_labels/ nor labels/"):
        scored([truth(calibration=None, camera_ids=None, point_ids=None)], told())


def test_only_the_ceiling_is_told_the_classes():
    asked = []
    for ceiling in (False, True):
        scored([truth()], one := Told(told=ceiling))
        asked.append(one.asked[0].ids)
    assert asked[0] is None
    assert asked[1].tolist() == np.where(TARGET == UNSURE, 0, TARGET).tolist()
    heading = scored([truth()], Told("truth+x", told=True)).heading()
    assert "Told the camera's true classes, not the scan: truth+x." in heading


def test_the_first_frame_warms_up():
    one = Contender(system=told(), tally=Tally(Measures()), worst=Worst(0))
    one.milliseconds = {"translate": [100.0, 2.0, 4.0], "camera": [7.0]}
    assert one.mean_milliseconds() == {"translate": 3.0, "camera": 7.0}


def test_intervals_need_several_frames():
    ids = [[ROAD] * 6] * 2
    other = np.full_like(TARGET, ROAD)
    alone, both = scored([truth()], told(ids)), scored([truth(), truth("00/000007", camera_ids=other)], told(ids))
    assert "In brackets" not in alone.heading() and "In brackets" in both.heading()
    found = {(one.sector, one.name): one for one in both.figures(both.contenders[0].tally)}["camera", "accuracy"]
    assert (found.value, found.low, found.high, found.frames) == (pytest.approx(16 / 22), 0.4, 1.0, 2)
    assert "| accuracy |  | 0.727 (0.400 to 1.000) |" in both.table()


# --- what is asked ---------------------------------------------------------------------------------------------------


def test_measures_are_words():
    every = Measures.of("", device="cpu")
    assert every.kinds == DEFAULT_KINDS and "roll" not in every.kinds and every.painted
    some = Measures.of("classes, points,camera", device="cpu")
    assert (some.kinds, some.sectors, some.painted) == (("points", "classes"), ("camera",), False)
    assert Measures.of("roll", device="cpu").kinds == ("roll",)
    with pytest.raises(InputError, match="--metrics: nothing is called 'class'; did you mean 'classes'"):
        Measures.of("class", device="cpu")


@pytest.mark.parametrize(
    ("words", "asked", "sectors"),
    [
        ("", True, {"camera", "panorama", "points"}),
        ("classes", False, {"camera", "panorama"}),
        ("points", False, {"points"}),
        ("camera", True, {"camera", "points"}),
        ("panorama,classes", False, {"panorama"}),
    ],
)
def test_measured_is_what_was_asked_for(words, asked, sectors):
    one = told([[ROAD] * 6] * 2, panorama=lambda question: around(question) if question.origin else None)
    evaluation = scored([truth(panorama=true_panorama())], one, measures=Measures.of(words, device="cpu"))
    assert {sector for sector, _ in evaluation.contenders[0].tally.metrics} == sectors
    assert one.asked[0].painted is asked
    asked_for = {name for name, part in vars_of(one.asked[0]).items() if part is not None}
    assert asked_for == sectors - {"points"}


def vars_of(question: Question) -> dict[str, object]:
    return {"camera": question.calibration, "panorama": question.origin}


# --- pictures --------------------------------------------------------------------------------------------------------


def noise(seed: int, rows: int = 24, columns: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def pictured(name: str, seed: int, **parts: object) -> Truth:
    return truth(name, calibration=camera(80, 24), camera_ids=None, point_ids=None, picture=noise(seed), **parts)


def test_pictures_are_compared_with_the_cameras():
    frames = [pictured("00/000000", 0), pictured("00/000005", 1)]
    same = Told("same", colour=lambda question: noise({"00/000000": 0, "00/000005": 1}[question.scan.name]))
    other = Told("other", colour=lambda question: noise(7))
    blind = Told("blind")
    evaluation = scored(frames, same, other, blind)
    assert evaluation.pictures == 2 and evaluation.images == 0
    assert figure(evaluation, "camera", "ssim") == pytest.approx(1)
    assert figure(evaluation, "camera", "ssim", 1) < 0.1
    assert figure(evaluation, "camera", "swd") < figure(evaluation, "camera", "swd", 1)
    table = evaluation.table()
    assert "| FID |  | no Inception weights | no Inception weights | - |" in table
    ssim = next(line for line in table.splitlines() if line.startswith("| SSIM"))
    assert ssim.startswith("| SSIM |  | 1.000 (1.000 to 1.000) | 0.0") and ssim.endswith("| - |")
    assert "against the camera's pictures (2)" in evaluation.heading()
    assert "mIoU of" not in table
    json.dumps(evaluation.as_dict(), allow_nan=False)


def test_judges_with_weights_of_their_own(tmp_path):
    calls = []

    def features(pictures):
        calls.append(pictures)
        return pictures.float().mean((2, 3))

    class Road(torch.nn.Module):
        """Sees road where it is dark and sky elsewhere."""

        def __init__(self) -> None:
            super().__init__()
            self.one = torch.nn.Parameter(torch.ones(()))

        def forward(self, images, scales):
            dark = (images.mean(1) < 0).float()
            logits = torch.zeros(1, len(CITYSCAPES), *images.shape[2:])
            logits[:, CITYSCAPES.id_of("road")], logits[:, CITYSCAPES.id_of("sky")] = 9 * dark, 9 * (1 - dark)
            return logits

    segmenter = CameraSegmenter(network=Road(), normalise=Colours(mean=(0.5,) * 3, deviation=(0.5,) * 3))
    eye = CameraEye(segmenter=segmenter, features=Extractor(features=features, sha256="ab" * 32), sha256="ab" * 32)
    measures = Measures(inception=Extractor(features=features, sha256="cd" * 32), eye=eye)
    ids = np.full((24, 80), ROAD, np.uint8)
    ids[:, 40:] = CAR
    true = np.zeros((24, 80, 3), np.uint8)
    frames = [pictured("00/000000", 0), pictured("00/000005", 0)]
    frames = [replace(frame, picture=true, camera_ids=ids) for frame in frames]
    bright = np.where(np.arange(80)[None, :, None] < 20, np.uint8(0), np.uint8(250)) * np.ones((24, 1, 3), np.uint8)
    evaluation = scored(frames, Told("a", colour=bright), Told("b", colour=true), measures=measures)
    assert figure(evaluation, "camera", "resegmentation_accuracy") == pytest.approx(0.25)
    assert figure(evaluation, "camera", "fid") == pytest.approx(3 * (250 * 0.75) ** 2, rel=1e-6)
    assert figure(evaluation, "camera", "fsd") == figure(evaluation, "camera", "fid")
    assert figure(evaluation, "camera", "fid", 1) == 0
    (own,) = [one for one in evaluation.figures(evaluation.reference) if one.name == "resegmentation_accuracy"]
    assert own.value == pytest.approx(0.5)  # all of the truth is dark, half of it is road
    table = evaluation.table()
    assert "| FSD (features of abababab) |" in table and "| re-segmentation mIoU | truth 0.250 |" in table
    assert (evaluation.as_dict()["inception"], evaluation.as_dict()["camera_segmenter"]) == ("cd" * 32, "ab" * 32)
    assert len(calls) < 2 * 2 * 2 * 2  # frames, systems, sides, judges: the truth's are remembered


def test_a_camera_segmenters_file(tmp_path):
    sdnet = {"width": 4, "stem": 4, "blocks": 1, "modules": [1, 1, 1], "context": 8}
    normal = Colours().as_dict()
    write_weights(tmp_path / "weights", "camera", "sdnet", sdnet, labels="cityscapes", normalisation=normal)
    eye = Measures.of(sdnet=tmp_path, device="cpu").eye
    assert eye is not None and len(eye.sha256) == 64
    picture = noise(3, 64, 96)
    ids = eye.segment(picture)
    assert ids.shape == (64, 96) and int(ids.max()) < len(COMMON15)
    features = eye.features(torch.from_numpy(picture).movedim(2, 0)[None])
    network, images = eye.segmenter.network, torch.from_numpy(picture).movedim(2, 0)[None]
    with torch.inference_mode():
        context = network.ocr(network.backbone(eye.segmenter.normalise(images))).features
    assert features.shape == (1, 8) and torch.allclose(features[0], context[0].flatten(1).mean(1), rtol=1e-4)
    assert context.shape[2] > 1 and context.std((2, 3)).max() > 0
    assert Measures.of("classes", sdnet=tmp_path, device="cpu").eye is None  # nobody asks it
    with pytest.raises(InputError, match="no weight file"):
        Measures.of(sdnet=tmp_path / "none", device="cpu")
    with pytest.raises(InputError, match="no such file; FID needs"):
        Measures.of(inception=tmp_path / "none", device="cpu")


def test_the_cameras_depth_is_compared_with_the_scans_own():
    scan = street(points=400)
    frame = truth(calibration=camera(80, 24), camera_ids=np.zeros((24, 80), np.uint8), point_ids=None)
    frame = replace(frame, scan=scan)
    from lidar2pano.data.camera_rasters import camera_raster

    exact = camera_raster(scan, camera(80, 24), (24, 80))[1].numpy()
    evaluation = scored([frame], Told(depth_m=exact), Told(depth_m=1.5 * exact + 1.0 * (exact == 0)))
    assert figure(evaluation, "camera", "depth_abs_rel") == 0
    assert figure(evaluation, "camera", "depth_abs_rel", 1) == pytest.approx(0.5)


# --- all around ------------------------------------------------------------------------------------------------------


def true_panorama(**parts: object) -> TruePanorama:
    ids = np.full((16, 64), ROAD, np.uint8)
    ids[:4] = SKY
    ids[8:, :16] = CAR
    depth_m = np.where(ids == SKY, 0, 10).astype(np.float32)
    colour = noise(5, 16, 64)
    known = {"view": RASTER, "colour": colour, "valid": np.ones((16, 64), bool), "ids": ids, "depth_m": depth_m}
    return TruePanorama(**known | parts)


def around(question: Question, view: View = RASTER, **parts: object) -> Panorama:
    """A panorama that says road everywhere, 8 m away."""
    size = (view.rows, view.columns)
    known = {
        "name": question.scan.name,
        "frame": 0,
        "view": replace(view, origin=question.origin),
        "colour": noise(5, 16, 64) if size == (16, 64) else np.zeros((*size, 3), np.uint8),
        "segments": np.full(size, ROAD, np.uint8),
        "depth_m": np.full(size, 8, np.float32),
        "labels": np.zeros(len(question.scan), np.int64),
    }
    return Panorama(**known | parts)


def test_all_around_by_hand():
    ids = true_panorama().ids.copy()
    ids[5, :7] = UNSURE
    true = true_panorama(ids=ids)
    evaluation = scored([truth(panorama=true)], Told(panorama=around))
    assert evaluation.panoramas == 1
    assert evaluation.counted("panorama") == [CAR, ROAD]
    scored_pixels = 12 * 64 - 7
    roads = scored_pixels - 8 * 16
    assert figure(evaluation, "panorama", "accuracy") == pytest.approx(roads / scored_pixels)
    assert figure(evaluation, "panorama", "miou") == pytest.approx(roads / scored_pixels / 2)
    assert figure(evaluation, "panorama", "depth_abs_rel") == pytest.approx(0.2)
    assert figure(evaluation, "panorama", "depth_rmse_m") == pytest.approx(2)
    assert figure(evaluation, "panorama", "ssim") == pytest.approx(1)
    table = evaluation.table()
    assert "| all around: car | 16.8% | 0.000 |" in table and "| all around: **mIoU of 2** |" in table
    assert "| all around: seam ratio | truth " in table and "against true panoramas (1)" in evaluation.heading()
    assert evaluation.as_dict()["panorama_classes"] == ["car", "road"]
    assert evaluation.as_dict()["results"][0]["score"]["translator"]["panorama_depth_abs_rel"] == pytest.approx(0.2)


def test_colours_count_where_they_are_known():
    valid = np.ones((16, 64), bool)
    valid[:, 40:] = False
    colour = true_panorama().colour.copy()
    colour[:, 40:] = 0
    true = true_panorama(valid=valid, colour=colour)
    frames = [truth(panorama=true), truth("00/000009", panorama=true)]
    evaluation = scored(frames, Told(panorama=around))
    assert figure(evaluation, "panorama", "ssim") == pytest.approx(1)
    (swd,) = [one for one in evaluation.figures(evaluation.contenders[0].tally) if one.name == "swd"]
    assert swd.frames == 2 * 3  # quarters of which half is known; the third is
    kept = list(windows(around(Question(scan=SCAN, origin=(0, 0, 0))).colour, colour, valid))
    assert [mine.shape for mine, _ in kept] == [(16, 16, 3)] * 3
    assert all(np.array_equal(mine, theirs) for mine, theirs in kept) and (kept[2][0][:, 8:] == 128).all()
    assert not [one for one in evaluation.figures(evaluation.reference) if one.name == "seam_ratio"]  # it is not known


def test_an_unpainted_panorama_has_classes_but_no_colours():
    evaluation = scored([truth(panorama=true_panorama())], Told(panorama=around, painted=False))
    names = {name for sector, name in evaluation.contenders[0].tally.metrics if sector == "panorama"}
    assert names == {"classes", "depth"}


def test_a_panorama_on_another_raster():
    fine = VIEWS["panorama"].scaled(1 / 24)  # 16 x 192
    coarse = replace(fine, rows=8, columns=96)
    assert same_raster(fine, replace(fine, origin=(1.0, 2.0, 3.0))) and not same_raster(fine, coarse)
    assert not same_raster(fine, replace(fine, kind="sphere"))
    column = np.arange(192)
    ids = np.broadcast_to((column // 2 % 14).astype(np.uint8), (16, 192))
    colour = np.broadcast_to((column // 2).astype(np.uint8)[:, None], (16, 192, 3))
    question = Question(scan=SCAN, origin=(0.3, 0.0, 0.0))
    depth_m = np.ones((16, 192), np.float32)
    panorama = around(question, fine, segments=ids.copy(), colour=colour.copy(), depth_m=depth_m)
    moved = carried(panorama, coarse)
    assert moved.ids.shape == (8, 96) and (moved.ids == np.arange(96) % 14).all()
    assert (moved.colour[..., 0] == np.arange(96)).all() and (moved.depth_m == 1).all()
    assert carried(panorama, replace(fine, origin=(9.0, 9.0, 9.0))).colour is panorama.colour
    higher = carried(panorama, replace(fine, rows=32, up=fine.up + (fine.up - fine.down)))
    assert (higher.ids[:16] == 0).all() and (higher.depth_m[:16] == 0).all()  # it does not reach there
    assert np.array_equal(higher.ids[16:], ids) and np.array_equal(higher.colour[16:], colour)
    assert between(fine, coarse).valid.all()


# --- streams ---------------------------------------------------------------------------------------------------------


def test_frames_follow_each_other_by_number_and_pose():
    first, second, third = (truth(f"00/{number:06d}", pose=np.eye(4)) for number in (3, 4, 6))
    assert follows(first, second) and not follows(second, third) and not follows(None, first)
    assert not follows(first, replace(second, name="01/000004"))
    assert not follows(first, replace(second, pose=None)) and not follows(replace(first, pose=None), second)
    frames = [first, second, third, replace(third, name="00/000007")]
    scored(frames, one := told([[ROAD] * 6] * 2))
    assert one.pasts == [None, 1, None, 1]


def test_flicker_of_what_stands_still():
    ids = np.full((24, 80), ROAD, np.uint8)
    scan = street(points=6000)
    frames = [
        replace(pictured(f"00/{number:06d}", 0, pose=np.eye(4), panorama=true_panorama()), scan=scan, camera_ids=ids)
        for number in range(3)
    ]
    still = np.full((24, 80, 3), 100, np.uint8)

    def flickering(question):
        return still + np.uint8(51 * (next(number) % 2))

    number = iter(range(9))
    evaluation = scored(frames, Told(colour=still, panorama=around), Told(colour=flickering))
    assert figure(evaluation, "camera", "warping_error") == 0
    assert figure(evaluation, "camera", "warping_error", 1) == pytest.approx(3 * 0.2**2)
    assert figure(evaluation, "panorama", "warping_error") == pytest.approx(0)
    assert "| warping error x 1000 | truth 0.00 | 0.00 (0.00 to 0.00) | 120.00 (120.00 to 120.00) |" in (
        evaluation.table()
    )


def test_flicker_counts_where_the_flow_is_known():
    known = torch.zeros(24, 80, dtype=torch.bool)
    known[:, :40] = True
    before, now = noise(0), noise(0)
    now[:, 40:] = noise(1)[:, 40:]
    for sector in ("camera", "panorama"):
        moved = Moved(before=before, flow=Flow(shift=torch.zeros(2, 24, 80), known=known))
        (tally := Tally(Measures())).warped(sector, now, moved, "00/000001")
        metric = tally.metrics[sector, "warping"]
        assert metric.compute() == 0 and metric.circular == (sector == "panorama")


def test_the_flow_follows_the_pose():
    step = np.eye(4)
    step[0, 3] = 1.0  # one metre ahead
    true = true_panorama()
    frames = [truth(f"00/{n:06d}", pose=pose, panorama=true) for n, pose in enumerate((np.eye(4), step))]
    flow = panorama_flow(*frames)
    assert flow is not None and flow.shift.shape == (2, 16, 64)
    side = flow.shift[0, 5][flow.known[5]]
    assert side.abs().max() > 0.5  # what is at the side has gone back
    assert flow.known[:3].all()  # of the sky only the direction counts, and that did not turn
    assert flow.shift[:, :3].abs().max() < 1e-4
    hidden = true_panorama(valid=np.zeros((16, 64), bool))
    assert not panorama_flow(replace(frames[0], panorama=hidden), frames[1]).known.any()
    assert panorama_flow(replace(frames[0], panorama=None), frames[1]) is None
    for off, known in ((1e-9, True), (1.0, False)):
        near = true_panorama(view=replace(RASTER, origin=(off, 0.0, 0.0)))
        assert (panorama_flow(replace(frames[0], panorama=near), frames[1]) is not None) == known
    assert camera_flow(replace(frames[0], camera_ids=None), frames[1]) is None
    assert camera_flow(*frames).shift.shape == (2, 2, 6)


def test_sparse_depths_are_filled_for_the_flow():
    depth_m = np.zeros((16, 64), np.float32)
    depth_m[5, ::7] = 10
    sparse = true_panorama(ids=None, depth_m=depth_m)
    scan = street(points=4000)
    pair = [replace(truth(f"00/{n:06d}", pose=np.eye(4), panorama=sparse), scan=scan) for n in (0, 1)]
    flow = panorama_flow(*pair)
    assert flow is not None and flow.known.float().mean() > 0.5 and flow.shift.abs().max() < 1e-3
    ball = true_panorama(ids=None, depth_m=depth_m, view=replace(RASTER, kind="sphere", up=10, down=-10))
    assert panorama_flow(*(replace(one, panorama=ball) for one in pair)) is None  # gaps are filled on a cylinder


def test_depths_of_the_camera_are_the_panoramas_where_it_stands_there():
    from lidar2pano.evaluate.streams import camera_distances

    here = camera(8, 4)
    frame = truth(calibration=here, camera_ids=np.full((4, 8), ROAD, np.uint8), panorama=true_panorama())
    found = camera_distances(frame, here)
    assert set(found.unique().tolist()) <= {0.0, 10.0, float("inf")} and (found == 10).any()
    apart = replace(frame, panorama=true_panorama(view=replace(RASTER, origin=(0.0, 0.0, 1.0))))
    assert not (camera_distances(apart, here) == 10).any()  # only the scan's four points


# --- turned ----------------------------------------------------------------------------------------------------------


def test_a_turned_scan_makes_a_turned_range_image():
    view = VIEWS["panorama"].scaled(1 / 8)
    columns = round(ROLL * view.columns)
    scan, R = turned(street(), columns, view.columns)
    origin = tuple((R @ np.array(view.origin)).tolist())
    straight, other = project(street(), view), project(scan, replace(view, origin=origin))
    same = (straight.index.roll(columns, 1) == other.index).float().mean()
    assert same > 0.999  # some points lie on the border of two pixels
    assert np.allclose(R @ R.T, np.eye(3)) and R[2, 2] == 1


def test_roll_error_of_answers_that_turn_and_that_do_not():
    def turning(question):
        x, y, _ = question.scan.xyz[0].astype(float)
        start = int(round(-np.arctan2(y, x) / (2 * np.pi) * 64))
        return around(question, colour=np.roll(noise(5, 16, 64), start, 1), segments=np.roll(block, start, 1))

    block = true_panorama().ids
    measures = Measures.of("roll", device="cpu")
    evaluation = scored(
        [truth(panorama=true_panorama())], Told(panorama=turning), Told(panorama=around), measures=measures
    )
    assert figure(evaluation, "panorama", "roll_error") == 0 == figure(evaluation, "panorama", "roll_error_ids")
    assert figure(evaluation, "panorama", "roll_error", 1) > 50
    scored([truth(panorama=true_panorama())], plain := Told(panorama=around))
    assert len(plain.asked) == 1  # everything twice only when asked for


# --- parts -----------------------------------------------------------------------------------------------------------


def test_halves_make_the_whole():
    def frame(number):
        true = true_panorama(colour=noise(number, 16, 64))
        return pictured(f"0{number}/000000", number, panorama=true)

    frames = [replace(frame(n), camera_ids=np.full((24, 80), (ROAD, CAR)[n % 2], np.uint8)) for n in range(4)]

    def answer():
        ids = np.full((24, 80), ROAD)
        return Told(ids=ids, colour=lambda q: noise(int(q.scan.name[1]) + 9), panorama=around, labels=np.zeros(4, int))

    whole = scored(frames, answer(), worst=2)
    second, first = scored(frames[2:], answer(), worst=2), scored(frames[:2], answer(), worst=2)
    second.merge(first)
    assert second.as_dict() == whole.as_dict()
    assert second.table() == whole.table() and second.records() == whole.records()
    with pytest.raises(ValueError, match="counted twice"):
        second.merge(first)
    with pytest.raises(ValueError, match="are not one system"):
        second.merge(scored(frames[2:], Told("other")))


def test_real_weights_score_through_and_through(random_weights):
    (one,) = scored([truth(panorama=true_panorama())], system(random_weights, device="cpu")).as_dict()["results"]
    assert one["networks"]["translator"]["network"] == "titan-pano"
    assert {figure["sector"] for figure in one["figures"]} == {"camera", "panorama", "points"}
