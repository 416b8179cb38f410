"""How well a split's cameras are foretold from the scan alone: one confusion matrix per contender, as tables.

Scored is the camera's image at its own size, all of it, in the paper's 14 classes: pixels whose target is unlabeled,
sky or unsure do not count; answers of unlabeled or sky are wrong. Labels of the points come from the contender's own
segmenter. mIoU is the mean over those of the 14 classes that the split's targets have.
"""

from __future__ import annotations

from lidar2pano.evaluate.contenders import Contender, contender
from lidar2pano.evaluate.evaluation import Evaluation, score

__all__ = ["Contender", "Evaluation", "contender", "score"]
