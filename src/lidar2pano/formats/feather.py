"""Feather (Arrow IPC), as Argoverse 2 keeps its sweeps; through pyarrow (extra `formats`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points of its columns; the stamp is the file's name if in nanoseconds (Argoverse 2).

    Raises InputError if the file is damaged, or pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import ipc
    except ModuleNotFoundError:
        raise InputError(f"{path}: needs the extra 'formats': pip install 'lidar2pano[formats]'") from None
    try:
        with ipc.open_file(pa.BufferReader(data)) as reader:
            fields = [
                field for field in reader.schema if pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
            ]
            columns: dict[str, list[np.ndarray]] = {field.name: [] for field in fields}
            points = 0
            for number in range(reader.num_record_batches):
                batch = reader.get_batch(number)
                batch.validate()
                points += batch.num_rows
                if points > MOST_POINTS or batch.nbytes > MOST_BYTES:
                    raise InputError(f"{path}: {points} points are no single sweep (at most {MOST_POINTS}); cut it")
                for name, parts in columns.items():
                    parts.append(batch.column(name).to_numpy(zero_copy_only=False))
    except (pa.ArrowException, MemoryError, OSError, ValueError, KeyError, IndexError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: is no Feather that can be read ({reason}); it is damaged or cut off") from None
    stem = stem_of(path)
    stamp_s = int(stem) * 1e-9 if stem.isdigit() and len(stem) == 18 else None
    whole = {name: np.concatenate(parts) if parts else np.empty(0) for name, parts in columns.items()}
    return cloud_of_columns(whole, format="Feather (Arrow)", name=stem, source=str(path), stamp_s=stamp_s)
