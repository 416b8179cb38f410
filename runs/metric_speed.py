"""Time of the image metrics SWD, SSIM and mIoU over pairs of 376 x 1241.

    OMP_NUM_THREADS=2 python runs/metric_speed.py [--pairs 500]

Images are random and in memory: reading files is not timed. The target is 60 s for 500 pairs on two cores.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from lidar2pano.hardware import keep_buffers
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.sliced_wasserstein import SlicedWasserstein
from lidar2pano.metrics.ssim import SSIM

SIZE = (376, 1241)
DIFFERENT = 10  # pairs in memory; they are used again under new names


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=500)
    pairs = parser.parse_args().pairs
    keep_buffers()  # as the command line does
    generator = np.random.default_rng(0)
    images = generator.integers(0, 256, (DIFFERENT, 2, *SIZE, 3), dtype=np.uint8)
    ids = generator.integers(0, 15, (DIFFERENT, 2, *SIZE), dtype=np.uint8)
    metrics = {"SWD": SlicedWasserstein(), "SSIM": SSIM(), "mIoU": MeanIoU(15, unscored=(0,))}
    taken = dict.fromkeys(metrics, 0.0)
    busy = time.process_time()
    for number in range(-1, pairs):  # the first is a warm-up
        for name, metric in metrics.items():
            given = (ids if name == "mIoU" else images)[number % DIFFERENT]
            begin = time.perf_counter()
            metric.update(*given, str(number))
            taken[name] += (time.perf_counter() - begin) * (number >= 0)
    print(f"{pairs} pairs of {SIZE[0]} x {SIZE[1]}, {torch.get_num_threads()} threads, torch {torch.__version__}\n")
    print("| metric | update, s | per pair, ms | compute, s | value |\n|---|---:|---:|---:|---:|")
    whole = 0.0
    for name, metric in metrics.items():
        begin = time.perf_counter()
        value = metric.compute()
        computing = time.perf_counter() - begin
        whole += taken[name] + computing
        milliseconds = taken[name] / pairs * 1e3
        print(f"| {name} | {taken[name]:.1f} | {milliseconds:.1f} | {computing:.1f} | {value:.4g} |")
    print(f"| **all** | **{whole:.1f}** | | | |")
    print(f"\n{time.process_time() - busy:.1f} s of CPU time")


if __name__ == "__main__":
    main()
