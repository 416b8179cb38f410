"""A ROS 2 node for lidar2pano."""
