"""The simulated LiDAR: sensor models, a scan of a scene, and the measurement noise of its returns."""
