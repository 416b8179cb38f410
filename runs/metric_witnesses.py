"""Compare every metric with an independent implementation: a Markdown table of the largest differences.

    python runs/metric_witnesses.py [OUT.md] [--pairs N] [--data FOLDER]

The images are random, or those of FOLDER (any PNG and JPEG below it, N pairs of neighbours, no image twice). The other
implementations are in tests/support/metric_definitions.py; torch-fidelity is used when the environment names its folder
(TORCH_FIDELITY), and left out otherwise.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.stats
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

import metric_definitions as definitions  # pyright: ignore[reportMissingImports]
from golden_fill import fill  # pyright: ignore[reportMissingImports]
from lidar2pano.hardware import keep_buffers
from lidar2pano.metrics.bootstrap import interval
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.consistency import RollError, SeamRatio, WarpingError
from lidar2pano.metrics.depth_error import DepthError
from lidar2pano.metrics.frechet import frechet_distance
from lidar2pano.metrics.inception import Inception
from lidar2pano.metrics.sliced_wasserstein import SlicedWasserstein
from lidar2pano.metrics.ssim import SSIM

SIZE = (376, 1241)  # rows and columns
WIDE = (1241, 376)  # as Pillow has it
Pairs = list[tuple[np.ndarray, np.ndarray]]


class Row(NamedTuple):
    """A metric, the other implementation, our values and the others."""

    metric: str
    witness: str
    ours: list[float]
    theirs: list[float]

    def text(self) -> str:
        ours, theirs = np.array(self.ours), np.array(self.theirs)
        off = np.abs(ours - theirs)
        relative = off.max() / np.abs(theirs).max()
        spread = f"{theirs.min():.4g} to {theirs.max():.4g}" if len(theirs) > 1 else f"{theirs[0]:.4g}"
        return f"| {self.metric} | {self.witness} | {len(theirs)} | {spread} | {off.max():.1e} | {relative:.1e} |"


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    keep_buffers()
    pairs = real(arguments.data, arguments.pairs) if arguments.data else made_up(arguments.pairs)
    head = [
        "| metric | compared with | values | range | largest difference | over the largest value |",
        "|---|---|---:|---|---:|---:|",
    ]
    table = "\n".join([*head, *(row.text() for row in rows(pairs))])
    print(table)
    if arguments.out:
        arguments.out.write_text(table + "\n", encoding="utf-8")


def rows(pairs: Pairs) -> Iterator[Row]:
    yield from similarity(pairs)
    yield from wasserstein(pairs)
    yield from frechet()
    yield from inception(pairs)
    yield from classes()
    yield depth()
    yield from over_time(pairs)
    yield bootstrap()


def made_up(number: int) -> Pairs:
    """Shapes of all sizes with noise, and the same darker, blurred and moved."""
    generator, found = np.random.default_rng(0), []
    for _ in range(number):
        layers = [
            Image.fromarray(generator.integers(0, 256, (size, 3 * size, 3), dtype=np.uint8)).resize(WIDE)
            for size in (2, 5, 12, 40, 120)
        ]
        target = np.clip(1.8 * np.mean([np.asarray(layer, float) for layer in layers], axis=0) - 100, 0, 255)
        predicted = np.roll(0.8 * target, 2, axis=1) + generator.normal(0, 12, target.shape)
        found.append((np.clip(predicted, 0, 255).astype(np.uint8), target.astype(np.uint8)))
    return found


def real(folder: Path, number: int) -> Pairs:
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in {".png", ".jpg", ".jpeg"})
    images: list[np.ndarray] = []
    for path in files:
        with Image.open(path) as image:
            if image.mode == "RGB" and len(images) < 2 * number:
                images.append(np.asarray(image.resize(WIDE)).copy())
    if len(images) < 2:
        raise SystemExit(f"{folder}: has no two colour images; name a folder of PNG or JPEG files")
    return list(zip(images[::2], images[1::2], strict=False))


def similarity(pairs: Pairs) -> Iterator[Row]:
    ours = []
    for pair in pairs:
        metric = SSIM()
        metric.update(*pair, "frame")
        ours.append(metric.compute())
    yield Row("SSIM", "scikit-image", ours, [definitions.scikit_ssim(*pair) for pair in pairs])
    inner, whole = zip(*(definitions.torchmetrics_ssim(*pair) for pair in pairs), strict=True)
    yield Row("SSIM", "torchmetrics, inner windows", ours, list(inner))
    yield Row("SSIM", "torchmetrics, mirrored borders too (another definition)", ours, list(whole))


def wasserstein(pairs: Pairs) -> Iterator[Row]:
    names = [str(number) for number in range(len(pairs))]
    predicted, target = (dict(zip(names, side, strict=True)) for side in zip(*pairs, strict=True))
    fewer = dict(list(target.items())[:-1])
    for what, side in (("equal sets", target), ("unequal sets", fewer)):
        if not side:
            continue
        metric = SlicedWasserstein()
        for which, images in (("predicted", predicted), ("target", side)):
            for name, image in images.items():
                metric.take(image, name, which)
        slow = definitions.swd_slowly(predicted, side)
        yield Row(f"SWD x 1000, {what}", "scipy, projection by projection", list(metric.values().values()),
                  list(slow.values()))  # fmt: skip


def frechet() -> Iterator[Row]:
    generator, sets = np.random.default_rng(0), []
    for count, size in ((200, 32), (400, 128), (1500, 512)):
        mixing = generator.normal(size=(size, size)) / size**0.5
        sets.append([np.maximum(generator.normal(0.2, s, (count, size)) @ mixing, 0) for s in (1, 1.3)])
    ours = [frechet_distance(*pair) for pair in sets]
    yield Row(
        "Frechet distance", "scipy.linalg.sqrtm", ours, [definitions.frechet_by_square_root(*pair) for pair in sets]
    )
    yield Row("Frechet distance", "torchmetrics", ours, [definitions.frechet_by_torchmetrics(*pair) for pair in sets])


def inception(pairs: Pairs) -> Iterator[Row]:
    """Features with random weights: the published ones are not needed to compare networks."""
    network = Inception().eval()
    weights = fill(network.state_dict(), 1.4)
    network.load_state_dict(weights)
    with tempfile.TemporaryDirectory() as folder:
        torch.save(weights, Path(folder) / "weights.pth")
        theirs = definitions.fidelity_inception(Path(folder) / "weights.pth")
    if theirs is None:
        return
    images = torch.stack([torch.from_numpy(image).movedim(2, 0) for image, _ in pairs])
    with torch.inference_mode():
        ours, (recorded,) = network(images), theirs(images)
    yield Row("Inception features, any weights", "torch-fidelity", ours.flatten().tolist(), recorded.flatten().tolist())


def classes() -> Iterator[Row]:
    from torchmetrics.functional.classification import multiclass_accuracy, multiclass_confusion_matrix

    generator = torch.Generator().manual_seed(0)
    target = torch.randint(15, (4, *SIZE), generator=generator)
    predicted = torch.where(
        torch.rand(target.shape, generator=generator) < 0.6,
        target,
        torch.randint(15, target.shape, generator=generator),
    )
    metric = MeanIoU(15, unscored=(0,))
    for number in range(4):
        metric.update(predicted[number], target[number], str(number))
    cells = multiclass_confusion_matrix(predicted, target, 15, ignore_index=0).double()
    iou = cells.diag() / (cells.sum(0) + cells.sum(1) - cells.diag())
    ours = metric.confusion().iou()[1:].tolist()
    yield Row(
        "IoU of 14 classes",
        "torchmetrics' counts",
        [*ours, metric.compute()],
        [*iou[1:].tolist(), float(iou[1:].mean())],
    )
    right = multiclass_accuracy(predicted, target, 15, average="micro", ignore_index=0)
    yield Row("accuracy", "torchmetrics", [metric.values()["accuracy"]], [float(right)])


def depth() -> Row:
    generator, metric, pairs = np.random.default_rng(0), DepthError(), []
    for number in range(3):
        target = generator.uniform(1, 80, (60, 200))
        pairs.append(
            (target * generator.uniform(0.6, 1.5, target.shape), target * (generator.random(target.shape) < 0.7))
        )
        predicted, true = pairs[-1]
        metric.update(predicted, true, str(number))
    slow = definitions.depth_slowly(*zip(*pairs, strict=True))
    return Row("AbsRel, RMSE, delta1", "one pixel at a time", list(metric.values().values()), list(slow.values()))


def over_time(pairs: Pairs) -> Iterator[Row]:
    generator, ours, slow = np.random.default_rng(0), [], []
    for circular in (False, True):
        before, now = (image[:60, :200] for image in pairs[0])
        flow, scored = generator.normal(0, 6, (2, 60, 200)), generator.random((60, 200)) < 0.8
        metric = WarpingError(circular=circular)
        metric.update(before, now, flow, "frame", valid=scored)
        ours.append(metric.compute())
        slow.append(definitions.warping_slowly(before, now, flow, scored, circular))
    yield Row("warping error", "one pixel at a time", ours, slow)
    seam, roll = SeamRatio(), RollError()
    seam.update(pairs[0][0][:60], "frame")
    yield Row("seam ratio", "one pixel at a time", [seam.compute()], [definitions.seam_slowly(pairs[0][0][:60])])
    answers = generator.normal(size=(2, 5, 40))
    roll.update(answers[0], answers[1], 7, "frame")
    by_hand = np.mean([abs(answers[1, i, (j + 7) % 40] - answers[0, i, j]) for i in range(5) for j in range(40)])
    yield Row("roll error", "one value at a time", [roll.compute()], [float(by_hand)])


def bootstrap() -> Row:
    values, metric = np.random.default_rng(1).exponential(size=60), RollError()
    for number, value in enumerate(values):
        metric.update(np.zeros(1), np.full(1, value), 0, f"{number:03d}")
    found = interval(metric, resamples=100_000)
    theirs = scipy.stats.bootstrap((values,), np.mean, method="percentile", n_resamples=100_000, rng=0)
    return Row("ends of the 95 % interval", "scipy.stats.bootstrap", [found.low, found.high],
               list(theirs.confidence_interval))  # fmt: skip


if __name__ == "__main__":
    main()
