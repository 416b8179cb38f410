"""Cameras hidden in turn, and the scores of their views."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.cli import main
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate.hidden_cameras import EACH, SYSTEMS, frame_cameras, hidden_views, score_hidden, table
from lidar2pano.evaluate.metric_collection import MetricConfig, PatchFeatures
from lidar2pano.evaluate.pictures import CAPTION_ROWS
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.projection import directions
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import load
from lidar2pano.pipeline.composition import compose, photographed
from lidar2pano.views import VIEWS
from miniature_surround import distances, six, write_pandaset

QUARTER = VIEWS["panorama"].scaled(0.25)


class Grey:
    """A pipeline with the true depths of the painted place, and one colour: grey, or the mean of what cameras show."""

    device = torch.device("cpu")

    def __init__(self, view=QUARTER) -> None:
        self.view = view

    def at(self, calibration) -> Grey:
        return Grey(at_camera(self.view, calibration))

    def translate(self, scan, timer) -> Panorama:
        shape = (self.view.rows, self.view.columns)
        depth_m = distances(np.array(self.view.origin), directions(self.view).double().numpy())
        return Panorama(
            name=scan.name,
            frame=0,
            view=self.view,
            colour=np.full((*shape, 3), 128, dtype=np.uint8),
            segments=np.full(shape, 7, dtype=np.uint8),
            depth_m=depth_m.astype(np.float32),
            labels=np.zeros(len(scan), dtype=np.int64),
        )

    def paint(self, memory, scene, timer, cameras=()) -> tuple[object, Panorama]:
        if not cameras:
            return memory, scene
        real = photographed(scene, cameras)
        level = float(real.colour[:, real.source > 0].mean())
        return memory, compose(replace(scene, colour=np.full_like(scene.colour, round(level))), real)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return write_pandaset(tmp_path_factory.mktemp("pandaset"))


def test_each_camera_is_hidden_in_turn_and_never_helps_itself(place):
    (frame,) = frames(place, "all")
    views = list(hidden_views(Grey(), frame, EACH))
    assert [view.name for view in views] == [f"002/000000/{name}" for name in six()]
    for view in views:
        alone, helped = (view.predicted[system].astype(int) for system in SYSTEMS)
        assert 0 < view.real_share < 0.9, "some is seen by a neighbour, the middle by none"
        shown = view.valid & view.invented
        assert (alone[view.valid] == 128).all()
        middle = shown[130:160, 220:260]
        assert middle.mean() > 0.9
        seen = view.valid & ~view.invented
        off = [np.abs(image - view.real)[seen].mean() for image in (helped, alone)]
        assert off[0] < 0.35 * off[1]


def test_a_scan_is_translated_once_and_painted_as_by_calls(place, random_weights):
    (frame,) = frames(place, "all")
    pipeline = load(random_weights, "cpu", "torch")
    translator, calls = pipeline.translator, []
    hook = translator.register_forward_hook(lambda *_: calls.append(1))
    (view,) = hidden_views(pipeline, frame, "back_camera")
    hook.remove()
    assert len(calls) == 1
    cameras = frame_cameras(frame)
    (hidden,) = (camera for camera in cameras if camera.name == "back_camera")
    others = [camera for camera in cameras if camera is not hidden]
    for predicted, own in zip(view.predicted.values(), ((), others), strict=True):
        expected = pipeline.at(hidden.calibration)(frame.scan, own).to_camera(hidden.calibration).colour
        assert np.array_equal(predicted, expected)


def test_cameras_that_meter_tell_the_exposure_of_a_hidden_one(place):
    (frame,) = frames(place, "all")
    level = 60
    for name, camera in frame.cameras.items():
        image = (camera.image * (level / camera.image.mean())).round().clip(0, 255).astype(np.uint8)
        vars(frame)["cameras"] = {**frame.cameras, name: replace(camera, image=image)}
    off = []
    for view in hidden_views(Grey(), frame, EACH):
        alone, helped = (view.predicted[system][view.valid].mean() for system in SYSTEMS)
        assert alone == 128, "nothing tells the exposure of a scan"
        off.append(abs(helped - view.real[view.valid].mean()))
    assert np.mean(off) < 2.5, "3.5 without it"


def test_scores_say_what_the_other_cameras_bring(place, tmp_path):
    coarse = PatchFeatures(lambda images: images[:, :, 2::4, 2::4].float(), 4, 1)
    scores = score_hidden(
        Grey(), frames(place, "all"), EACH, {"coarse": coarse, "halved": coarse._replace(shrink=2)},
        sheets=tmp_path / "views",
    )  # fmt: skip
    summary = scores.as_dict()
    assert json.loads(json.dumps(summary)) == summary
    alone, helped = (summary["systems"][system] for system in SYSTEMS)
    assert (
        helped["class colour error"]["class colour error"]["value"]
        < alone["class colour error"]["class colour error"]["value"]
    )
    ssim = [part["SSIM"][next(iter(part["SSIM"]))]["value"] for part in (alone, helped)]
    assert ssim[1] > ssim[0]
    apart = [part["feature distance, coarse"]["distance"]["value"] for part in (alone, helped)]
    assert 0 < apart[1] < apart[0] and "feature distance, halved" not in alone
    assert "| class colour error | " in table(summary) and "6 hidden views" in table(summary)
    paths = sorted((tmp_path / "views").iterdir())
    with Image.open(paths[0]) as sheet:
        assert len(paths) == 6 and sheet.size == (3 * 480, 300 + CAPTION_ROWS)


def test_one_camera_is_hidden_by_its_name(place):
    (frame,) = frames(place, "all")
    (view,) = hidden_views(Grey(), frame, "left_camera")
    assert view.name.endswith("left_camera")
    with pytest.raises(InputError, match=r"--leave-out: no camera 'left'.*left_camera"):
        next(hidden_views(Grey(), frame, "left"))


def test_a_frame_with_one_camera_is_refused(place):
    (frame,) = frames(place, "all")
    lonely = Frame("a", scan=frame.scan, image=np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="needs two cameras of a scan, it has 0"):
        next(hidden_views(Grey(), lonely, EACH))


def test_the_own_vehicle_is_not_scored(place):
    (frame,) = frames(place, "all")
    boot = np.zeros((300, 480), dtype=bool)
    boot[240:] = True
    vars(frame)["cameras"] = {name: replace(one, ego_mask=boot) for name, one in frame.cameras.items()}
    (view,) = hidden_views(Grey(), frame, "back_camera")
    assert view.valid[~boot].any() and not view.valid[boot].any() and not view.classes[boot].any()
    assert replace(view, invented=np.zeros_like(view.valid)).real_share == 1


def test_the_command_writes_scores_and_views(place, random_weights, tmp_path, capsys):
    command = ["evaluate", str(random_weights), "--data", str(place), "--split", "all", "--device", "cpu"]
    command += ["--leave-out", "front_camera", "--out", str(tmp_path / "views"), "--json", str(tmp_path / "a.json")]
    assert main([*command, "--csv", str(tmp_path / "a.csv")]) == 0
    table, said = capsys.readouterr()
    assert "| class colour error | " in table and "[" not in table, "one view has no interval"
    assert said == "lidar2pano: these weights are licensed CC-BY-NC-SA-4.0: not for commercial use\n"
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        values = {(row["system"], row["metric"]): float(row["value"]) for row in csv.DictReader(file)}
    summary = json.loads((tmp_path / "a.json").read_text())["systems"]
    for system in SYSTEMS:
        assert values[system, "SSIM"] == summary[system]["SSIM"]["SSIM"]["value"]
        assert len([key for key in values if key[0] == system]) == sum(map(len, summary[system].values()))
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["002-000000-front_camera.png"]
    assert set(json.loads((tmp_path / "a.json").read_text())["systems"]) == set(SYSTEMS)
    assert main([*command, "--leave-out", "none"]) == 2
    assert "no camera 'none'" in capsys.readouterr().err


def test_no_view_is_written_without_a_folder(place, random_weights, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["evaluate", str(random_weights), "--data", str(place), "--split", "all", "--device", "cpu"]
    assert main([*command, "--leave-out", "front_camera"]) == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "value"),
    [("--worst", "1"), ("--pairs", "a"), ("--metrics", "points"), ("--sensor", "pandar64")],
)
def test_an_option_without_a_use_beside_leave_out_is_refused(place, random_weights, option, value, tmp_path, capsys):
    value = str(tmp_path / value) if option == "--pairs" else value
    command = ["evaluate", str(random_weights), "--data", str(place), "--split", "all", "--device", "cpu"]
    command += ["--leave-out", "front_camera", "--out", str(tmp_path / "views"), option, value]
    assert main(command) == 2
    assert f"--leave-out has no use for {option}; leave that out" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--sdnet", "--inception"])
def test_networks_without_a_use_beside_leave_out_are_refused(option, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lidar2pano.evaluate.MetricConfig.parse", lambda *_, **__: MetricConfig())
    command = ["evaluate", "any", "--data", str(tmp_path), "--leave-out", EACH, "--out", str(tmp_path / "views")]
    assert main([*command, option, str(tmp_path / "file")]) == 2
    assert f"--leave-out has no use for {option}; leave that out" in capsys.readouterr().err
