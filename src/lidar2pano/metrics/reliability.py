"""How far confidence can be believed: the reliability diagram, and the expected calibration error (ECE)."""

from __future__ import annotations

import numpy as np

BINS = 15


class Reliability:
    """Counts of predictions by their confidence; Guo et al. 2017, "On Calibration of Modern Neural Networks".

    update  confidence (...) in [0, 1] and correct (...) bool; only pixels whose class is known belong in there.
    table   (BINS, 3) float64: share of the predictions, mean confidence, accuracy; NaN where a bin is empty.
    ece     the mean of |accuracy - confidence| over bins by their shares (equation 3); NaN without predictions.
    """

    def __init__(self) -> None:
        self.counts = np.zeros((BINS, 3))  # predictions, sum of confidences, correct ones

    def update(self, confidence: np.ndarray, correct: np.ndarray) -> None:
        """Count more predictions."""
        p, hit = confidence.astype(np.float64).ravel(), correct.ravel()
        bins = np.minimum((p * BINS).astype(np.int64), BINS - 1)
        self.counts += np.stack([np.bincount(bins, weights, BINS) for weights in (np.ones_like(p), p, hit)], axis=1)

    @property
    def table(self) -> np.ndarray:
        """See the class."""
        number, confidence, correct = self.counts.T
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.stack([number / number.sum(), confidence / number, correct / number], axis=1)

    @property
    def ece(self) -> float:
        """See the class."""
        if not self.counts[:, 0].sum():
            return float("nan")
        share, confidence, accuracy = self.table[self.counts[:, 0] > 0].T
        return float((share * np.abs(accuracy - confidence)).sum())
