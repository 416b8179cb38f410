"""Engines of the networks: torch, torch.compile, ONNX Runtime, OpenVINO; and export as ONNX graphs."""

from lidar2pano.engines.selection import ENGINES, accelerated, pick_engine

__all__ = ["ENGINES", "accelerated", "pick_engine"]
