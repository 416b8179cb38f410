"""How good systems are, measured frame by frame: classes and pictures, in the camera's sector and all around.

    system(weights, painter=None, device="auto", sensor="") -> System
    score(systems, truths, *, data, split, measures=None, after_each=...) -> Evaluation
    Evaluation.as_dict() -> dict[str, Any]     ready for JSON; `.table()` is Markdown, `.records()` rows for CSV

weights   what `--weights` takes, or a chain "TRANSLATOR+PAINTER"; "truth" in front of a painter is the ceiling.
systems   each sees scan and calibration and nothing else of a frame (`Question`); only the ceiling is told the classes.
truths    `data.truths.truths(root, split)`: what is known of each frame decides what can be measured there.

Scored in the camera is its whole image at its own size, in the paper's 14 classes: pixels whose target is unlabeled,
sky or unsure do not count; answers of unlabeled or sky are wrong. mIoU is the mean over those of the 14 classes that
the split's targets have. All around, likewise, on the truth's own raster. Colours count where they are known.
What is counted merges over parts of a split to the last bit (`Evaluation.merge`), as long as no stream is cut.
"""

from __future__ import annotations

from lidar2pano.evaluate.evaluation import Evaluation, score
from lidar2pano.evaluate.measures import Measures
from lidar2pano.evaluate.questions import Question, Seen, System
from lidar2pano.evaluate.systems import system

__all__ = ["Evaluation", "Measures", "Question", "Seen", "System", "score", "system"]
