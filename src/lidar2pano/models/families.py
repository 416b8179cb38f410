"""Families of released weights: which files a name stands for, and how files of one's own take their places."""

from __future__ import annotations

from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.models.card import read_card

RELEASED = Path(__file__).parent.parent / "weights"
DEFAULT = "kitti-mini"  # the better one on real scans
ROLES: dict[str, str] = {
    "salsanext": "segmenter",
    "titan-pano": "translator",
    "titan": "translator",
    "painter": "painter",
    "scene-painter": "painter",
    "vid2vid": "painter",
    "vid2vid-single": "first-frame painter",
}
"""The part that a network plays in the pipeline."""


def families() -> dict[str, Path]:
    """Released families that are installed: name -> folder with one .safetensors per role, and LICENSE."""
    found = sorted(folder for folder in RELEASED.glob("*/") if any(folder.glob("*.safetensors")))
    return {folder.name: folder for folder in found}


def weight_files(name: str | Path, *, fill: bool = True) -> dict[str, Path]:
    """Files by role (segmenter, translator, painter, first-frame painter) that a name or path stands for.

    name  a released family; a folder of weight files or a training run (its `weights/`); or one weight file. Roles
          that a path does not fill are filled by the default family, where it is installed and `fill` is true.
    Raises InputError when there is no such family, file or folder, or a folder has two files for one role.
    """
    installed = families()
    if str(name) in installed:
        return _by_role(sorted(installed[str(name)].glob("*.safetensors")))
    path = Path(name)
    if path.is_dir():
        folder = path / "weights" if (path / "weights").is_dir() else path
        files = sorted(file for file in folder.glob("*.safetensors") if not file.stem.endswith(".last"))
        if not files:
            raise InputError(f"{folder}: holds no weights (.safetensors); name a family, a file or a run's folder")
    elif path.is_file():
        files = [path]
    else:
        raise InputError(
            f"no weights {str(name)!r}: neither a released family nor a file" + closest(str(name), installed)
        )
    mine = _by_role(files)
    rest = _by_role(sorted(installed[DEFAULT].glob("*.safetensors"))) if fill and DEFAULT in installed else {}
    return rest | mine


def licence_note(files: dict[str, Path]) -> str | None:
    """One line about a licence that restricts the use of these files, or None where none does."""
    licences = {read_card(file).licence for file in files.values()}
    strict = sorted(licence for licence in licences if "NC" in licence.upper().replace("-", " ").split())
    return f"these weights are licensed {', '.join(strict)}: not for commercial use" if strict else None


def _by_role(files: list[Path]) -> dict[str, Path]:
    roles: dict[str, Path] = {}
    for file in files:
        network = read_card(file).network
        if network not in ROLES:
            raise InputError(f"{file}: a {network!r} has no part in the pipeline; name weights of {', '.join(ROLES)}")
        role = ROLES[network]
        if role in roles:
            raise InputError(f"{file.parent}: {roles[role].name} and {file.name} are both a {role}; name one of them")
        roles[role] = file
    return roles
