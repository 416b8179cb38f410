"""Dockerfile and compose.yaml name files, extras, variables and a port that exist; no Docker builds them here."""

from __future__ import annotations

import re
import tomllib

import yaml

import dockerfile
import house_rules
from lidar2pano.cli.app import make_program
from lidar2pano.engines import VARIABLE
from lidar2pano.engines.disk_cache import cache_folder

ROOT = house_rules.ROOT
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")
STEPS = "\n".join(line for line in DOCKERFILE.splitlines() if not line.startswith("#"))
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))


def test_what_is_copied_exists_and_is_not_ignored():
    copied = [name for line in re.findall(r"^COPY (.*) \S+$", STEPS, flags=re.MULTILINE) for name in line.split()]
    allowed = re.findall(r"^!(\S+)$", (ROOT / ".dockerignore").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert sorted(copied) == sorted(allowed)
    assert [name for name in copied if not (ROOT / name).exists()] == []


def test_the_installation_needs_only_what_is_copied():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    hook = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["path"]
    assert hook.startswith("packages/")
    assert all(pattern.partition("/")[0] in ("LICENSE", "src") for pattern in project["project"]["license-files"])
    (extras,) = re.findall(r"'\.\[([a-z,]+)\]'", STEPS)
    assert set(extras.split(",")) <= project["project"]["optional-dependencies"].keys()


def test_the_variables_are_read_by_the_program():
    names = set(re.findall(r"\b(LIDAR2PANO_[A-Z]+)=", STEPS))
    assert names == {"LIDAR2PANO_ENGINE", "LIDAR2PANO_CACHE"}
    source = "".join(path.read_text(encoding="utf-8") for path in house_rules.SOURCE.rglob("*.py"))
    assert [name for name in names if f'"{name}"' not in source] == []


def test_compose_has_the_ports_arguments_and_volume_of_the_image():
    port = re.search(r"^EXPOSE (\d+)$", STEPS, flags=re.MULTILINE)
    arguments = set(re.findall(r"^ARG (\w+)", STEPS, flags=re.MULTILINE))
    assert port
    for service in COMPOSE["services"].values():
        assert service["ports"] == [f"127.0.0.1:{port[1]}:{port[1]}"], "the service has no accounts: loopback alone"
        build = service["build"]
        assert set(build.get("args", {}) if isinstance(build, dict) else {}) <= arguments
    (volume,) = COMPOSE["services"]["serve"]["volumes"]
    assert f"VOLUME {volume.partition(':')[2]}" in STEPS


def test_the_networks_are_compiled_while_the_image_is_built():
    compiled = STEPS.index("lidar2pano demo --weights best")
    assert STEPS.index("ENV LIDAR2PANO_ENGINE=$ENGINE") < compiled < STEPS.index("VOLUME ")


def test_the_variables_have_their_effect(monkeypatch):
    variables = dict(word.split("=") for name, rest in dockerfile.STEPS if name == "ENV" for word in rest.split())
    monkeypatch.setenv("LIDAR2PANO_CACHE", variables["LIDAR2PANO_CACHE"])
    assert cache_folder().as_posix() == variables["LIDAR2PANO_CACHE"] and VARIABLE == "LIDAR2PANO_ENGINE"
    assert f"VOLUME {variables['LIDAR2PANO_CACHE']}" in STEPS.splitlines()
    engines = [
        rest.partition("=")[2] for name, rest in dockerfile.STEPS if name == "ARG" and rest.startswith("ENGINE=")
    ]
    assert [variables[VARIABLE], *engines] == ["$ENGINE", "openvino"]


def test_the_entry_point_is_the_program_and_its_words_are_a_command():
    """Docker joins both lists; the health check asks the port that the command listens on, and EXPOSE names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert dockerfile.words_of("ENTRYPOINT") == list(project["scripts"])
    command, *words = dockerfile.words_of("CMD")
    program = make_program()
    with program.commands[command].make_context(command, words) as context:
        assert context.params["host"] == "0.0.0.0"
        port = context.params["port"]
    python, _, code = dockerfile.health_command()
    compile(code, "HEALTHCHECK", "exec")
    assert python == "python" and f"127.0.0.1:{port}/health" in code and f"EXPOSE {port}" in STEPS.splitlines()


def test_every_instruction_is_one_that_the_test_of_its_steps_takes():
    taken = {"ARG", "WORKDIR", "ENV", "COPY", "RUN"} | dockerfile.SETTINGS
    assert [name for name, _ in dockerfile.STEPS if name not in taken] == []
    assert dockerfile.instructions("# a\nRUN b \\\n && c\n\nUSER d") == [("RUN", "b && c"), ("USER", "d")]
