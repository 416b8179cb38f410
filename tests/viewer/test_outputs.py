"""Files about all scans of a run: page, video, Rerun's recording; and the camera's layer."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.calibration import read_calib
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_png
from lidar2pano.geometry.camera import at_camera, camera_in_panorama
from lidar2pano.viewer.outputs import PageOutput, RerunOutput, VideoOutput, camera_layer
from lidar2pano.views import VIEWS
from random_weights import CALIB, street, write_scan
from small_panoramas import small_panorama


def run(output, frames: int) -> Path | None:
    with closing(output):
        for seed in range(frames):
            output.add(small_panorama(seed), street(), Path(f"{seed}.bin"), f"scan {seed}")
        return output.finish()


@pytest.mark.parametrize("make", [lambda path: PageOutput(path, "t", "w"), VideoOutput, RerunOutput])
def test_without_a_panorama_there_is_no_file(tmp_path, make):
    for module in ("av", "rerun"):
        pytest.importorskip(module, reason="an extra")
    assert run(make(tmp_path / "new" / "file"), 0) is None
    assert not list(tmp_path.iterdir())


def test_a_page(tmp_path):
    path = run(PageOutput(tmp_path / "new" / "a.html", "t", "w"), 2)
    assert path == tmp_path / "new" / "a.html" and path.read_text(encoding="utf-8").count('"name":"scan 1"') == 1


def test_a_video_has_all_frames_in_order(tmp_path):
    av = pytest.importorskip("av", reason="an extra")
    with closing(VideoOutput(tmp_path / "a.mp4")) as output:
        for level in (20, 120, 220):
            around = small_panorama()
            around.colour[:] = level
            output.add(around, street(), Path("a.bin"), "a")
        path = output.finish()
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 10
    assert [frame.shape for frame in frames] == [(96, 1152, 3)] * 3
    assert [round(float(frame.mean())) for frame in frames] == pytest.approx([20, 120, 220], abs=4)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_a_recording_for_rerun(tmp_path):
    pytest.importorskip("rerun", reason="an extra")
    path = run(RerunOutput(tmp_path / "a.rrd"), 2)
    assert path is not None and path.read_bytes()[:3] == b"RRF"
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]


@pytest.mark.parametrize(
    ("output", "module", "option", "extra"),
    [(VideoOutput, "av", "--video", "recordings"), (RerunOutput, "rerun", "--rerun", "recordings")],
)
def test_a_missing_extra_is_one_line(tmp_path, monkeypatch, output, module, option, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"{option} needs the extra '{extra}': pip install 'lidar2pano\[{extra}\]'"):
        output(tmp_path / "a")


# --- the camera's image ----------------------------------------------------------------------------------------------


def sequence(root: Path, *, image: bool = True) -> Path:
    """A sequence's folder with one scan and, if wanted, an image that is red above and blue below."""
    folder = root / "sequences" / "07"
    write_scan(folder / "velodyne" / "000000.bin")
    (folder / "calib.txt").write_text(CALIB)
    if image:
        colour = np.zeros((376, 1241, 3), dtype=np.uint8)
        colour[:188, :, 0] = colour[188:, :, 2] = 200
        (folder / "image_2").mkdir()
        write_png(folder / "image_2" / "000000.png", colour)
    return folder


def test_the_camera_image_lies_where_the_camera_looks(tmp_path):
    folder = sequence(tmp_path)
    calibration = read_calib(folder / "calib.txt", (1241, 376))
    view = at_camera(VIEWS["panorama"].scaled(0.25), calibration)
    layer = camera_layer(folder / "velodyne" / "000000.bin", view)
    assert layer is not None and layer.shape == (96, 1152, 4) and layer.dtype == np.uint8
    np.testing.assert_array_equal(layer[..., 3] == 255, camera_in_panorama(view, calibration).valid.numpy())
    assert layer[20, 576].tolist() == [200, 0, 0, 255] and layer[80, 576].tolist() == [0, 0, 200, 255]
    assert layer[50, 0].tolist() == [0, 0, 0, 0]


def test_a_worlds_image_is_all_around(tmp_path):
    folder = sequence(tmp_path)
    (folder / "pano").mkdir()
    write_png(folder / "pano" / "000000.png", np.full((96, 1152, 3), 77, dtype=np.uint8))
    layer = camera_layer(folder / "velodyne" / "000000.bin", VIEWS["panorama"])
    assert layer is not None and (layer == (77, 77, 77, 255)).all()


def test_a_packed_scan_has_its_camera_image_too(tmp_path):
    scan = sequence(tmp_path) / "velodyne" / "000000.bin"
    packed = scan.rename(scan.with_name("000000.bin.gz"))
    assert camera_layer(packed, VIEWS["panorama"]) is not None


def test_other_scans_have_no_camera(tmp_path):
    scan = sequence(tmp_path, image=False) / "velodyne" / "000000.bin"
    assert camera_layer(scan, VIEWS["panorama"]) is None
    assert camera_layer(tmp_path / "a.bin", VIEWS["panorama"]) is None
    other = sequence(tmp_path / "other")
    (other / "calib.txt").unlink()
    assert camera_layer(other / "velodyne" / "000000.bin", VIEWS["panorama"]) is None


def test_a_damaged_camera_image_is_named(tmp_path):
    folder = sequence(tmp_path)
    (folder / "image_2" / "000000.png").write_bytes(b"12")
    with pytest.raises(InputError, match=r"000000\.png"):
        camera_layer(folder / "velodyne" / "000000.bin", VIEWS["panorama"])
