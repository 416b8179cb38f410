"""Shows that training takes a data set of any size: peak memory and time to the first step, per family of recipes.

    python runs/any_size.py DATA [--frames 500,20000] [--families titan,sdnet] [--out docs/any_size.md]

DATA is kitti-mini. Data sets of so many frames are made of its frames by hard links in a temporary folder; then each
recipe trains a few steps of one sample with two loader workers. Memory is the sum of the processes' proportional set
sizes, sampled twice a second; time is from the start of the command to the end of the first step. A second table has
how many samples per second a core makes, of frames that are not in memory.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from lidar2pano.models.families import best_family, families

WEIGHTS = families()[best_family()]
SEGMENTER = f"options.segmenter={WEIGHTS / 'segmenter.safetensors'}"
FAMILIES: dict[str, tuple[str, ...]] = {  # recipe and what is set besides
    "segmenter": ("salsanext-mini", "data.train=train"),
    "titan": ("titan-mini",),
    "titan-pano": ("titan-pano-mini", SEGMENTER),
    "painter": (
        "latent-painter-mini",
        SEGMENTER,
        f"options.translator={WEIGHTS / 'translator.safetensors'}",
        f"networks.painter.start={WEIGHTS / 'painter.safetensors'}",
    ),
    "sdnet": ("sdnet-mini",),
    "scunet": ("scunet-mini",),
    "pix2pix": ("pix2pix-rgb-mini",),
    "vid2vid": ("vid2vid-mini", "data.train=drive", "data.val=drive"),
}
PARTS = {"velodyne": ".bin", "labels": ".label", "image_2": "", "camera_labels": ".png"}
STEPS, WORKERS = 2, 2
SET = ("training.accumulate=1", "training.batch=1", f"training.workers={WORKERS}")
LOADER_WORKERS, TARGET = 12, 40  # workers of a GPU's loader; batches of 4 a minute that it should get


def linked(source: Path, root: Path, frames: int) -> Path:
    """A data set at `root` whose splits train and drive have so many frames, hard links to those of `source`."""
    splits = json.loads((source / "splits.json").read_text())
    made: dict[str, list[str]] = {"val": []}
    for split in ("train", "drive"):
        names = [splits[split][number % len(splits[split])] for number in range(frames)]
        made[split] = sorted(_link(source, root, name, number) for number, name in enumerate(names))
    made["val"] = [_link(source, root, name, 10**6 + number) for number, name in enumerate(splits["val"])]
    (root / "splits.json").write_text(json.dumps(made))
    return root


def _link(source: Path, root: Path, name: str, number: int) -> str:
    sequence, stem = name.split("/")
    folder, target = source / "sequences" / sequence, root / "sequences" / sequence
    for part, suffix in PARTS.items():
        (target / part).mkdir(parents=True, exist_ok=True)
        for end in (suffix,) if suffix else (".png", ".jpg"):
            if (folder / part / f"{stem}{end}").is_file():
                os.link(folder.resolve() / part / f"{stem}{end}", target / part / f"{number:06d}{end}")
    if not (target / "calib.txt").exists():
        os.link(folder.resolve() / "calib.txt", target / "calib.txt")
    return f"{sequence}/{number:06d}"


def train(recipe: tuple[str, ...], root: Path, out: Path) -> list[float]:
    """Train a few steps in a process of its own: seconds and CPU seconds to the first step's end, peak in MiB."""
    begin, peak = time.time(), 0
    command = [sys.executable, __file__, str(root), "--recipe", *recipe, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        while child.poll() is None:
            peak = max(peak, sum(_pss(pid) for pid in _tree(child.pid)))
            time.sleep(0.5)
        assert child.stdout is not None and child.stderr is not None
        ended = child.stdout.read().split()
        if not ended:
            raise SystemExit(f"{recipe[0]}: {child.stderr.read()[-2000:]}")
    return [float(ended[-2]) - begin, float(ended[-1]), peak / 1024]


def _tree(pid: int) -> Iterator[int]:
    yield pid
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            yield from _tree(int(line))


def _pss(pid: int) -> int:
    """Proportional set size of a process, KiB: pages that processes share count once."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1])
    return 0


def few_steps(recipe: list[str], root: Path, out: Path) -> None:
    """Train STEPS steps, print when the first one ended, and leave."""
    from lidar2pano.train import engine
    from lidar2pano.train.recipe import override
    from lidar2pano.train.recipes import recipe_named

    chosen = recipe_named(recipe[0])
    for change in (*SET, *recipe[1:]):
        chosen = override(chosen, change)
    step, ends = engine.Run._step, []

    def timed(run: engine.Run, *batches: Iterator) -> None:
        step(run, *batches)
        ends.append(f"{time.time()} {time.process_time()}")
        if len(ends) == STEPS:
            print(ends[0], flush=True)
            time.sleep(1)  # for the one that measures memory
            os._exit(0)

    engine.Run._step = timed
    engine.train(chosen, root, out, device="cpu")


def rates(root: Path) -> dict[str, float]:
    """Samples per second and core of the data sets, by processor time, each of a frame that was not read before."""
    from lidar2pano.data import camera_pairs, clips, panorama_crops, range_images
    from lidar2pano.data.frames import SampleIndex
    from lidar2pano.train import camera_segmentation
    from lidar2pano.views import VIEWS

    splits, half = ("train",), VIEWS["panorama"].scaled(0.5)
    parts = camera_pairs.SampleParts(image=True, depth=True)
    crop = camera_segmentation.CameraSegmentationOptions(rows=320, columns=640)
    framing = clips.Framing(rows=128, columns=384, scale=0.5)
    sets = {
        "RangeImageDataset": range_images.RangeImageDataset(root, splits, VIEWS["hdl64e"], 1024),
        "PanoramaDataset": panorama_crops.PanoramaDataset(root, splits, half, 576),
        "FrontViewDataset": camera_pairs.FrontViewDataset(root, splits, VIEWS["titan-front"], (376, 1241), parts),
        "CameraProjectionDataset": camera_pairs.CameraProjectionDataset(root, splits, (376, 1241)),
        "CameraImageDataset": camera_segmentation.CameraImageDataset(root, splits, crop),
        "ClipDataset (6 frames)": clips.ClipDataset(root, ("drive",), framing, 6),
    }
    measurements = {}
    for name, samples in sets.items():
        samples[SampleIndex(0, 0)]
        begin = time.process_time()
        for number in range(1, 9):
            samples[SampleIndex(number * (len(samples) - 1) // 8, number)]
        measurements[name] = 8 / (time.process_time() - begin)
    return measurements


def main() -> None:
    """Read the arguments, measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames", default="500,20000")
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--recipe", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path("docs/any_size.md"))
    arguments = parser.parse_args()
    if arguments.recipe:
        few_steps(arguments.recipe, arguments.data, arguments.out)
        return
    sizes, families = [int(size) for size in arguments.frames.split(",")], arguments.families.split(",")
    measurements: dict[tuple[str, int], list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        roots = {size: linked(arguments.data, Path(folder) / f"data{size}", size) for size in sizes}
        speed = rates(roots[sizes[-1]])
        for family in families:
            for size, root in roots.items():
                measurements[family, size] = train(FAMILIES[family], root, Path(folder) / f"{family}{size}")
                arguments.out.write_text(tables(measurements, sizes, families, speed))


def tables(
    measurements: dict[tuple[str, int], list[float]], sizes: list[int], families: list[str], speed: dict[str, float]
) -> str:
    """The page: the runs that are `found` by family and number of frames, and samples per second by data set."""
    heads = [f"{unit}, {size:,} frames" for unit in ("first step (s)", "of it CPU (s)", "peak (MiB)") for size in sizes]
    lines = [
        "# A data set of any size",
        "",
        f"Written by `runs/any_size.py` from hard-linked copies of kitti-mini's frames, on {os.cpu_count()} CPU cores "
        f"with {os.getloadavg()[0]:.0f} running processes; {STEPS} steps of one sample, {WORKERS} loader workers.",
        "The time is from the start of the command to the end of the first step, imports, networks and the step itself",
        "included; of other processes' load the CPU time of the training process is independent.",
        "",
        f"| recipe | {' | '.join(heads)} |",
        f"|---|{'---|' * len(heads)}",
    ]
    for family in [family for family in families if (family, sizes[0]) in measurements]:
        runs = [measurements.get((family, size)) for size in sizes]
        cells = [f"{run[part]:.{1 - part // 2}f}" if run else "" for part in range(3) for run in runs]
        lines.append(f"| {FAMILIES[family][0]} | {' | '.join(cells)} |")
    lines += ["", f"| data set | samples a second and core | with {LOADER_WORKERS} workers, batches of 4 a minute |"]
    lines += ["|---|---|---|"]
    for name, rate in speed.items():
        lines.append(f"| {name} | {rate:.1f} | {rate * LOADER_WORKERS * 60 / 4:.0f} |")
    lines += ["", "titan-pano's segmenter labels all scans before the first step, once, which is most of its time."]
    lines += ["", f"A GPU takes some {TARGET} batches of 4 a minute. No frame was in memory before it was sampled."]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
