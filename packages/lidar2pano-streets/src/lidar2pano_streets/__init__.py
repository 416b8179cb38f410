"""Weight files of lidar2pano's family `kitti-mini`, licensed CC BY-NC-SA 4.0: see LICENSE beside them."""
