"""Labels that nobody has to draw: teachers look at a data set's scans and pictures and write what they see.

What is there and was not written by this package is never touched; what was is done again when its scan, its picture,
the weights or the settings have changed. Each sequence has a journal that says which files are ours, and of what.
"""

from __future__ import annotations

from lidar2pano.prepare.labelling import Labelled, State, label
from lidar2pano.prepare.materials import Material, materials
from lidar2pano.prepare.teachers import Teacher, camera_teacher, lidar_teacher

__all__ = ["Labelled", "Material", "State", "Teacher", "camera_teacher", "label", "lidar_teacher", "materials"]
