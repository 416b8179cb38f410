"""NPY and NPZ: arrays of any names; pickled objects are refused, archives are unpacked within bounds."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import cloud_of_arrays
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import PointCloud

MAGIC, ZIP = b"\x93NUMPY", b"PK\x03\x04"
MOST_MEMBERS = 1000


def accepts_npy(head: bytes, path: Path) -> bool:
    """Whether a file begins like an NPY."""
    return head.startswith(MAGIC)


def accepts_npz(head: bytes, path: Path) -> bool:
    """Whether a file begins like a ZIP, in which an NPZ keeps its arrays."""
    return head.startswith((ZIP, b"PK\x05\x06"))


def decode_npy(data: bytes, path: Path) -> PointCloud:
    """The points of an array; InputError where it is damaged, pickled or no array of points."""
    array = _array(io.BytesIO(data), len(data), f"{path}")
    return cloud_of_arrays({"": array}, format="NPY", name=stem_of(path), source=str(path))


def decode_npz(data: bytes, path: Path) -> PointCloud:
    """The points of an archive; InputError where it is damaged, pickled or has no array of points."""
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [one for one in archive.infolist() if one.filename.endswith(".npy")]
            if len(members) > MOST_MEMBERS or sum(one.file_size for one in members) > MOST_BYTES:
                raise InputError(f"{path}: unpacks to more than {MOST_BYTES} bytes, which is no single scan; cut it")
            for one in members:
                name = one.filename.removesuffix(".npy")
                with archive.open(one) as file:
                    try:
                        arrays[name] = _array(io.BytesIO(file.read(one.file_size)), one.file_size, f"{path}: {name}")
                    except InputError as error:
                        if "pickled" not in str(error) or len(members) == 1:
                            raise
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be unpacked ({error}); it is damaged or cut off, fetch it again") from error
    except Exception as error:  # zlib.error and others of its decompressors
        raise InputError(f"{path}: cannot be unpacked ({error}); it is damaged, fetch it again") from error
    return cloud_of_arrays(arrays, format="NPZ", name=stem_of(path), source=str(path))


def _array(file: BinaryIO, length: int, source: str) -> np.ndarray:
    """The array of an NPY of `length` bytes; nothing in it is executed, nothing is allocated that it does not hold."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
    except Exception as error:  # a literal that is none raises many
        raise InputError(f"{source}: is no NPY ({str(error).splitlines()[0]}); it is damaged or cut off") from None
    if dtype.hasobject:
        raise InputError(f"{source}: is pickled, which could execute anything and is not read; save plain numbers")
    count, left = math.prod(shape), length - file.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != left:
        raise InputError(
            f"{source}: says {' x '.join(map(str, shape))} values of {dtype.itemsize} bytes, but {left} bytes follow;"
            " the file is damaged or truncated"
        )
    return np.frombuffer(file.read(), dtype, count).reshape(shape, order="F" if fortran else "C")
