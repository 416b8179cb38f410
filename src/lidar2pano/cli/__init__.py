"""The command line: `lidar2pano COMMAND`. Importing a command's module enters it, in the order of the help."""

from __future__ import annotations

# isort: off
from lidar2pano.cli import translate, view, inspect, world, prepare, train, evaluate, reproduce  # noqa: F401
from lidar2pano.cli import weights, export, bulk, serve, bench  # noqa: F401
from lidar2pano.cli.app import app, main

# isort: on

__all__ = ["app", "main"]
