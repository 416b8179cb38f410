"""`python -m lidar2pano` is the program `lidar2pano`."""

from __future__ import annotations

import sys

from lidar2pano.cli import main

sys.exit(main())
