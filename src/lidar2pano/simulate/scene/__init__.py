"""The scene of the cameras and the LiDAR: meshes, their materials and classes, and ray casting."""
