"""translate --at: panoramas of places in a map, and options that have no meaning there."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the extra 'formats' brings it")

from lidar2pano.formats.image_files import read_image
from lidar2pano.formats.ply import write_ply
from lidar2pano.formats.scan_files import write_bin
from map_street import street_points
from miniature import street


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A map in two files."""
    folder = tmp_path_factory.mktemp("map")
    xyz, _ = street_points(0.3)
    for name, part in (("east", xyz[xyz[:, 0] > 0]), ("west", xyz[xyz[:, 0] <= 0])):
        write_ply(folder / f"{name}.ply", dict(zip("xyz", part.T.astype(np.float32), strict=True)))
    return folder


def test_places_of_a_file_become_panoramas(translate, parts, tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,heading,name\n0,0,1.8,0,gate\n700,0,1.8,0,away\n5,0,1.8,90,\n")
    code, out, err = translate(
        parts,
        "--at",
        tmp_path / "a.csv",
        "--sensor",
        "vlp16",
        "--out",
        tmp_path / "o",
        "--json",
        "--save",
        "rgb,labels",
    )
    gate, numbered = map(json.loads, out.splitlines())
    assert code == 2 and "east.ply at 700,0,1.8: the place is outside of the map" in err
    assert {path.name for path in (tmp_path / "o").iterdir()} == {
        "gate.png", "gate.label", "east-000002.png", "east-000002.label"
    }  # fmt: skip
    assert gate["reading"]["viewpoint_m"] == [0, 0, 1.8] and gate["reading"]["ground_m"] == pytest.approx(1.8, abs=0.1)
    assert gate["points"] == (tmp_path / "o" / "gate.label").stat().st_size / 4 > 10_000
    pictures = [read_image(tmp_path / "o" / name) for name in ("gate.png", "east-000002.png")]
    assert pictures[0].shape == pictures[1].shape and (pictures[0] != pictures[1]).any()
    assert numbered["scan"] == 2


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--at", "1,2"], "--at '1,2': is not of the form X,Y,Z"),
        (["--at", "0,0,1", "--forward", "y"], "leave out --forward and --sensor-height"),
        (["--at", "0,0,1", "--sensor-height", "2"], "leave out --forward and --sensor-height"),
        (["--at", "0,0,1", "--every", "2"], "leave out --follow, --topic, --every, --from and --to"),
        (["--at", "0,0,1", "--follow"], "leave out --follow, --topic, --every, --from and --to"),
        (["--at", "0,0,1", "--cameras", "/front"], "leave out --camera and --cameras"),
        (["--at", "0,0,1", "--sensor", "hdl65e"], "no sensor 'hdl65e'"),
        (["--heading", "90"], "--heading 90: is the direction ahead at a place of a map; name it with --at"),
        (["--at", "0,0,1", "--heading", "nan"], "finite numbers"),
    ],
)
def test_options_without_a_meaning_are_refused(translate, parts, tmp_path, options, reason):
    code, out, err = translate(parts, *options, "--out", tmp_path / "o")
    assert code == 2 and not out and reason in err and err.count("\n") == 1 and not (tmp_path / "o").exists()


def test_a_single_sweep_is_refused(translate, tmp_path):
    write_bin(tmp_path / "a.bin", street(0, 20_000))
    code, out, err = translate(tmp_path / "a.bin", "--at", "0,0,0", "--out", tmp_path / "o")
    assert code == 2 and not out and "a.bin: is a single sweep" in err and err.count("\n") == 1
