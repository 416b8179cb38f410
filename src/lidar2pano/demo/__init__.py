"""The scan that ships with the package: a frame of the street world, made by `runs/demo_scan.py`."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def street() -> Path:
    """Path of the scan: a KITTI .bin, one turn of an HDL-64E on the roof of a car in a town street."""
    return Path(str(files(__name__) / "street.bin"))
