"""Families of released weights: files behind a name, and files of one's own in their places."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.labels import COMMON14
from lidar2pano.models.card import Card, read_card

RELEASED = Path(__file__).parent.parent / "weights"
GROUP = "lidar2pano.weights"  # entry points of other distributions: family = the package with its files
ALIASES = {"kitti-mini": "streets"}  # earlier names of families
DISTRIBUTIONS = {"streets": "lidar2pano-streets"}  # family -> its distribution
PREFERENCE = ("streets", "world")  # the better one on real scans first
BEST = "best"  # in place of a family: the first installed one of PREFERENCE
FRONT_VIEW = ("titan", "titan-next", "pix2pix")  # translators of the paper's kind: front view in, camera's image out
ROLES: dict[str, str] = {
    "salsanext": "segmenter",
    "titan-pano": "translator",
    "titan-next": "translator",
    "titan": "translator",
    "pix2pix": "translator",
    "scunet": "renderer",
    "latent-painter": "painter",
    "autoencoder": "autoencoder",
    "vid2vid": "painter",
    "vid2vid-single": "first-frame painter",
}
"""The part that a network plays; a translator of the paper's kind that gives colours is a renderer (see `role`)."""


log = logging.getLogger("lidar2pano")


def families() -> dict[str, Path]:
    """Installed families: name -> folder with one .safetensors per role, and LICENSE.

    They lie in this package, or in packages of other distributions, named by entry points of GROUP.
    """
    folders = {folder.name: folder for folder in RELEASED.glob("*/")}
    folders |= {entry.name: folder for entry in entry_points(group=GROUP) if (folder := _package_folder(entry))}
    return {name: folders[name] for name in sorted(folders) if any(folders[name].glob("*.safetensors"))}


def _package_folder(entry: EntryPoint) -> Path | None:
    """Return the folder of the package behind an entry point, without importing it; None if it is gone."""
    spec = importlib.util.find_spec(entry.value)
    return Path(next(iter(spec.submodule_search_locations))) if spec and spec.submodule_search_locations else None


def best_family() -> str:
    """Return the name of the best installed family; InputError without any."""
    installed = families()
    if not installed:
        raise InputError("no weights are installed with this package; train some or name files of your own")
    return next((name for name in PREFERENCE if name in installed), next(iter(installed)))


def weight_files(name: str | Path, *, fill: bool = True, look: str = "") -> dict[str, Path]:
    """Files by role (see `role`) of a name or path.

    name  a family, or its earlier name; BEST; a folder of weight files or a training run (its `weights/`); or one
          weight file. Several joined by "+" are taken together, later ones in the places of earlier ones. Other roles
          are filled by the best installed family, if there is one and `fill` is true.
    look  of several painters, one for each look, the file of this name (without .safetensors) is taken.
    Raises InputError when there is no such family, file or folder, or `by_role` refuses its files.
    """
    installed = families()
    name = ALIASES.get(str(name), name)
    if str(name) == BEST:
        name = best_family()
        log.info("weights %s: the best that is installed", name)
    if len(parts := chained(name)) > 1:
        files = weight_files(parts[0], fill=fill, look=look)
        for part in parts[1:]:
            further = weight_files(part, fill=False, look=look)
            if paints_look(files, look):
                further.pop("painter", None)
            files |= further
        return files
    if str(name) in installed:
        return by_role(sorted(installed[str(name)].glob("*.safetensors")))
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
            f"no weights {str(name)!r}: neither a released family nor a file" + _remedy(str(name), installed)
        )
    own = by_role(files, look)
    rest = by_role(sorted(installed[best_family()].glob("*.safetensors"))) if fill and installed else {}
    return rest | own


def _remedy(name: str, installed: Iterable[str]) -> str:
    if name in DISTRIBUTIONS:
        return f"; pip install {DISTRIBUTIONS[name]}"
    return closest(name, installed)


def chained(name: str | Path) -> list[str]:
    """The parts of a chain "A+B"; a file or folder whose own name has a plus is one part."""
    return [str(name)] if Path(name).exists() else str(name).split("+")


def role(card: Card) -> str | None:
    """Return the part of a card's network; None for a network without one.

    Roles: segmenter, translator (scan and segments -> classes), renderer (scan -> colours, without classes in between),
    painter (classes -> colours), first-frame painter.
    """
    if card.network in ("titan", "pix2pix") and card.labels != COMMON14.name:
        return "renderer"
    return ROLES.get(card.network)


def paints_look(files: Mapping[str, Path], look: str) -> bool:
    """Tell if the painter is the one for a look by the name of its file, whatever its own looks."""
    return bool(look) and "painter" in files and files["painter"].stem == look


def by_role(files: Iterable[Path], look: str = "") -> dict[str, Path]:
    """Weight files by the roles of their networks; InputError when one has none, or two have the same.

    look  see `weight_files`: other painters than the one of this name are left out.
    """
    roles: dict[str, Path] = {}
    for file in sorted(files, key=lambda file: file.stem != look):
        card = read_card(file)
        part = role(card)
        if part is None:
            mend = "evaluate takes it as --sdnet" if card.network == "sdnet" else f"name weights of {', '.join(ROLES)}"
            raise InputError(f"{file}: a {card.network!r} has no part in a system; {mend}")
        if part == "painter" and paints_look(roles, look):
            continue
        if part in roles:
            how = " (for painters, --look and a file's name do, too)" if part == "painter" else ""
            raise InputError(
                f"{file.parent}: {roles[part].name} and {file.name} are both a {part}; name one of them{how}"
            )
        roles[part] = file
    return roles


def licence_note(cards: Iterable[Card]) -> str | None:
    """Return one line about a licence with restrictions on these weights, or None."""
    licences = {card.licence for card in cards}
    strict = sorted(licence for licence in licences if "NC" in licence.upper().replace("-", " ").split())
    return f"these weights are licensed {', '.join(strict)}: not for commercial use" if strict else None
