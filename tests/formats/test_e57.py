"""E57: the first scan in the scanner's own frame; spherical coordinates, points without a place."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from e57_pages import content, paged
from lidar2pano.errors import InputError
from lidar2pano.formats.e57 import _columns, decode
from lidar2pano.formats.readers import interpreted

XYZ, _ = made.street(beams=32, columns=180)
FORMS = made.remission(len(XYZ))


def write(path: Path, scans: int = 1) -> Path:
    pye57 = pytest.importorskip("pye57", reason="the extra 'formats', where pye57 installs")
    file = pye57.E57(str(path), mode="w")
    axes = {f"cartesian{axis}": XYZ[:, column].astype(np.float64) for column, axis in enumerate("XYZ")}
    for _ in range(scans):
        file.write_scan_raw(axes | {"intensity": FORMS.astype(np.float64)})
    file.close()
    return path


def test_points_of_an_e57(tmp_path):
    scan, found = interpreted(write(tmp_path / "a.e57"))
    np.testing.assert_allclose(scan.xyz, XYZ, atol=1e-6)
    np.testing.assert_allclose(scan.remission, FORMS, atol=1e-6)
    assert found.format == "E57" and not found.doubts


def test_the_first_of_several_scans_is_read_and_said(tmp_path):
    scan, found = interpreted(write(tmp_path / "a.dat", scans=2))
    assert len(scan) == len(XYZ) and found.doubts == ("it holds 2 scans, of which the first is read",)


@pytest.mark.parametrize("share", [0.1, 0.6, 0.98])
def test_one_that_cannot_be_read_is_one_line(tmp_path, share):
    data = write(tmp_path / "a.e57").read_bytes()
    with pytest.raises(InputError, match=r"a\.e57: is an E57 (that pye57 does not read|whose XML)") as caught:
        decode(data[: int(share * len(data))], Path("a.e57"))
    assert "\n" not in str(caught.value)


def with_xml(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """An E57 whose XML, its last section, is another; with right lengths and checksums."""
    logical = bytearray(content(data))
    offset, length = struct.unpack_from("<QQ", data, 24)
    start = offset // 1024 * 1020 + offset % 1024
    xml = change(bytes(logical[start : start + length]))
    logical[start:] = xml
    struct.pack_into("<Q", logical, 32, len(xml))
    return paged(bytes(logical))


SCHEMA = b' xmlns:i="http://www.w3.org/2001/XMLSchema-instance" i:schemaLocation="http://www.astm.org/COMMIT/E57'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"?>", b'?><!DOCTYPE e57Root SYSTEM "http://127.0.0.1:9/a.dtd">'),
        (b"?>", b'?><!DOCTYPE e57Root [<!ENTITY x SYSTEM "file:///etc/hostname">]>'),
        (b"<e57Root", b"<e57Root" + SCHEMA + b'/2010-e57-v1.0 http://127.0.0.1:9/a.xsd"'),
        (b"UTF-8", b"UTF-16"),
    ],
)
def test_its_xml_makes_no_library_fetch_anything(tmp_path, monkeypatch, old, new):
    data = write(tmp_path / "a.e57").read_bytes()
    assert len(decode(with_xml(data, lambda xml: xml), Path("a.e57"))) == len(XYZ)
    monkeypatch.setattr("pye57.E57", None)  # what is refused does not come so far
    with pytest.raises(InputError, match="refers to other documents"):
        decode(with_xml(data, lambda xml: xml.replace(old, new, 1)), Path("a.e57"))


def test_spherical_coordinates_and_points_without_a_place():
    range_m = np.linalg.norm(XYZ, axis=1)
    raw = {
        "sphericalRange": range_m,
        "sphericalAzimuth": np.arctan2(XYZ[:, 1], XYZ[:, 0]),
        "sphericalElevation": np.arcsin(XYZ[:, 2] / range_m),
        "sphericalInvalidState": np.arange(len(XYZ)) == 5,
        "intensity": FORMS,
    }
    columns = _columns(raw)
    found = np.column_stack([columns[f"cartesian{axis}"] for axis in "XYZ"])
    assert np.isnan(found[5]).all() and "sphericalInvalidState" not in columns
    np.testing.assert_allclose(np.delete(found, 5, 0), np.delete(XYZ, 5, 0), atol=1e-4)
