"""The street world: towns from a seed, and their LiDAR scans and camera images as a data set for `data`."""
