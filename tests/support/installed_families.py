"""Which families of weights are installed, and tests that need those of another distribution."""

from __future__ import annotations

from pathlib import Path

import pytest

from lidar2pano.models.families import families

INSTALLED = tuple(families())
needs_streets = pytest.mark.needs(
    "kitti-mini" in INSTALLED, "the weights kitti-mini: pip install ./packages/lidar2pano-streets, in a clone"
)


def install_only(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let the families in a folder be the only ones that are installed."""
    monkeypatch.setattr("lidar2pano.models.families.RELEASED", folder)
    monkeypatch.setattr("lidar2pano.models.families.GROUP", "no entry points")
