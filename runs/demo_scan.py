"""Make the scan that ships with the package: one frame of the street world, as an HDL-64E on a car's roof sees it.

    python runs/demo_scan.py [OUT] [--seed N] [--labels] [--ground-truth FOLDER]

OUT is a KITTI .bin (default: the one inside the package); --labels writes its SemanticKITTI .label beside it. Points
are rounded to millimetres. The frame is that of `lidar2pano world --place residential --seed N --frames 1`.
--ground-truth writes what the tests of the released weights compare with (tests/demo_ground_truth), instead of OUT:
point_labels.png (ids of SEMANTIC_KITTI, file order, rows of 1,024, 255 after the last), and at a quarter of the
panorama's raster image.jpg and segments.png (ids of COMMON15), at an eighth depth.png (16 bit, metres x 256, 0 = sky).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.formats.image_files import write_depth, write_ids
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.simulate.generation import SequenceWriter
from lidar2pano.simulate.scene.surfaces import COMMON15_IDS
from lidar2pano.simulate.settings import WorldSettings

SHIPPED = Path(__file__).resolve().parent.parent / "src" / "lidar2pano" / "demo" / "street.bin"
SEED = 12
ROW = 1024  # labels in a row of point_labels.png


def main() -> None:
    """Read the arguments and write the scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=SHIPPED)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--labels", action="store_true")
    parser.add_argument("--ground-truth", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    settings = WorldSettings(
        seed=arguments.seed, frames=1, place="residential", save=("panorama",), views=("panorama/4",)
    )
    writer = SequenceWriter(arguments.out.parent, settings, 0)
    if arguments.ground_truth:
        write_ground_truth(arguments.ground_truth, writer)
        return
    scan = writer.scan(0)
    points = scan.points.astype(np.float64)
    points[:, :3] = np.round(points[:, :3], 3)
    points.astype("<f4").tofile(arguments.out)
    if arguments.labels:
        label = (scan.instance.astype(np.uint32) << 16) | scan.raw
        label.astype("<u4").tofile(arguments.out.with_suffix(".label"))


def write_ground_truth(folder: Path, writer: SequenceWriter) -> None:
    """Write the ground truth of the first frame into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    labels = SEMANTIC_KITTI.from_raw(writer.scan(0).raw).astype(np.uint8)
    rows = np.full((-(-len(labels) // ROW), ROW), 255, np.uint8)
    rows.flat[: len(labels)] = labels
    ((_, panorama),) = writer.images(0)
    depth_m = np.where(np.isfinite(panorama.distance), panorama.distance, 0)
    write_ids(folder / "point_labels.png", rows)
    write_ids(folder / "segments.png", COMMON15_IDS[panorama.object_type])
    write_depth(folder / "depth.png", depth_m[::2, ::2])
    Image.fromarray(panorama.image).save(folder / "image.jpg", quality=85)


if __name__ == "__main__":
    main()
