"""What runs the networks: torch, torch.compile, ONNX Runtime or OpenVINO; and their export as ONNX graphs."""

from lidar2pano.engines.selection import ENGINES, accelerated, pick_engine

__all__ = ["ENGINES", "accelerated", "pick_engine"]
