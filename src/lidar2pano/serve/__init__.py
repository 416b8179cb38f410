"""Scans in, panoramas out, over HTTP: bounded, with one model in memory and one worker."""

from __future__ import annotations

from lidar2pano.serve.application import create_application
from lidar2pano.serve.guards import BoundedConnection, is_loopback
from lidar2pano.serve.uploads import Limits, UploadTranslator

__all__ = ["BoundedConnection", "Limits", "UploadTranslator", "create_application", "is_loopback"]
