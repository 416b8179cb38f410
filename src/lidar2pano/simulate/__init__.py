"""The street world: towns from a seed, and what a LiDAR and cameras see of them. Writes files that `data` reads."""
