"""Scans in, panoramas out, over HTTP: bounded, with one model in memory and one worker."""

from __future__ import annotations

from lidar2pano.serve.application import create_application
from lidar2pano.serve.limits import Limits
from lidar2pano.serve.translation import Translation

__all__ = ["Limits", "Translation", "create_application"]
