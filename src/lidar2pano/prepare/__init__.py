"""Labels without drawing them by hand: teachers label a data set's scans and images.

Files of other origin are never touched; own ones are made again after changes of scan, image, weights or settings. Each
sequence has a journal of own files and their sources.
"""

from __future__ import annotations

from lidar2pano.prepare.labelling import LabelledFile, State, frames_to_label, label
from lidar2pano.prepare.teachers import Teacher, camera_teacher, lidar_teacher

__all__ = ["LabelledFile", "State", "Teacher", "camera_teacher", "frames_to_label", "label", "lidar_teacher"]
