"""Panoramas saved in projections of other programs, with what tells viewers so; and images of a scan's echoes."""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from lidar2pano.calibration import LensCalibration
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import gpano
from lidar2pano.geometry.camera import equirectangular
from lidar2pano.views import View
from random_weights import street
from slow_definitions import look_up_slowly
from small_panoramas import VIEW, small_panorama

FACES = ("front", "right", "back", "left", "up", "down")


def pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def fields(xmp: bytes) -> dict[str, str]:
    return dict(re.findall(r'GPano:(\w+)="(\w+)"', xmp.decode()))


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Chunks by the specification: length, type, data, checksum."""
    chunks, place = [], 8
    while place < len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        content = data[place + 8 : place + 8 + length]
        assert struct.unpack_from(">I", data, place + 8 + length)[0] == zlib.crc32(kind + content)
        chunks.append((kind, content))
        place += 12 + length
    return chunks


@pytest.mark.parametrize("image_format", ["png", "jpeg", "webp"])
def test_an_equirectangular_image_says_which_part_of_the_sphere_it_is(tmp_path, image_format):
    panorama = small_panorama()
    (path,) = panorama.save(tmp_path, image_format=image_format, projection="equirectangular")
    with Image.open(path) as image:
        xmp, (width, height) = image.info["xmp"], image.size
    target = equirectangular(VIEW)
    assert fields(xmp) == {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": "1152",
        "FullPanoHeightPixels": "576",
        "CroppedAreaImageWidthPixels": str(width),
        "CroppedAreaImageHeightPixels": str(height),
        "CroppedAreaLeftPixels": "0",
        "CroppedAreaTopPixels": str(round((90 - target.up) * 1152 / 360)),
    }
    assert xmp.startswith('<?xpacket begin="\ufeff"'.encode()) and (width, height) == (1152, target.rows)


def test_xmp_lies_where_the_standard_puts_it(tmp_path):
    panorama = small_panorama()
    (png,) = panorama.save(tmp_path, projection="equirectangular")
    chunks = png_chunks(png.read_bytes())
    (content,) = [content for kind, content in chunks if kind == b"iTXt"]
    assert content == b"XML:com.adobe.xmp\0\0\0\0\0" + gpano(equirectangular(VIEW))
    assert [kind for kind, _ in chunks][0] == b"IHDR" and chunks[-1][0] == b"IEND"
    (jpeg,) = panorama.save(tmp_path, image_format="jpeg", projection="equirectangular")
    data, place, segments = jpeg.read_bytes(), 2, []
    while data[place + 1] != 0xDA:  # start of scan
        (length,) = struct.unpack_from(">H", data, place + 2)
        segments.append((data[place + 1], data[place + 4 : place + 2 + length]))
        place += 2 + length
    assert (0xE1, b"http://ns.adobe.com/xap/1.0/\0" + gpano(equirectangular(VIEW))) in segments


def test_a_part_of_a_turn_is_a_cropped_area():
    view = equirectangular(View(rows=10, columns=90, up=10.0, down=-10.0, left=45.0, right=-45.0))
    assert (fields(gpano(view))["CroppedAreaLeftPixels"], fields(gpano(view))["FullPanoWidthPixels"]) == ("135", "360")
    assert fields(gpano(view))["CroppedAreaTopPixels"] == "80"
    with pytest.raises(ValueError, match="equal steps of elevation"):
        gpano(VIEW)


def test_every_image_is_in_the_projection_and_labels_are_those_of_points(tmp_path):
    panorama = small_panorama()
    panorama = replace(panorama, source=(panorama.segments % 3).astype(np.uint8))
    what = ("rgb", "segments", "labels", "depth", "confidence", "source")
    plain = panorama.save(tmp_path / "cylinder", what)
    files = panorama.save(tmp_path / "sphere", what, projection="equirectangular")
    assert [file.name for file in files] == [file.name for file in plain]
    target = equirectangular(VIEW)
    row, column = target.rows // 2, 400
    elevation = np.radians(target.up - (row + 0.5) * (target.up - target.down) / target.rows)
    their_row = int((VIEW.up - np.tan(elevation)) / (VIEW.up - VIEW.down) * VIEW.rows)
    for file, its_cylinder in zip(files, plain, strict=True):
        if file.suffix == ".label":
            assert file.read_bytes() == its_cylinder.read_bytes()
        elif file.stem != "a":
            assert pixels(file).shape == (target.rows, 1152)
            assert pixels(file)[row, column] == pixels(its_cylinder)[their_row, column]
    with Image.open(files[0]) as image:
        image.load()
        assert View(**json.loads(image.text["lidar2pano-view"])) == target


def test_a_cube_has_six_files_for_each_image(tmp_path):
    files = small_panorama().save(tmp_path, ("rgb", "segments", "labels"), projection="cubemap", image_format="jpeg")
    names = [f"a.{face}.jpg" for face in FACES] + [f"a.{face}.segments.png" for face in FACES] + ["a.label"]
    assert [file.name for file in files] == names
    assert {pixels(file).shape[:2] for file in files[:-1]} == {(2 * round(VIEW.focal_px),) * 2}


def some_pixels(rows: int, columns: int, count: int = 20) -> list[tuple[int, int]]:
    generator = np.random.default_rng(3)
    return list(zip(generator.integers(0, rows, count), generator.integers(0, columns, count), strict=True))


def test_colours_of_a_sphere_are_those_of_the_slow_definition(tmp_path):
    panorama, target = small_panorama(), equirectangular(VIEW)
    (path,) = panorama.save(tmp_path, projection="equirectangular")
    for row, column in some_pixels(target.rows, 1152):
        azimuth, elevation = math.pi - (column + 0.5) * math.tau / 1152, (target.up - (row + 0.5) * 360 / 1152)
        ray = (math.cos(azimuth), math.sin(azimuth), math.tan(math.radians(elevation)))
        wanted = look_up_slowly(panorama.colour, VIEW, ray)
        assert pixels(path)[row, column] == pytest.approx(wanted, abs=1)


def test_colours_of_a_cube_are_those_of_the_slow_definition(tmp_path):
    panorama = small_panorama()
    left = pixels(panorama.save(tmp_path, projection="cubemap")[FACES.index("left")])
    size, top = len(left), len(left) * 2 // 5  # a fifth of the rows is within the panorama
    for row_below, column in some_pixels(size // 5, size):
        row = top + row_below
        ray = ((column + 0.5) * 2 / size - 1, 1.0, 1 - (row + 0.5) * 2 / size)  # to its right lies ahead
        assert left[row, column] == pytest.approx(look_up_slowly(panorama.colour, VIEW, ray), abs=1)


def test_colours_in_a_lens_are_those_of_the_slow_definition():
    """A fisheye with 100 pixels per radian that looks ahead: x right is -y, y down is -z, z ahead is x."""
    panorama, axes = small_panorama(), np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    K = np.array([[100.0, 0, 90], [0, 100, 15], [0, 0, 1]])
    lens = LensCalibration(K=K, T_camera_lidar=axes, size=(181, 31), model="fisheye", distortion=(0.0,) * 4)
    view = panorama.to_camera(lens)
    for row, column in some_pixels(31, 181):
        right, down = (column - 90) / 100, (row - 15) / 100
        angle = math.hypot(right, down)
        aside = math.sin(angle) / angle
        wanted = look_up_slowly(panorama.colour, VIEW, (math.cos(angle), -right * aside, -down * aside))
        assert view.valid[row, column] and view.colour[row, column] == pytest.approx(wanted, abs=1)


def test_an_unknown_projection_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"no projection 'mercator'; there is cylinder, equirectangular, cubemap"):
        small_panorama().save(tmp_path, projection="mercator")


def test_echoes_are_saved_as_images_of_the_scan(tmp_path):
    scan = street(3000)
    scan = replace(scan, near_infrared=np.linspace(1, 4000, len(scan), dtype=np.float32))
    panorama = small_panorama(scan=scan)
    files = panorama.save(tmp_path, ("remission", "range", "near-infrared"), scan=scan)
    assert [file.name for file in files] == ["a.remission.png", "a.range.png", "a.near-infrared.png"]
    remission, range_m, light = map(pixels, files)
    assert remission.dtype == light.dtype == np.uint8 and light.max() == 255 and 0 < light[light > 0].mean() < 200
    assert ((range_m > 0) == (light > 0)).mean() > 0.99 and range_m.max() / 256 <= np.linalg.norm(
        scan.xyz, axis=1
    ).max() + 1
    sphere = panorama.save(tmp_path, "range", scan=scan, projection="equirectangular")
    assert pixels(sphere[0]).shape == (equirectangular(VIEW).rows, 1152)


def test_a_scan_without_near_infrared_light_is_told_in_one_line(tmp_path):
    scan = street()
    with pytest.raises(InputError, match="a: has no near-infrared light .* leave it out of --save"):
        small_panorama().save(tmp_path, "near-infrared", scan=scan)
    with pytest.raises(ValueError, match="of the panorama's own scan"):
        small_panorama().save(tmp_path, "range")
    with pytest.raises(ValueError, match="of the panorama's own scan"):
        small_panorama().save(tmp_path, "range", scan=street(5))
