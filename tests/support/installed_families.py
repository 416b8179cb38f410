"""Which families of weights are installed, and tests that need those of another distribution."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from house_rules import ROOT
from lidar2pano.models.families import families

INSTALLED = tuple(families())
needs_streets = pytest.mark.needs(
    "streets" in INSTALLED, "the weights streets: pip install ./packages/lidar2pano-streets, in a clone"
)


def page_parameters(pages: Iterable[Path], *of_streets: str) -> list[Any]:
    """One parameter per page, with its path below the repository as id; pages of these names tell of all families."""
    return [
        pytest.param(
            page,
            id=page.relative_to(ROOT).as_posix(),
            marks=[needs_streets] if page.name in of_streets else [],
        )
        for page in pages
    ]


def install_only(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let the families in a folder be the only ones that are installed."""
    monkeypatch.setattr("lidar2pano.models.families.RELEASED", folder)
    monkeypatch.setattr("lidar2pano.models.families.GROUP", "no entry points")
