"""The paper's tables as one run: missing networks are trained, every row is scored, and RESULTS.md is written.

reproduce(Plan(...)) -> Outcome         resumable at every network and every row
"""

from __future__ import annotations

from lidar2pano.reproduce.paper_tables import ROWS, PaperRow
from lidar2pano.reproduce.run import Outcome, Plan, reproduce

__all__ = ["ROWS", "Outcome", "PaperRow", "Plan", "reproduce"]
