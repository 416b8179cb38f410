"""Recordings: ROS 1 bags, ROS 2 bags (db3, mcap), packet captures; their scans in time, their poses, what they hold."""
