"""What a built wheel holds: every module, the weights with their cards and licences, the demo's scan."""

from __future__ import annotations

import tomllib

from hatchling.builders.wheel import WheelBuilder

import house_rules
import lidar2pano


def shipped() -> set[str]:
    return {file.distribution_path for file in WheelBuilder(str(house_rules.ROOT)).recurse_included_files()}


def test_the_wheel_holds_modules_weights_and_demo():
    wanted = {
        f"{house_rules.PACKAGE}/{path.relative_to(house_rules.SOURCE).as_posix()}"
        for path in house_rules.SOURCE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"lidar2pano/py.typed", "lidar2pano/__init__.py"} <= wanted
    assert any(name.endswith(".safetensors") for name in wanted), "weights/ holds no weights"
    assert any(name.startswith("lidar2pano/demo/") for name in wanted), "demo/ holds no scan"
    assert wanted <= shipped()


def test_every_family_of_weights_has_its_licence_beside_it():
    families = {path.parent for path in (house_rules.SOURCE / "weights").rglob("*.safetensors")}
    assert families
    assert [family.name for family in families if not any(family.glob("LICENSE*"))] == []


def test_one_version():
    project = tomllib.loads((house_rules.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == lidar2pano.__version__
    assert f"[{lidar2pano.__version__}]" in (house_rules.ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_every_required_package_has_a_tested_version():
    project = tomllib.loads((house_rules.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (house_rules.ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {name(line) for line in lines if "==" in line}
    extras = project["optional-dependencies"].values()
    required = {name(line) for group in [project["dependencies"], *extras] for line in group}
    assert required >= {"torch", "numpy", "lightning", "pytest"}
    assert required <= pinned


def name(requirement: str) -> str:
    """`pyright[nodejs]>=1.1` -> "pyright"; underscores and capitals as package indexes fold them."""
    for mark in "[>=<! ;":
        requirement = requirement.partition(mark)[0]
    return requirement.lower().replace("_", "-")
