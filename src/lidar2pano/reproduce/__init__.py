"""The paper's tables as one run: what is missing is trained, every row is scored, and RESULTS.md is written.

reproduce(Plan(...)) -> Report          restartable at every network and every row
"""

from __future__ import annotations

from lidar2pano.reproduce.plan import Plan
from lidar2pano.reproduce.rows import ROWS, Row
from lidar2pano.reproduce.run import Outcome, reproduce

__all__ = ["ROWS", "Outcome", "Plan", "Row", "reproduce"]
