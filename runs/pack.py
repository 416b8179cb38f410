"""Pack splits of a data set into one small file, for a machine that gets tens of megabytes and has no network.

    python runs/pack.py pack ROOT FILE [--splits train,val,labelled]
    python runs/pack.py unpack FILE ROOT

FILE is a zip archive. Pictures, camera labels, calibrations and poses are in it as they are; a scan is kept to 1/128 m
and 1/200 of remission (an HDL-64E's own noise is 20 mm) and as differences between neighbours, which LZMA packs into a
sixth of the .bin. Unpacked, it is a data set like any other, in SemanticKITTI's layout.
"""

from __future__ import annotations

import argparse
import io
import json
from pathlib import Path
from zipfile import ZIP_LZMA, ZIP_STORED, ZipFile

import numpy as np

from lidar2pano.data.semantic_kitti import SemanticKittiFrame, frames
from lidar2pano.errors import InputError
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.scan import Scan

STEPS_PER_M, STEPS_OF_REMISSION = 128, 200
BESIDE = ("calib.txt", "poses.txt", "times.txt")  # of a sequence
IMAGE_FOLDERS = ("image_2", "camera_labels", "pano", "pano_labels", "pano_depth")


def packed(scan: Scan, label: np.ndarray | None) -> np.ndarray:
    """A scan as (8 or 12, N) uint8: bytes of the differences between one point and the next, low bytes first.

    label  (N,) uint32 values of a .label, or None. Raises InputError for points that are not within 256 m each way.
    """
    grid = np.rint(scan.xyz.T * STEPS_PER_M)
    if not (np.abs(grid) < 2**15).all():
        raise InputError(f"{scan.name}: has points beyond {2**15 // STEPS_PER_M} m or not finite; leave them out first")
    remission = np.rint(scan.remission * STEPS_OF_REMISSION).clip(0, 255)
    rows = [_bytes(np.diff(row, prepend=0).astype("<i2")) for row in (*grid, remission)]
    if label is not None:
        rows.append(_bytes(np.diff(label, prepend=np.uint32(0)).astype("<u4")))
    return np.concatenate(rows)


def unpacked(rows: np.ndarray) -> tuple[Scan, np.ndarray | None]:
    """What `packed` packed: the scan, and (N,) uint32 labels where it has them."""
    values = [_numbers(rows[2 * n : 2 * n + 2], "<i2") for n in range(4)]
    xyz = np.stack(values[:3], 1).astype(np.float32) / STEPS_PER_M
    scan = Scan(xyz=xyz, remission=values[3].astype(np.float32) / STEPS_OF_REMISSION)
    return scan, _numbers(rows[8:], "<u4") if len(rows) > 8 else None


def _bytes(differences: np.ndarray) -> np.ndarray:
    return differences.view(np.uint8).reshape(len(differences), -1).T


def _numbers(rows: np.ndarray, dtype: str) -> np.ndarray:
    return np.ascontiguousarray(rows.T).view(dtype)[:, 0].cumsum(dtype=dtype)  # wraps round, as differences did


def pack(root: Path, file: Path, splits: list[str]) -> None:
    """Write the archive."""
    frames_by_split = {split: frames(root, split) for split in splits}
    every = {frame.name: frame for split in splits for frame in frames_by_split[split]}
    with ZipFile(file, "w") as archive:
        listing = {split: frames_by_split[split].names for split in splits}
        archive.writestr("splits.json", json.dumps(listing, indent=1))
        for folder in sorted({frame.folder for frame in every.values()}):
            for name in BESIDE:
                _copy(archive, folder / name, root)
        for frame in every.values():
            _pack_frame(archive, frame, root)
    print(f"{file}: {len(every)} frames, {file.stat().st_size / 2**20:.1f} MiB")


def _pack_frame(archive: ZipFile, frame: SemanticKittiFrame, root: Path) -> None:
    scan, labels = frame.scan, frame.folder / "labels" / f"{frame.stem}.label"
    buffer = io.BytesIO()
    np.save(buffer, packed(scan, np.fromfile(labels, "<u4") if labels.is_file() else None))
    name = (frame.folder / "scans" / f"{frame.stem}.npy").relative_to(root).as_posix()
    archive.writestr(name, buffer.getvalue(), ZIP_LZMA)
    for folder in IMAGE_FOLDERS:
        for path in sorted((frame.folder / folder).glob(f"{frame.stem}.*")):
            _copy(archive, path, root)


def _copy(archive: ZipFile, path: Path, root: Path) -> None:
    if path.is_file():
        archive.write(path, path.relative_to(root).as_posix(), ZIP_STORED)


def unpack(file: Path, root: Path) -> None:
    """Write the data set."""
    with ZipFile(file) as archive:
        for name in archive.namelist():
            path = Path(archive.extract(name, root))  # never outside of root: zipfile sees to it
            if path.parent.name == "scans":
                scan, label = unpacked(np.load(path, allow_pickle=False))
                bins, labels = (path.parent.parent / folder for folder in ("velodyne", "labels"))
                bins.mkdir(exist_ok=True)
                write_bin(bins / f"{path.stem}.bin", scan)
                if label is not None:
                    labels.mkdir(exist_ok=True)
                    label.tofile(labels / f"{path.stem}.label")
                path.unlink()
    for folder in root.glob("sequences/*/scans"):
        folder.rmdir()


def main() -> None:
    """Read the arguments and pack or unpack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--splits", default="train,val,labelled")
    arguments = parser.parse_args()
    if arguments.what == "pack":
        pack(arguments.source, arguments.target, arguments.splits.split(","))
    else:
        unpack(arguments.source, arguments.target)


if __name__ == "__main__":
    main()
