"""Families of this package and of other distributions, and which of them is taken."""

from __future__ import annotations

import logging
import shutil
import sys

import pytest

from installed_families import install_only
from lidar2pano.cli.options import BEST as OPTION
from lidar2pano.errors import InputError
from lidar2pano.models import families as module
from lidar2pano.models.families import BEST, best_family, families, weight_files


@pytest.fixture
def distribution(tmp_path, monkeypatch, random_weights):
    """A function that installs a distribution with a family of this name, found by its entry point alone."""

    def install(family: str) -> None:
        shutil.copytree(random_weights, tmp_path / "site" / "streets_of_others")
        (tmp_path / "site" / "streets_of_others" / "__init__.py").write_text("raise ImportError('is not imported')")
        info = tmp_path / "site" / "others-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1\n")
        (info / "entry_points.txt").write_text(f"[lidar2pano.others]\n{family} = streets_of_others\n")
        monkeypatch.setattr(sys, "path", [str(tmp_path / "site"), *sys.path])
        monkeypatch.setattr(module, "GROUP", "lidar2pano.others")

    return install


def test_a_family_of_another_distribution_is_found(distribution, random_weights, tmp_path):
    distribution("elsewhere")
    assert set(families()) == {"elsewhere", "world"}
    files = weight_files("elsewhere")
    assert {role: file.name for role, file in files.items()} == {
        role: f"{role}.safetensors" for role in ("segmenter", "translator", "painter")
    }
    assert all(file.parent == tmp_path / "site" / "streets_of_others" for file in files.values())


def test_the_best_installed_family_is_taken_and_named(distribution, caplog, monkeypatch):
    caplog.set_level(logging.INFO, "lidar2pano")
    monkeypatch.setattr(module, "GROUP", "no entry points")
    assert best_family() == "world" and weight_files(BEST) == weight_files("world")
    distribution("streets")
    assert best_family() == "streets" and weight_files(BEST) == weight_files("streets")
    assert caplog.messages == [
        "weights world: the best that is installed",
        "weights streets: the best that is installed",
    ]
    assert OPTION == BEST


def test_a_family_keeps_its_earlier_name(distribution):
    distribution("streets")
    assert weight_files("kitti-mini") == weight_files("streets") != weight_files("world")
    assert weight_files("world+kitti-mini") == weight_files("world+streets")
    assert set(families()) == {"streets", "world"}  # it is listed once


def test_a_distribution_that_is_gone_is_no_family(distribution, tmp_path):
    distribution("streets")
    shutil.rmtree(tmp_path / "site" / "streets_of_others")
    assert set(families()) == {"world"}


def test_a_family_that_is_not_installed_is_named_with_its_distribution(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "GROUP", "no entry points")
    with pytest.raises(InputError, match="no weights 'streets': .*; pip install lidar2pano-streets$"):
        weight_files("streets")
    with pytest.raises(InputError, match="no weights 'wrld': .*did you mean 'world'"):
        weight_files("wrld")
    install_only(monkeypatch, tmp_path / "none")
    with pytest.raises(InputError, match="no weights are installed"):
        weight_files(BEST)
