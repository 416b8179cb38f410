"""The street world: towns from a seed, and their LiDAR scans and camera images as a data set for `data`.

Here lie the simulated LiDAR (sensor models, a scan of a scene) and the data set (settings, files, processes).
"""
