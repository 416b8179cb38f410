"""Weight files of lidar2pano's family `streets`, licensed CC BY-NC-SA 4.0: see LICENSE beside them."""
