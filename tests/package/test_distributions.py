"""The two distributions, read from their wheels: one is Apache-2.0 whole, the other holds weights alone."""

from __future__ import annotations

import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

import house_rules
from installed_families import needs_streets
from lidar2pano.models.card import read_card
from lidar2pano.models.families import families

STREETS = house_rules.ROOT / "packages" / "lidar2pano-streets"
pytestmark = needs_streets


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> dict[str, zipfile.ZipFile]:
    """The wheels, by the names of their distributions."""
    folder = tmp_path_factory.mktemp("wheels")
    for project in (house_rules.ROOT, STREETS):
        assert list(WheelBuilder(str(project)).build(directory=str(folder), versions=["standard"]))
    return {path.name.partition("-")[0]: zipfile.ZipFile(path) for path in sorted(folder.glob("*.whl"))}


def metadata(wheel: zipfile.ZipFile) -> Message:
    (name,) = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    return Parser().parsestr(wheel.read(name).decode())


def licences(wheel: zipfile.ZipFile) -> list[str]:
    """The texts of all licence files, of code and of weights."""
    return [wheel.read(name).decode() for name in wheel.namelist() if Path(name).name.startswith("LICENSE")]


def cards(wheel: zipfile.ZipFile) -> list[bytes]:
    """The beginnings of all weight files, which hold their cards."""
    return [wheel.read(name)[:20_000] for name in wheel.namelist() if name.endswith(".safetensors")]


def test_the_plain_distribution_is_apache_whole(wheels):
    wheel = wheels["lidar2pano"]
    assert metadata(wheel)["License-Expression"] == "Apache-2.0"
    assert len(licences(wheel)) >= 2 and not any("CC-BY-NC" in text for text in licences(wheel))
    assert len(cards(wheel)) == 3
    assert all(b"Apache-2.0" in card and b"-NC-" not in card for card in cards(wheel))
    assert {name.partition("/")[0] for name in wheel.namelist()} == {"lidar2pano", "lidar2pano-0.1.0.dist-info"}


def test_the_streets_are_weights_alone(wheels):
    wheel = wheels["lidar2pano_streets"]
    assert metadata(wheel)["License-Expression"] == "CC-BY-NC-SA-4.0"
    assert all("CC-BY-NC-SA-4.0" in text for text in licences(wheel))
    assert all(b"CC-BY-NC-SA-4.0" in card for card in cards(wheel))
    content = {Path(name).name for name in wheel.namelist() if name.startswith("lidar2pano_streets/")}
    assert content == {
        "__init__.py",
        "LICENSE",
        "README.md",
        "scores.json",
        *(f"{role}.safetensors" for role in ("segmenter", "translator", "painter")),
    }


CREDITS = {  # data that a card names -> whom its licence credits; a name says nothing about data of our own making
    "kitti-mini": "KITTI Vision Benchmark Suite",
    "kitti-more": "Vision meets Robotics",
    "cityscapes": "M. Cordts",
    "camvid": "G. J. Brostow",
    "dgp": "TRI-ML/dgp",
    "pandaset-mini": "P. Xiao",
}
SIMULATED = {
    "autumn",
    "centre",
    "centre-scans",
    "day",
    "evening",
    "hdl32e-scans",
    "hdl64e-scans",
    "lanes",
    "os1-128-day",
    "os1-128-scans",
    "os1-64-scans",
    "overcast",
    "pandar64-centre",
    "pandar64-centre-scans",
    "pandar64-day",
    "pandar64-scans",
    "tall-centre",
    "tall-hdl64e",
    "tall-os1-128",
    "tall-pandar64",
    "vlp16-scans",
}


def test_the_licence_credits_all_data_of_the_cards():
    named = {name for card in map(read_card, sorted(STREETS.rglob("*.safetensors"))) for name in card.data.split("+")}
    licence = (STREETS / "src" / "lidar2pano_streets" / "LICENSE").read_text()
    assert {"kitti-mini", "cityscapes"} <= named <= CREDITS.keys() | SIMULATED
    assert [name for name in named - SIMULATED if CREDITS[name] not in licence] == []
    assert "H. Caesar" in licence  # runs/stages/README.md: the autoencoder that the painter began from


def test_both_have_one_version_and_the_second_needs_the_first(wheels):
    plain, streets = metadata(wheels["lidar2pano"]), metadata(wheels["lidar2pano_streets"])
    assert plain["Version"] == streets["Version"]
    assert streets.get_all("Requires-Dist") == ["lidar2pano>=0.1"]


def test_the_index_shows_pictures_and_links_without_a_repository(wheels):
    text = str(metadata(wheels["lidar2pano"]).get_payload())
    assert "](https://github.com/lidar2pano/lidar2pano/raw/main/docs/panorama.jpg)" in text
    assert "](https://github.com/lidar2pano/lidar2pano/blob/main/RESULTS.md)" in text
    assert "](docs/" not in text and "](src/" not in text


def test_the_entry_point_leads_to_the_weights(wheels):
    entries = wheels["lidar2pano_streets"].read("lidar2pano_streets-0.1.0.dist-info/entry_points.txt").decode()
    assert entries.split() == ["[lidar2pano.weights]", "streets", "=", "lidar2pano_streets"]
    assert families()["streets"] == STREETS / "src" / "lidar2pano_streets" or families()["streets"].is_dir()
