"""`translate` with cameras: found, named, failing."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from miniature_surround import write_pandaset
from random_weights import write_scan


def test_cameras_beside_a_scan_keep_their_pixels(tmp_path, translate):
    scan_file = write_pandaset(tmp_path / "data") / "sequences/002/velodyne/000000.bin"
    out = tmp_path / "out"
    code, text, _ = translate(scan_file, "--out", out, "--save", "rgb,source", "--ply", "--json")
    record = json.loads(text)
    assert code == 0 and len(record["cameras"]) == 6 and "cameras" in record["milliseconds"]
    source = np.asarray(Image.open(out / "000000.source.png"))
    assert (source > 0).mean() > 0.9
    assert b"property uchar source" in (out / "000000.ply").read_bytes()[:600]
    real = np.asarray(Image.open(out / "000000.png"))
    code, text, _ = translate(scan_file, "--out", out, "--cameras", "none", "--json")
    assert code == 0 and json.loads(text)["cameras"] == []
    assert (np.asarray(Image.open(out / "000000.png")) != real).any(2)[source > 0].mean() > 0.9


def test_failing_cameras_are_one_line_each_and_the_rest_goes_on(tmp_path, translate):
    sequence = write_pandaset(tmp_path / "data") / "sequences/002"
    Image.new("RGB", (480, 300)).save(sequence / "left_camera/000000.jpg")
    (sequence / "back_camera/000000.jpg").write_bytes(b"?")
    code, text, errors = translate(sequence / "velodyne/000000.bin", "--out", tmp_path / "out", "--json")
    assert code == 0 and len(json.loads(text)["cameras"]) == 4
    left_out = [line for line in errors.splitlines() if "is left out" in line]
    assert len(left_out) == 2
    assert any("left_camera is left out: its image is black" in line for line in left_out)
    assert any("back_camera is left out" in line and "no readable image" in line for line in left_out)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--camera", "a.jpg:b.yaml"], "--camera 'a.jpg:b.yaml'"),
        (["--camera", "a.jpg"], "--camera a.jpg: has no calibration; name its calibration behind a colon, IMAGE:CALIB"),
        (["--cameras", ","], "--cameras ',': is auto, none or topics of a recording"),
        (["--mask", "m.png"], "--mask m.png: is missing"),
        (["--mask", "m.png", "--cameras", "none"], "there is no camera"),
    ],
)
def test_mistakes_are_one_line(tmp_path, translate, arguments, says):
    code, _, errors = translate(tmp_path, *arguments)
    assert code == 2 and says in errors and len(errors.splitlines()) == 1


def test_strict_makes_a_doubtful_camera_an_error(translate, tmp_path):
    scan = write_scan(tmp_path / "a.bin")
    Image.new("RGB", (64, 48)).save(tmp_path / "black.png")
    (tmp_path / "calib.json").write_text(
        json.dumps(
            {"K": [50, 0, 32, 0, 50, 24, 0, 0, 1], "T_camera_lidar": [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 0, 0, 0, 1]}
        )
    )
    camera = f"{tmp_path / 'black.png'}:{tmp_path / 'calib.json'}"
    code, _, err = translate(scan, "--out", tmp_path / "out", "--camera", camera)
    assert not code and "its image is black; clean or mend it (a warning; --strict makes it an error)" in err
    code, _, err = translate(scan, "--out", tmp_path / "strict", "--camera", camera, "--strict")
    assert code == 2 and "its image is black; clean or mend it (an error because of --strict)" in err
    assert err.count("its image is black") == 1 and not (tmp_path / "strict").exists()


def test_a_named_camera_that_cannot_be_read_is_a_mistake(translate, tmp_path):
    scan, images = write_scan(tmp_path / "a.bin"), tmp_path / "images"
    images.mkdir()
    (tmp_path / "calib.json").write_text('{"K": [50, 0, 32, 0, 50, 24, 0, 0, 1]}')

    def complaint(image):
        code, _, err = translate(scan, "--out", tmp_path / "out", "--camera", f"{image}:{tmp_path / 'calib.json'}")
        assert code == 2 and len(err.splitlines()) == 1 and not (tmp_path / "out").exists()
        return err

    assert f"{images}: holds no image" in complaint(images)
    Image.new("RGB", (64, 48), "red").save(images / "b.png")
    (images / "a.png").write_bytes(b"?")
    assert "calib.json: has no pose of the camera" in complaint(images)
    assert "calib.json: has no pose of the camera" in complaint(images / "b.png")
    assert "a.png: is no readable image" in complaint(images / "a.png")
    (tmp_path / "calib.json").write_text(
        json.dumps({"K": [50, 0, 32, 0, 50, 24, 0, 0, 1], "T_camera_lidar": np.eye(4).tolist()})
    )
    code, _, err = translate(scan, "--out", tmp_path / "out", "--camera", f"{images}:{tmp_path / 'calib.json'}")
    assert code == 0 and "is left out" in err and "a.png: is no readable image" in err, "of this scan alone"
