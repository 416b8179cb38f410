"""Metrics of label maps, images, depth maps and panoramas."""
