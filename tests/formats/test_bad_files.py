"""Damaged and hostile files: one line, nothing written, bounded memory and time, for every format."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import open_path

XYZ, RING = made.street(beams=8, columns=60)
INTENSITY = np.floor(made.remission(len(XYZ), 255))
FILES = made.every_format(XYZ, RING)
# Formats that do not say how many points they hold: cut between two points they are shorter scans.
COUNTLESS = {"kitti.bin", "nuscenes.pcd.bin", "header.csv", "numbers.csv", "plain.xyz"}
PLACES = 50
XZ = lzma.compress(b"a" * 100)
XZ_HEADER = XZ[12:16] + b"\x28" + XZ[17:20]  # of a block whose dictionary has 4 GiB
XZ_OF_GIGABYTES = XZ[:12] + XZ_HEADER + struct.pack("<I", zlib.crc32(XZ_HEADER)) + XZ[24:]


def points(path: Path) -> int | str:
    """How many points a file has, or the line that says why it has none."""
    try:
        return len(open_path(path).cloud(path))
    except InputError as error:
        assert "\n" not in str(error) and str(error).startswith(f"{path}"), str(error)
        return str(error)


@pytest.mark.parametrize("name", FILES)
def test_every_truncation_is_one_line(tmp_path, name):
    content = FILES[name]
    for cut in np.linspace(0, len(content) - 1, PLACES).astype(int):
        found = points(made.write(tmp_path, name, content[:cut]))
        if name in COUNTLESS and isinstance(found, int):
            assert found <= len(XYZ) * cut / len(content) + 1
        elif name == "argoverse.feather" or "las" in name or "laz" in name:
            assert isinstance(found, str) or cut > len(content) - 600, cut  # what follows the points may be missing
        else:
            assert isinstance(found, str) or cut > len(content) - 4, (cut, found)  # a number cut within its digits


@pytest.mark.parametrize("name", FILES)
def test_flipped_bytes_never_raise_anything_else(tmp_path, name):
    generator = np.random.default_rng(5)
    for _ in range(30):
        content = bytearray(FILES[name])
        for place in generator.integers(0, min(len(content), 400), 3):
            content[place] ^= int(generator.integers(1, 256))
        points(made.write(tmp_path, name, bytes(content)))


def bombs() -> dict[str, tuple[bytes, str]]:
    """Name -> content, and a part of the line that answers it."""
    pcd, ply = made.pcd(XYZ, INTENSITY), made.ply(XYZ, INTENSITY)
    count, more, bomb = f"{len(XYZ)}".encode(), f"{len(XYZ) + 1}".encode(), b"1000000000000"
    packed = made.pcd(XYZ, INTENSITY, "binary_compressed")
    start = packed.index(b"binary_compressed\n") + 18
    huge = packed[:start] + struct.pack("<II", len(packed) - start - 8, 0xFFFFFFF0) + packed[start + 8 :]
    array = made.npy(np.zeros((8, 4)))
    header = np.lib.format.header_data_from_array_1_0(np.zeros((8, 4)))
    claimed = io.BytesIO()
    np.lib.format.write_array_header_1_0(claimed, header | {"shape": (10**12, 4)})
    zeros = io.BytesIO()
    with zipfile.ZipFile(zeros, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("a.npy", claimed.getvalue() + bytes(260 << 20))
    laz, las = bytearray(FILES["packed.laz"]), bytearray(FILES["plain.las"])
    laz[107:111] = las[107:111] = struct.pack("<I", 0xFFFFFFFF)
    few = bytearray(FILES["packed.laz"])
    few[107:111] = struct.pack("<I", 10_000_000)
    return {
        "pcd count.pcd": (pcd.replace(count, bomb), "are no single sweep"),
        "pcd one more.pcd": (pcd.replace(count, more), "the file is truncated"),
        "pcd one less.pcd": (pcd.replace(count, f"{len(XYZ) - 9}".encode()), "but more follow"),
        "pcd product.pcd": (pcd.replace(count, more).replace(b"HEIGHT 1", b"HEIGHT 7"), "its header says"),
        "pcd negative.pcd": (pcd.replace(count, b"-5"), "are no single sweep"),
        "pcd count of a field.pcd": (pcd.replace(b"COUNT 1 1 1 1 2", b"COUNT 1 1 1 1 99999999"), "makes no sense"),
        "pcd form.pcd": (pcd.replace(b"DATA binary", b"DATA zipped"), "of form 'zipped'"),
        "pcd lzf.pcd": (huge, "do not unpack from"),
        "ply count.ply": (ply.replace(count, bomb), "are no single sweep"),
        "ply one more.ply": (ply.replace(count, more), "the file is damaged or truncated"),
        "ply one less.ply": (ply.replace(count, f"{len(XYZ) - 9}".encode()), "the file is damaged or truncated"),
        "ply form.ply": (ply.replace(b"binary_little_endian", b"binary_middle_endian"), "of form"),
        "txt count.txt": (FILES["count.txt"].replace(count + b"\n", bomb + b"\n", 1), "its first line says"),
        "txt words.txt": (b"x y z\nlorem ipsum dolor\n" * 500, "are no numbers"),
        "txt short line.txt": (b"1 2 3 4\n" * 90 + b"1 2 3\n", "point 91 has 3 values instead of 4"),
        "npy count.npy": (claimed.getvalue() + bytes(256), "says 1000000000000 x 4 values"),
        "npy pickled.npy": (made.npy(np.array([{"a": 1}], dtype=object)), "is pickled"),
        "npy header.npy": (array[:10] + b"(" * 60 + array[70:], "is no NPY"),
        "npy shape.npy": (made.npy(np.zeros((5, 2))), "has no array of points"),
        "npz pickled.npz": (made.npz(a=np.array([print], dtype=object)), "is pickled"),
        "npz zeros.npz": (zeros.getvalue(), "unpacks to more than"),
        "npz empty.npz": (made.npz(), "is a ZIP archive without arrays"),
        "laz count.laz": (bytes(laz), "are no single sweep"),
        "las count.las": (bytes(las), "are no single sweep"),
        "laz many.laz": (bytes(few), "is no LAS that can be read"),
        "gzip.bin.gz": (gzip.compress(bytes(1 << 24)) * 17, "unpacks to more than"),
        "zstd.bin.zst": (made.zstd(bytes(1 << 24)) * 17, "unpacks to more than"),
        "bzip2.bin.bz2": (bz2.compress(bytes(1 << 24)) * 17, "unpacks to more than"),
        "xz.bin.xz": (lzma.compress(bytes(1 << 24)) * 17, "unpacks to more than"),
        "damaged.bin.bz2": (b"BZh91AY&SY" + bytes(90), "it is damaged or cut off"),
        "dictionary.bin.xz": (XZ_OF_GIGABYTES, "Memory usage limit exceeded"),
        "packed.bin.lz4": (b"\x04\x22\x4d\x18" + bytes(90), "is packed with lz4, which is not read; unpack it"),
        "empty.bin": (b"", "is empty"),
        "empty.pcd": (b"", "is empty"),
        "nothing.gz": (gzip.compress(b""), "is empty"),
        "zeros.dat": (bytes(5000), "is of no format"),
    }


SCRIPT = """
import json, resource, sys, time
from pathlib import Path
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import interpreted
for path in sorted(Path(sys.argv[1]).iterdir()):
    start = time.process_time()
    try:
        said = str([len(interpreted(path)[0])])
    except InputError as error:
        said = str(error)
    print(json.dumps([path.name, said, time.process_time() - start]))
# Not ru_maxrss, which a process inherits from the one that started it.
(most,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(json.dumps(["most", "", int(most) / 1024]))
"""


def test_bombs_are_one_line_in_little_memory_and_time(tmp_path):
    expected = bombs()
    for name, (content, _) in expected.items():
        made.write(tmp_path, name, content)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    wrong = [
        line for line in lines[:-1] if expected[line[0]][1] not in line[1] or "\n" in line[1] or line[1].startswith("[")
    ]
    assert wrong == [] and len(lines) == len(expected) + 1
    assert [line for line in lines[:-1] if line[2] > 5] == []
    assert lines[-1][2] < 1024, "MiB"


class Trap:
    """Would write a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_nothing_pickled_is_executed(tmp_path, ending):
    trap = np.array([Trap(tmp_path / "caught")], dtype=object)
    path = made.write(tmp_path, f"a.{ending}", made.npy(trap) if ending == "npy" else made.npz(points=trap))
    assert "is pickled" in str(points(path)) and not (tmp_path / "caught").exists()
    assert pickle.dumps(trap)


@pytest.mark.parametrize("command", ["translate {} --out {} --device cpu", "inspect {}"])
@pytest.mark.parametrize(
    "name", ["binary.pcd", "little.ply", "plain.npy", "named.npz", "packed.laz", "argoverse.feather"]
)
def test_the_command_line_says_one_line(tmp_path, capsys, command, name):
    path = made.write(tmp_path, name, FILES[name][: len(FILES[name]) // 2])
    out = tmp_path / "out"
    assert main(command.format(path, out).split()) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"lidar2pano: {path}: ") and said.err.count("\n") == 1
    assert said.out == "" and not out.exists()


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("packed.laz", "laspy", "formats"),
        ("argoverse.feather", "pyarrow", "formats"),
        ("packed.bin.zst", "zstandard", "formats"),
    ],
)
def test_a_missing_extra_is_named(tmp_path, monkeypatch, name, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    path = made.write(tmp_path, name, FILES[name])
    assert points(path) == f"{path}: needs the extra {extra!r}: pip install 'lidar2pano[{extra}]'"
