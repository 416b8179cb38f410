"""Small scan files of every format, and a street that a spinning LiDAR has measured."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

LZF_LITERALS = 32  # bytes that one packet of LZF holds at most


def street(
    beams: int = 32, columns: int = 360, height_m: float = 1.8, lowest_deg: float = -25.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 between two walls, on a road, hidden by a car's body of 5 x 2 m; their beams (N,)."""
    elevation = np.radians(np.linspace(lowest_deg, 10, beams))[:, None]
    azimuth = np.radians(np.linspace(-179.5, 179.5, columns))[None]
    ray = np.stack(np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                                       np.sin(elevation)), -1)  # fmt: skip
    with np.errstate(divide="ignore"):
        ground = np.where(ray[..., 2] < 0, -height_m / ray[..., 2], np.inf)
        walls = np.minimum(9 / np.abs(ray[..., 1]), 60 / np.abs(ray[..., 0]))
    range_m = np.minimum(ground, walls)
    xyz = ray * range_m[..., None]
    hidden = (np.abs(xyz[..., 0]) < 5.5) & (np.abs(xyz[..., 1]) < 2.5) & (ground < walls)
    ring = np.broadcast_to(np.arange(beams)[:, None], hidden.shape)
    return xyz[~hidden].astype(np.float32), ring[~hidden].astype(np.int64)


def remission(points: int, full: float = 1.0) -> np.ndarray:
    """(N,) float32, the same for every call."""
    return (np.random.default_rng(3).random(points) ** 3 * full).astype(np.float32)


def pcd(xyz: np.ndarray, intensity: np.ndarray, layout: str = "binary", first: str = "# .PCD v0.7\n") -> bytes:
    """A PCD with x y z intensity, a field of padding and a ring of two bytes."""
    dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("_", "u1", 2), ("ring", "<u2")])
    rows = np.zeros(len(xyz), dtype)
    for column, name in enumerate("xyz"):
        rows[name] = xyz[:, column]
    rows["intensity"], rows["ring"] = intensity, np.arange(len(xyz)) % 16
    header = (
        f"{first}VERSION 0.7\nFIELDS x y z intensity _ ring\nSIZE 4 4 4 4 1 2\nTYPE F F F F U U\nCOUNT 1 1 1 1 2 1\n"
        f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA {layout}\n"
    ).encode()
    if layout == "ascii":
        lines = (" ".join([*(repr(float(row[name])) for name in ("x", "y", "z", "intensity")), "0 0", str(row["ring"])])
                 for row in rows)  # fmt: skip
        return header + "\n".join(lines).encode() + b"\n"
    if layout == "binary":
        return header + rows.tobytes()
    flat = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in dtype.names or ())
    packed = lzf(flat)
    return header + np.array([len(packed), len(flat)], "<u4").tobytes() + packed


def lzf(data: bytes) -> bytes:
    """LZF of literals, with one back reference where the first 40 bytes repeat."""
    packets = bytearray()
    for start in range(0, len(data), LZF_LITERALS):
        piece = data[start : start + LZF_LITERALS]
        packets += bytes([len(piece) - 1]) + piece
    return bytes(packets)


def ply(xyz: np.ndarray, intensity: np.ndarray, layout: str = "binary_little_endian") -> bytes:
    """A PLY with x y z and CloudCompare's scalar_intensity."""
    header = (
        f"ply\nformat {layout} 1.0\ncomment made up\nelement vertex {len(xyz)}\nproperty float x\nproperty float y\n"
        "property float z\nproperty float scalar_intensity\nend_header\n"
    ).encode()
    table = np.column_stack([xyz, intensity]).astype("<f4" if layout == "binary_little_endian" else ">f4")
    if layout == "ascii":
        return header + "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in table).encode()
    return header + table.tobytes()


def text(xyz: np.ndarray, intensity: np.ndarray, separator: str = " ", header: str = "") -> bytes:
    """Lines of x y z intensity below a header."""
    lines = (
        separator.join(repr(float(value)) for value in (*row, one)) for row, one in zip(xyz, intensity, strict=True)
    )
    return (header + "\n".join(lines) + "\n").encode()


def npy(array: np.ndarray) -> bytes:
    """An NPY."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    """A packed NPZ."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def las(xyz: np.ndarray, intensity: np.ndarray, packed: bool = True) -> bytes:
    """A LAS or LAZ with steps of a millimetre."""
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
    record = laspy.LasData(header)
    record.xyz = xyz.astype(np.float64)
    record.intensity = intensity.astype(np.uint16)
    file = io.BytesIO()
    record.write(file, do_compress=packed, laz_backend=laspy.LazBackend.Lazrs)
    return file.getvalue()


def feather(xyz: np.ndarray, intensity: np.ndarray) -> bytes:
    """A Feather like those of Argoverse 2, packed with LZ4."""
    import pyarrow as pa
    from pyarrow.feather import write_feather

    columns = {name: xyz[:, column].astype(np.float16) for column, name in enumerate("xyz")}
    columns |= {"intensity": intensity.astype(np.uint8), "offset_ns": np.arange(len(xyz), dtype=np.int32) * 1000}
    file = io.BytesIO()
    write_feather(pa.table(columns), file, compression="lz4")
    return file.getvalue()


def parquet(xyz: np.ndarray, intensity: np.ndarray) -> bytes:
    """A Parquet of two row groups, whose axes are fields of a structure."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    place = pa.StructArray.from_arrays([pa.array(xyz[:, axis], pa.float32()) for axis in range(3)], names=list("xyz"))
    file = io.BytesIO()
    columns = {"frame": ["a"] * len(xyz), "position": place, "intensity": intensity.astype(np.uint8)}
    write_table(pa.table(columns), file, row_group_size=len(xyz) // 2 + 1)
    return file.getvalue()


def rows(*columns: np.ndarray) -> bytes:
    """Rows of float32 without a header."""
    return np.column_stack(columns).astype("<f4").tobytes()


def zstd(data: bytes) -> bytes:
    """Packed with zstd."""
    from zstandard import ZstdCompressor

    return ZstdCompressor().compress(data)


def every_format(xyz: np.ndarray, ring: np.ndarray) -> dict[str, bytes]:
    """File name -> content: the same points in every format that is read; remission 0 to 255."""
    intensity = np.floor(remission(len(xyz), 255))
    table = np.column_stack([xyz, intensity])
    makers: dict[str, Callable[[], bytes]] = {
        "kitti.bin": lambda: rows(xyz, intensity),
        "nuscenes.pcd.bin": lambda: rows(xyz, intensity, ring),
        "packed.bin.gz": lambda: gzip.compress(rows(xyz, intensity), mtime=0),
        "packed.bin.zst": lambda: zstd(rows(xyz, intensity)),
        "ascii.pcd": lambda: pcd(xyz, intensity, "ascii"),
        "binary.pcd": lambda: pcd(xyz, intensity),
        "compressed.pcd": lambda: pcd(xyz, intensity, "binary_compressed", first=""),
        "ascii.ply": lambda: ply(xyz, intensity, "ascii"),
        "little.ply": lambda: ply(xyz, intensity),
        "big.ply": lambda: ply(xyz, intensity, "binary_big_endian"),
        "plain.npy": lambda: npy(table),
        "named.npz": lambda: npz(anything=table),
        "header.csv": lambda: text(xyz, intensity, ",", "X,Y,Z,Intensity\n"),
        "numbers.csv": lambda: text(xyz, intensity, ","),
        "count.txt": lambda: text(xyz, intensity, " ", f"{len(xyz)}\n"),
        "plain.xyz": lambda: text(xyz, intensity, " "),
        "packed.laz": lambda: las(xyz, intensity),
        "plain.las": lambda: las(xyz, intensity, packed=False),
        "argoverse.feather": lambda: feather(xyz, intensity),
        "points.parquet": lambda: parquet(xyz, intensity),
    }
    return {name: make() for name, make in makers.items()}


def write(folder: Path, name: str, content: bytes) -> Path:
    """A file of that content."""
    path = folder / name
    path.write_bytes(content)
    return path
