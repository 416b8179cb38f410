"""What a built wheel holds: every module, the weights with their cards and licences, the demo's scan."""

from __future__ import annotations

import re
import tomllib

from hatchling.builders.wheel import WheelBuilder

import house_rules
import lidar2pano
from lidar2pano.cli.app import EXTRAS as MODULE_EXTRAS
from lidar2pano.engines import EXTRAS as ENGINE_EXTRAS

SETTINGS = tomllib.loads((house_rules.ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = SETTINGS["project"]
EXTRAS = PROJECT["optional-dependencies"]
MADE = ("site/", "dist/", ".venv/")  # folders that commands make


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
    assert PROJECT["version"] == lidar2pano.__version__
    assert f"[{lidar2pano.__version__}]" in (house_rules.ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_every_required_package_has_a_tested_version():
    lines = (house_rules.ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {name(line) for line in lines if "==" in line}
    groups = [PROJECT["dependencies"], *EXTRAS.values(), *SETTINGS["dependency-groups"].values()]
    required = {name(line) for group in groups for line in group if isinstance(line, str)} - {"lidar2pano"}
    assert required >= {"torch", "numpy", "lightning-fabric", "pytest"}
    assert required <= pinned


def test_all_extras_are_in_all():
    (line,) = EXTRAS["all"]
    assert line == f"lidar2pano[{','.join(extra for extra in EXTRAS if extra != 'all')}]"


def named_extras(text: str) -> set[str]:
    """Extras that messages, docstrings and pages name."""
    lists = re.findall(r"(?:lidar2pano|'\.)\[([a-z,]+)\]", text)
    found = [extra for names in lists for extra in names.split(",")]
    found += re.findall(r"extra [`']([a-z]+)[`']", text)
    found += re.findall(r"_extra\(.*, \"([a-z]+)\"\)", text)
    return set(found)


def test_every_extra_that_is_named_exists():
    files = [
        *house_rules.SOURCE.rglob("*.py"),
        *(house_rules.ROOT / "docs").rglob("*.md"),
        house_rules.ROOT / "README.md",
    ]
    named = {extra for path in files for extra in named_extras(path.read_text(encoding="utf-8"))}
    assert {"train", "formats", "recordings", "bulk"} <= named
    named |= {*MODULE_EXTRAS.values(), *(extra for extra, _ in ENGINE_EXTRAS.values())}
    assert named <= EXTRAS.keys()


def test_pip_uv_and_conda_install_extras_that_exist():
    page = (house_rules.ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    commands = re.findall(r"^(?:pip|uv|conda) .*install.*$", page, flags=re.MULTILINE)
    assert {command.split()[0] for command in commands} == {"pip", "uv", "conda"}
    assert {extra for command in commands for extra in named_extras(command)} == {"formats", "recordings"}
    folders = {folder for command in commands for folder in re.findall(r"(?<= )\./(\S+)", command)}
    assert folders and all((house_rules.ROOT / folder / "pyproject.toml").is_file() for folder in folders)


def test_every_file_that_contributing_and_the_settings_name_exists():
    page = (house_rules.ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    names = re.findall(r"[`(]([\w.-]+(?:/[\w.-]+)+|\w+\.(?:py|md|toml|txt|cff))[`)]", page)
    paths = [name for name in names if not name.startswith(MADE)]
    tools = SETTINGS["tool"]
    paths += tools["pyright"]["strict"] + tools["pyright"]["include"] + tools["ruff"]["src"]
    paths += [name.lstrip("/") for name in tools["hatch"]["build"]["targets"]["sdist"]["include"] if "*" not in name]
    assert {"runs/diagrams.py", "src/lidar2pano/views.py", "tests/support/house_rules.py"} <= set(paths)
    places = [house_rules.ROOT, house_rules.ROOT / "tests" / "fuzz", house_rules.SOURCE, house_rules.SOURCE.parent]
    assert [path for path in paths if not any((place / path).exists() for place in places)] == []


def name(requirement: str) -> str:
    """`pyright[nodejs]>=1.1` -> "pyright"; underscores and capitals as package indexes fold them."""
    for mark in "[>=<! ;":
        requirement = requirement.partition(mark)[0]
    return requirement.lower().replace("_", "-")
