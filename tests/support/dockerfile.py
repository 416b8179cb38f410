"""The steps of the Dockerfile without Docker: a folder stands for the image's root, an environment for its Python."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from house_rules import ROOT

# Folders of the image that its steps name; commands of Debian's that a user without rights lacks are stood in for.
FOLDERS = re.compile(r"(?<![\w./:])/(?=(?:build|home|tmp)\b)")
USERADD = '#!/bin/sh\nfor name; do :; done\nexec mkdir -p "{root}/home/$name"\n'
PASSED = ("PIP_", "SSL_", "HTTP_PROXY", "HTTPS_PROXY", "OMP_", "LANG")  # beginnings of variables that steps may see


def instructions(text: str) -> list[tuple[str, str]]:
    """Return the names and arguments of a Dockerfile's instructions; continued lines are joined."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    joined = re.sub(r" *\\\n\s*", " ", "\n".join(lines)).splitlines()
    pairs = [line.partition(" ") for line in joined if line.strip()]
    return [(name, rest.strip()) for name, _, rest in pairs]


STEPS = instructions((ROOT / "Dockerfile").read_text(encoding="utf-8"))


def words_of(name: str) -> list[str]:
    """Return the words of the instruction ENTRYPOINT or CMD."""
    (found,) = [rest for step, rest in STEPS if step == name]
    return json.loads(found)


def health_command() -> list[str]:
    """Return the words of the command that tells whether the container is well."""
    (found,) = [rest for step, rest in STEPS if step == "HEALTHCHECK"]
    return json.loads(found.partition("CMD ")[2])


@dataclass(kw_only=True)
class Image:
    """A folder that the steps have made, and their environment."""

    root: Path
    folder: str = "/"
    variables: dict[str, str] = field(default_factory=dict)

    def run(self, command: list[str] | str, **more) -> subprocess.CompletedProcess[str]:
        """Run words, or a line by the shell, in the image; its folders in the line and in the variables are its own."""
        words = ["/bin/sh", "-ec", self.inside(command)] if isinstance(command, str) else command
        return subprocess.run(words, **self.surroundings(), capture_output=True, text=True, check=False, **more)

    def surroundings(self) -> dict:
        """Return the working folder and the environment of the image's processes, for `subprocess`."""
        kept = {name: value for name, value in os.environ.items() if name.upper().startswith(PASSED)}
        path = f"{self.root}/venv/bin:{self.root}/bin:/usr/local/bin:/usr/bin:/bin"
        own = {name: self.inside(value) for name, value in self.variables.items()}
        home = {"HOME": str(self.place(self.folder)), "PATH": path, "TMPDIR": str(self.place("/tmp"))}
        return {"cwd": self.place(self.folder), "env": kept | home | own}

    def place(self, folder: str) -> Path:
        """Return the place of a folder of the image."""
        return self.root / folder.lstrip("/")

    def inside(self, text: str) -> str:
        """Return a text with the image's folders in place of the root's."""
        return FOLDERS.sub(f"{self.root}/", text)


class StepFailed(Exception):
    """A step that ended with another code than 0."""


def build(root: Path, given: Mapping[str, str]) -> Image:
    """Take the Dockerfile's steps in an empty folder; StepFailed as a step does. `given`: values of its arguments."""
    image = Image(root=root)
    for folder in ("bin", "tmp"):
        (root / folder).mkdir(parents=True)
    stand_in = root / "bin" / "useradd"
    stand_in.write_text(USERADD.format(root=root), encoding="utf-8")
    stand_in.chmod(stand_in.stat().st_mode | stat.S_IEXEC)
    subprocess.run([sys.executable, "-m", "venv", root / "venv"], check=True)
    arguments: dict[str, str] = {}
    for name, rest in STEPS:
        if name == "ARG":
            argument, _, default = rest.partition("=")
            arguments[argument] = given.get(argument, default)
        elif name == "WORKDIR":
            image.folder = rest
            image.place(rest).mkdir(parents=True, exist_ok=True)
        elif name == "ENV":
            pairs = [word.partition("=") for word in rest.split()]
            image.variables |= {
                key: arguments.get(value[1:], value) if value[:1] == "$" else value for key, _, value in pairs
            }
        elif name == "COPY":
            *sources, target = rest.split()
            copy([ROOT / source for source in sources], image.place(image.folder) / target)
        elif name == "RUN":
            stated = Image(root=root, folder=image.folder, variables=arguments | image.variables)
            if (done := stated.run(rest)).returncode:
                raise StepFailed(f"RUN {rest}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
        elif name not in SETTINGS:
            raise StepFailed(f"{name}: no step that is known here")
    return image


SETTINGS = {"FROM", "USER", "VOLUME", "EXPOSE", "HEALTHCHECK", "ENTRYPOINT", "CMD"}  # that make no step


def copy(sources: list[Path], target: Path) -> None:
    """Copy files into a folder, and the contents of one folder into another, as COPY does."""
    for source in sources:
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
        else:
            shutil.copy(source, target)
