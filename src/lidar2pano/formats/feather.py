"""Tables of Arrow: Feather, as Argoverse 2 keeps its sweeps, and Parquet; through pyarrow (extra `formats`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.field_names import meanings
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns, sweep_error

PARQUET = b"PAR1"
MOST_FOOTER_BYTES = 1 << 21  # of a Parquet: pyarrow makes thirty times as much of it
NUMBERS = ("INT32", "INT64", "FLOAT", "DOUBLE")  # types of a Parquet's columns


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points of its columns; the stamp is the file's name if in nanoseconds (Argoverse 2).

    Raises InputError if the file is damaged, or pyarrow is not installed.
    """
    with require_extra("formats", f"{path}:"):
        import pyarrow as pa
    kind = "Parquet" if data.startswith(PARQUET) else "Feather"
    columns: dict[str, list[np.ndarray]] = {}
    points = 0
    try:
        for batch in _parquet_batches(data, path) if kind == "Parquet" else _feather_batches(data):
            batch.validate()
            points += batch.num_rows
            if points > MOST_POINTS or batch.nbytes > MOST_BYTES:
                raise sweep_error(path, points)
            for field in batch.schema:
                if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
                    values = batch.column(field.name).to_numpy(zero_copy_only=False)
                    columns.setdefault(field.name, []).append(values)
    except (pa.ArrowException, MemoryError, OSError, ValueError, KeyError, IndexError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: is no {kind} that can be read ({reason}); it is damaged or cut off") from None
    if not columns:
        raise InputError(f"{path}: has no columns of numbers, one a point; write x, y, z and intensity as such")
    stem = stem_of(path)
    stamp_s = int(stem) * 1e-9 if stem.isdigit() and len(stem) == 18 else None
    whole: dict[str, np.ndarray] = {}
    for (name, factor), parts in zip(meanings(list(columns)), columns.values(), strict=True):
        values = np.concatenate(parts)
        whole.setdefault(name, values if factor == 1 else values * factor)
    return cloud_of_columns(whole, format=f"{kind} (Arrow)", name=path, stamp_s=stamp_s)


def _feather_batches(data: bytes) -> Iterator[Any]:
    import pyarrow as pa
    from pyarrow import ipc

    with ipc.open_file(pa.BufferReader(data)) as reader:
        yield from (reader.get_batch(number) for number in range(reader.num_record_batches))


def _parquet_batches(data: bytes, path: Path) -> Iterator[Any]:
    """Yield the numbers of a Parquet, structures of columns as columns; sizes are checked before they are unpacked."""
    import pyarrow as pa
    from pyarrow import parquet

    if (footer := int.from_bytes(data[-8:-4], "little")) > MOST_FOOTER_BYTES:
        raise InputError(f"{path}: describes itself in {footer} bytes, which is no single sweep; write it in one group")
    with parquet.ParquetFile(pa.BufferReader(data)) as file:
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        if file.metadata.num_rows > MOST_POINTS or sum(group.total_byte_size for group in groups) > MOST_BYTES:
            raise sweep_error(path, file.metadata.num_rows)
        leaves = [file.schema.column(number) for number in range(len(file.schema))]
        numbers = [leaf.path for leaf in leaves if leaf.physical_type in NUMBERS and not leaf.max_repetition_level]
        for batch in file.iter_batches(columns=numbers):
            yield from pa.Table.from_batches([batch]).flatten().to_batches()
