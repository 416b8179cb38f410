"""Scan, raster and camera picture: what falls where."""
