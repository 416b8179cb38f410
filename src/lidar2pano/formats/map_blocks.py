"""Points of files of any length, a block at a time: maps need not fit into the memory."""

from __future__ import annotations

import io
import os
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.formats import delimited_text, e57, las, pcd, ply
from lidar2pano.formats.field_names import FIELDS, find_named
from lidar2pano.formats.file_contents import is_packed
from lidar2pano.formats.point_cloud import BLOCK_POINTS, PointCloud, RowLayout, cloud_of_columns
from lidar2pano.formats.readers import open_path

HEAD_BYTES = 1 << 16  # the longest header of a PLY or PCD
READ_POINTS = 1 << 21  # in one block at most, kept or not
KEPT_POINTS = 1 << 19  # in one block about
ROW_LAYOUTS = {"PLY": ply.row_layout, "PCD": pcd.row_layout}
Columns = Mapping[str, np.ndarray]


class Block(NamedTuple):
    """Some points of a file, those near to some place, and the extent of all points read for it.

    xyz        (N, 3) float64, as the file has them;  intensity: (N,) as stored, None if the file has none.
    low, high  (3,) float64 the bounds of the points read;  points: how many they are.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None
    low: np.ndarray
    high: np.ndarray
    points: int


class NearBlocks:
    """The points of a file within `reach_m` of any of the places (P, 3), one block after the other."""

    def __init__(self, path: Path, places: np.ndarray, reach_m: float) -> None:
        self._blocks, self._places, self._reach_m = map_blocks(path), places, reach_m

    def following(self) -> Block | None:
        """Return the next block; None at the end."""
        parts: list[tuple[np.ndarray, np.ndarray | None]] = []
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        count = kept = 0
        for cloud in self._blocks:
            xyz = np.asarray(cloud.xyz, np.float64)
            finite = xyz if np.isfinite(xyz).all() else xyz[np.isfinite(xyz).all(1)]
            if len(finite):
                low, high = np.minimum(low, finite.min(0)), np.maximum(high, finite.max(0))
            near = self._near(xyz)
            parts.append((xyz[near], None if cloud.intensity is None else cloud.intensity[near]))
            count, kept = count + len(xyz), kept + len(near)
            if count >= READ_POINTS or kept >= KEPT_POINTS:
                break
        if not parts:
            return None
        intensity = [part for _, part in parts if part is not None]
        whole = len(intensity) == len(parts)
        return Block(
            np.concatenate([xyz for xyz, _ in parts]), np.concatenate(intensity) if whole else None, low, high, count
        )

    def close(self) -> None:
        """Close the file."""
        self._blocks.close()

    def _near(self, xyz: np.ndarray) -> np.ndarray:
        """Return the indices of the points near to a place; those without coordinates are not."""
        near = np.zeros(len(xyz), bool)
        with np.errstate(invalid="ignore", over="ignore"):
            for place in self._places:
                offset = xyz - place
                near |= np.einsum("ij,ij->i", offset, offset) <= self._reach_m**2
        return np.flatnonzero(near)


def map_blocks(path: Path) -> Generator[PointCloud]:
    """Yield the points of a file in blocks: LAS, LAZ, E57, PLY and PCD; of another form all at once.

    Raises InputError as the readers of scans do; of other forms also for more points than a scan has.
    """
    reader = open_path(path)
    with io.BufferedReader(open_regular(path)) as file:
        blocks = _blocks(file, reader.name, path)
        if blocks is None:
            yield reader.cloud(path)
            return
        for columns in blocks:
            yield _cloud(columns, path)


def _blocks(file: BinaryIO, form: str, path: Path) -> Iterator[Columns] | None:
    """Return the fields of the points in blocks; None if the file must be read as a whole."""
    length, head = os.fstat(file.fileno()).st_size, file.read(HEAD_BYTES)
    if is_packed(head):
        return None
    if form == "LAS":
        file.seek(0)
        return las.blocks_of(file, length, path)
    if form == "E57":
        return e57.blocks_of(path)
    layout = ROW_LAYOUTS[form](head, path) if form in ROW_LAYOUTS else None
    if layout is None:
        return None
    file.seek(layout.start)
    return _lines(file, layout, path) if layout.text else _rows(file, layout, length, path)


def _lines(file: BinaryIO, layout: RowLayout, path: Path) -> Iterator[Columns]:
    """Yield the fields of lines of text."""
    starts, count = layout.starts, 0
    for table, _ in delimited_text.tables(file, path, starts[-1]):
        count += len(table)
        yield {name: table[:, starts[place]] for name, place in layout.columns.items()}
    layout.check_lines(count, path)


def _rows(file: BinaryIO, layout: RowLayout, length: int, path: Path) -> Iterator[Columns]:
    """Yield the fields of binary rows."""
    count = layout.binary_count(length, path)
    for start in range(0, count, BLOCK_POINTS):
        yield layout.fields(file.read(min(BLOCK_POINTS, count - start) * layout.dtype.itemsize))


def _cloud(columns: Columns, path: Path) -> PointCloud:
    """Return a block's points, without times, rings and further intensities."""
    unused = {key for names, words in FIELDS for key in find_named(columns, names, words)}
    unused -= set(find_named(columns, *FIELDS[0])[:1])  # of several the first, in all blocks
    return cloud_of_columns(
        {key: values for key, values in columns.items() if key not in unused}, format="map", name=path
    )
