"""One bare LiDAR scan in, a 360-degree colour picture of the place out."""

__version__ = "0.1.0"
