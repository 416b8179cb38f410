"""Weight files of a run: RUN/weights/<network>.safetensors (best) and <network>.last.safetensors."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torch import nn

from lidar2pano import __version__
from lidar2pano.data.frames import located
from lidar2pano.models.card import Card, save
from lidar2pano.train.recipe import Network


def release(run: Path, name: str, network: nn.Module, card: Card, last: bool = False) -> Path:
    """Write the weights of `network` with their card; `last` beside the best ones."""
    path = run / "weights" / f"{name}{'.last' if last else ''}.safetensors"
    save(path, network, card)
    return path


def make_card(spec: Network, known: Mapping[str, Any], ours: Mapping[str, Any]) -> Card:
    """The card of a network made from `spec`: what the task knows and, where both speak, what the run knows."""
    settings = {key: list(value) if isinstance(value, tuple) else value for key, value in spec.settings.items()}
    return Card(**{"network": spec.model, "settings": settings, "commit": commit(), **known, **ours})


def trained_on(root: Path, splits: Iterable[str]) -> str:
    """Names of the data sets that splits come from, joined by "+": `root`'s, and those of FOLDER:split."""
    return "+".join(dict.fromkeys(located(root, name)[0].resolve().name for name in splits))


def commit() -> str:
    """The project's commit that runs, "-dirty" when files differ from it; the package's version outside of git."""
    here = Path(__file__).parent
    try:
        git = ["git", "-C", str(here)]
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], check=True, capture_output=True)
        described = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return __version__
    return described.stdout.strip()
