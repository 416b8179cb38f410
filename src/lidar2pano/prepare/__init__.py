"""Labels without drawing them by hand: teachers label a data set's scans and images.

What is there and was not written by this package is never touched; what was is done again when its scan, its image,
the weights or the settings have changed. Each sequence has a journal that says which files are ours, and of what.
"""

from __future__ import annotations

from lidar2pano.prepare.labelling import LabelledFile, State, frames_to_label, label
from lidar2pano.prepare.teachers import Teacher, camera_teacher, lidar_teacher

__all__ = ["LabelledFile", "State", "Teacher", "camera_teacher", "frames_to_label", "label", "lidar_teacher"]
