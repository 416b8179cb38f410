"""How far the translator's confidence can be believed, on a simulated data set: ECE by temperature.

    .venv/bin/python runs/confidence.py DATA SPLIT WEIGHTS [FRAMES]

Prints for each temperature the negative log-likelihood and the ECE over pixels whose class is known.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torchmetrics.classification import BinaryCalibrationError

from lidar2pano.data.frames import IGNORE, evenly_spaced
from lidar2pano.data.layouts import frames
from lidar2pano.hardware import Timer
from lidar2pano.pipeline import load

TEMPERATURES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 1.8, 2.2, 2.7, 3.3)


def main(data: Path, split: str, weights: str, most: int) -> None:
    pipeline = load(weights, "cpu")
    found = frames(data, split)
    metrics = {T: BinaryCalibrationError(n_bins=15) for T in TEMPERATURES}
    loss, pixels, right = dict.fromkeys(TEMPERATURES, 0.0), 0, 0
    for index in evenly_spaced(len(found), most):
        frame = found[index]
        labels = torch.from_numpy(frame.panorama_labels.copy()).long()
        scene = pipeline.translate(frame.scan, Timer(pipeline.device))
        logits = scene.probabilities[0].clamp(min=1e-20).log()  # of what `--save confidence` writes
        rows, columns = (torch.arange(size) * labels.shape[i] // size for i, size in enumerate(logits.shape[1:]))
        target = labels[rows][:, columns]
        known = (target != IGNORE) & (target != 0)
        scores, target = logits[:, known], target[known]
        pixels, right = pixels + len(target), right + int((scores.argmax(0) == target).sum())
        for T in TEMPERATURES:
            p = (scores / T).softmax(0)
            loss[T] -= float(p.gather(0, target[None]).clamp(min=1e-12).log().sum())
            metrics[T].update(p.amax(0), (p.argmax(0) == target).long())
    print(f"{weights}: {pixels} pixels, accuracy {right / pixels:.3f}")
    for T in TEMPERATURES:
        print(f"  T {T:4}: negative log-likelihood {loss[T] / pixels:.3f}, ECE {metrics[T].compute():.3f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3], int([*sys.argv, "12"][4]))
