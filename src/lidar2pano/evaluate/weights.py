"""Which weight files a name under evaluation stands for: the pipeline's roles, and those of the paper's other systems.

Roles: segmenter, translator (scan and segments -> classes), renderer (scan -> colours, without classes in between),
painter (classes -> colours), first-frame painter.
"""

from __future__ import annotations

from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.models import families

STEADY = "steady"  # behind others: their panoramas are steadied by the sensor's poses
TRUTH = "truth"  # the camera's true classes in a translator's place
ROLES = ("segmenter", "translator", "renderer", "painter", "first-frame painter")
FRONT = ("titan", "titan-next", "pix2pix")  # translators of the paper's kind: front view in, camera's image out


def links(name: str | Path) -> list[str]:
    """The parts of a chain "A+B"; a file or folder whose own name has a plus is one part."""
    return [str(name)] if Path(name).exists() else str(name).split("+")


def named_files(name: str | Path) -> dict[str, Path]:
    """Files by role of one part of a chain: a family, a run, a folder of weight files or a file; nothing is filled in.

    Raises InputError where there is none, where a network has no part in a system, and where two have the same.
    """
    installed = families.families()
    if str(name) in installed:
        return families.by_role(sorted(installed[str(name)].glob("*.safetensors")))
    path = Path(name)
    if path.is_file():
        return families.by_role([path])
    if not path.is_dir():
        raise InputError(
            f"no weights {str(name)!r}: neither a released family nor a file" + closest(str(name), [*installed, TRUTH])
        )
    folder = path / "weights" if (path / "weights").is_dir() else path
    files = sorted(file for file in folder.glob("*.safetensors") if not file.stem.endswith(".last"))
    if not files:
        raise InputError(f"{folder}: holds no weights (.safetensors); name a family, a file or a run's folder")
    return families.by_role(files)


def default_files() -> dict[str, Path]:
    """Files by role of the default family; none where it is not installed."""
    installed = families.families()
    return named_files(families.DEFAULT) if families.DEFAULT in installed else {}
