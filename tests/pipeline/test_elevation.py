"""Panoramas that reach higher and lower than the released raster: rows, conditions, streams, files, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from installed_families import INSTALLED
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import image_size
from lidar2pano.labels import COMMON15
from lidar2pano.memory import Memory
from lidar2pano.models.latent_painter import SLOPE, conditions_of
from lidar2pano.models.world_noise import world_noise
from lidar2pano.pipeline import load
from lidar2pano.scan import Scan
from lidar2pano.scene.record import Scene
from lidar2pano.views import VIEWS, View
from random_weights import CAMERA, TRANSLATOR_VIEW, street, write_scan, write_weights

PITCH = 0.5236 / 48  # tangent, of a row of the small translator's


@pytest.fixture(scope="module")
def pipeline(random_weights):
    return load(random_weights, "cpu")


def canyon(beams: int, low_deg: float, high_deg: float, columns: int = 512) -> Scan:
    """A street 16 m wide between walls without end, as a sensor 1.73 m above it sees it."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(low_deg, high_deg, beams)), np.linspace(-np.pi, np.pi, columns, endpoint=False)
    )
    tangent = np.tan(elevation)
    wall = np.minimum(8 / np.maximum(np.abs(np.sin(azimuth)), 0.1), 60)
    flat = np.minimum(wall, 1.73 / np.maximum(-tangent, 1e-3))
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), flat * tangent], -1).reshape(-1, 3)
    remission = np.random.default_rng(0).random(len(xyz))
    return Scan(xyz=xyz.astype(np.float32), remission=remission.astype(np.float32), name="canyon")


# --- rows -----------------------------------------------------------------------------------------------------------


def test_rows_are_those_between_two_elevations(pipeline):
    half = replace(pipeline, view=VIEWS["panorama"].scaled(0.5))
    # 192 rows of 0.0027271 reach from 0.24 to -0.2836; 16 of them are 0.0436
    tall = half.reaching((-32, 24)).view  # tangents -0.6249 and 0.4452: 7.8 and 4.7 times 16 rows beyond
    assert (tall.rows, tall.columns, tall.origin) == (400, 2304, (0.27, 0.06, -0.07))
    assert (tall.up, tall.down) == (pytest.approx(0.24 + 5 * 0.0436333), pytest.approx(-0.2836 - 8 * 0.0436333))
    assert tall == half.reaching("-32,24").view == VIEWS["panorama-tall"].scaled(0.5)
    flat = half.reaching((-1, 1)).view  # 0.01746 to either side: 5 and 6 times 16 rows less
    assert (flat.rows, flat.up) == (16, pytest.approx(0.24 - 5 * 0.0436333, abs=1e-5))
    assert half.reaching((-15.8, 13.4)).view is half.view, "the released rows"
    assert half.reaching("auto").reaching((-15.8, 13.4)).fits is False


def test_the_translator_reads_rows_by_elevation_on_other_rasters_alone(pipeline):
    read = []

    class Noting(nn.Module):
        def forward(self, image, condition):
            read.append(image)
            return pipeline.translator(image, condition)

    noting = replace(pipeline, translator=Noting())
    usual, tall = noting(street()), noting.reaching((-30, 30))(street())
    assert [image.shape[1] for image in read] == [5, 6]
    assert usual.view.rows == 96 and tall.view.rows == 2 * (48 + 2 * 16 + 2 * 16)
    first, last = read[1][0, 5, 0, 0], read[1][0, 5, -1, 0]
    assert (first, last) == (pytest.approx(1 + 2 * 32 / 47), pytest.approx(-1 - 2 * 32 / 47))
    same = replace(pipeline, painter=pipeline.painter)(street())
    assert np.array_equal(same.colour, usual.colour) and np.array_equal(same.segments, usual.segments)


def scene_on(view: View, surfaces: Scene | None = None) -> Scene:
    """A scene of walls 10 m away below the tangent 0.2, and of sky."""
    tangent = view.up - (np.arange(view.rows) + 0.5) / view.rows * (view.up - view.down)
    sky = torch.from_numpy(tangent > 0.2)[:, None].expand(view.rows, view.columns)
    probabilities = torch.full((1, 16, view.rows, view.columns), 0.01)
    probabilities[:, COMMON15.id_of("sky")] += sky
    probabilities[:, COMMON15.id_of("building")] += ~sky
    depth_m = 10 * torch.from_numpy(np.sqrt(1 + tangent**2)).float()[None, :, None].expand(1, -1, view.columns)
    channels = torch.zeros(1, 5, view.rows, view.columns)
    return Scene(
        view=view, channels=channels, probabilities=probabilities, depth_m=depth_m, viewpoint_m=torch.tensor([1.7])
    )


def test_the_painter_knows_a_row_by_its_elevation(pipeline):
    view = TRANSLATOR_VIEW
    tall = pipeline.reaching((-30, 30)).view
    one, other = scene_on(view), scene_on(tall)
    elevation = conditions_of(other)[0, -1, :, 0]
    for row in (0, 7, 40, 111):
        assert elevation[row] * SLOPE == pytest.approx(0.24 + 32 * PITCH - (row + 0.5) * PITCH, abs=1e-6)
    inner = slice(32, 32 + 48)
    assert torch.allclose(conditions_of(one)[0, -1], conditions_of(other)[0, -1, inner], atol=1e-6)
    noise = world_noise(None, other, 4, 4)[1]
    assert torch.equal(world_noise(None, one, 4, 4)[1], noise[:, :, 8 : 8 + 12]), "of sky and walls alike"
    assert len(noise[0, 0, :8, 5].unique()) == 8


# --- auto -----------------------------------------------------------------------------------------------------------


def test_auto_is_what_the_sensor_sees_and_ten_degrees_more(pipeline):
    fitting = pipeline.reaching("auto")
    assert fitting.view == pipeline.view
    view = fitting(canyon(64, -20, 20)).view.scaled(0.5)  # 30 degrees: 0.577, 2 times 16 rows above and below
    assert (view.rows, view.up, view.down) == (
        112,
        pytest.approx(0.24 + 32 * PITCH),
        pytest.approx(-0.2836 - 32 * PITCH),
    )
    view = fitting(canyon(32, -24, -10)).view.scaled(0.5)
    assert (view.rows, view.up) == (96, 0.24), "the released rows at least"
    steep = fitting(canyon(64, -40, 58)).view  # at most -35 to 45 degrees: tangents -0.700 and 1
    assert 1 <= steep.up < 1 + 16 * PITCH and -0.7003 >= steep.down > -0.7003 - 16 * PITCH
    with pytest.raises(InputError, match="none of its 1 points"):
        fitting(Scan(xyz=np.full((1, 3), np.nan, np.float32), remission=np.zeros(1, np.float32), name="none"))


def test_a_stream_keeps_the_raster_of_its_first_scan(pipeline):
    scans, still = [canyon(64, -20, 20), canyon(64, -24, 2), canyon(64, -20, 40)], [np.eye(4)] * 3
    fitting = pipeline.reaching("auto")
    assert {one.view for one in fitting.stream(scans)} == {fitting(scans[0]).view}
    steady = list(fitting.stream(scans, still))
    assert {one.colour.shape for one in steady} == {(224, 1152, 3)} and "steady" in steady[-1].milliseconds
    memory, _ = fitting.step(Memory(), scans[0])
    moved = fitting.at(CAMERA).step(memory, scans[1])[1].view
    assert (moved.rows, moved.origin) == (224, pytest.approx(CAMERA.centre))


def test_a_video_painter_paints_taller_panoramas(random_weights, tmp_path):
    for role in ("segmenter", "translator"):
        (tmp_path / f"{role}.safetensors").symlink_to(random_weights / f"{role}.safetensors")
    settings = {"channels": 16, "widths": [8], "downsamplings": 2, "blocks": [1, 1], "foreground": [1]}
    write_weights(tmp_path, "vid2vid", "vid2vid", settings, views={"panorama": TRANSLATOR_VIEW.as_dict()})
    tall = load(tmp_path, "cpu").reaching((-30, 30))
    assert [one.colour.shape for one in tall.stream([street(), street()])] == [(224, 1152, 3)] * 2


# --- commands -------------------------------------------------------------------------------------------------------


def test_files_are_as_tall(random_weights, tmp_path, capsys):
    scan = write_scan(tmp_path / "scan.bin", canyon(64, -20, 20))
    words = ["translate", str(scan), "--weights", str(random_weights), "--device", "cpu", "--elevation", "-30,30"]
    words += ["--save", "all,confidence,measured,range"]
    assert main([*words, "--out", str(tmp_path / "a"), "--view", "--ply", "--annotations", "coco"]) == 0
    for name in ("", ".segments", ".depth", ".confidence", ".measured", ".range"):
        assert image_size(tmp_path / f"a/scan{name}.png") == (1152, 224)
    assert (tmp_path / "a/view.html").stat().st_size > 10_000
    assert main([*words, "--out", str(tmp_path / "b"), "--projection", "equirectangular"]) == 0
    text = (tmp_path / "b/scan.png").read_bytes()
    # 0.589 and -0.6327 are 30.5 and -32.3 degrees, of 1152 columns in 360 degrees
    top = int(text.partition(b'CroppedAreaTopPixels="')[2].partition(b'"')[0])
    assert top == pytest.approx((90 - 30.5) * 1152 / 360, abs=2)
    assert image_size(tmp_path / "b/scan.png")[1] == pytest.approx((30.5 + 32.3) * 1152 / 360, abs=3)
    capsys.readouterr()


@pytest.mark.parametrize(
    "elevation", ["5,-5", "5,5", "-61,10", "-10,61", "10", "1,2,3", "high", "nan,3", "-5;5", ",", (1, "a"), 7, None]
)
def test_other_elevations_are_refused(pipeline, elevation):
    with pytest.raises(InputError, match="is neither auto nor LOW,HIGH in degrees; name two numbers, -60 <= LOW < HIG"):
        pipeline.reaching(elevation)


def test_the_papers_networks_have_the_rows_of_one_camera(front_weights, random_weights, tmp_path, capsys):
    folder = tmp_path / "front"
    folder.mkdir()
    for file in (*front_weights.glob("*.safetensors"), random_weights / "painter.safetensors"):
        (folder / file.name).symlink_to(file)
    words = ["translate", str(write_scan(tmp_path / "scan.bin")), "--weights", str(folder), "--out", str(tmp_path)]
    assert main([*words, "--elevation", "auto", "--device", "cpu"]) == 2
    assert "elevation 'auto': these weights paint the rows of one camera" in capsys.readouterr().err


@pytest.mark.parametrize("family", INSTALLED)
def test_a_released_family_looks_up(family):
    pipeline = load(family, "cpu", "torch")
    scan = canyon(128, -22.5, 22.5, 1024)
    tall = pipeline.reaching("auto")
    panorama = tall(scan)
    assert panorama.view.rows == 2 * (192 + 160 + 144)  # 32.3 degrees: 0.632, 10 times 16 rows above, 9 below
    assert panorama.colour.shape == (panorama.view.rows, 4608, 3) and panorama.colour.std() > 10
    above = panorama.segments[: round((panorama.view.up - math.tan(math.radians(15))) * 733.4)]
    assert (above > 0).mean() > 0.9
    steep = scan.xyz[:, 2] > np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) * math.tan(math.radians(15))
    if pipeline.segmenter.tallest is not None:
        assert (panorama.labels[steep] > 0).mean() > 0.5, "the segmenter learned from scans that look up"
