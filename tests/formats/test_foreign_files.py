"""Files of other kinds are named by their first bytes, and no scan is taken for one."""

from __future__ import annotations

import gzip
import io
import pickle
import tarfile
import zipfile

import numpy as np
import pytest

import sample_files as made
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import plain_text
from lidar2pano.formats.foreign_files import foreign_kind
from lidar2pano.formats.readers import read


def tar() -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a.bin"))
    return buffer.getvalue()


def zipped(name: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, b"1234")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"ASTM-E57" + bytes(90), "is an E57"),
        (b"CCB2" + bytes(90), "is a BIN of CloudCompare"),
        (b"livox_tech" + bytes(90), "is an LVX of Livox Viewer"),
        (b"\x89HDF\r\n\x1a\n" + bytes(90), "is an HDF5 container"),
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(90),
            "is a MAT-file of MATLAB",
        ),
        (tar(), "is a tar archive"),
        (gzip.compress(tar(), mtime=0), "is a tar archive"),
        (pickle.dumps({"points": np.zeros(9)}, protocol=4), "is a Python pickle"),
        (gzip.compress(pickle.dumps([np.zeros(9)], protocol=5), mtime=0), "is a Python pickle"),
        (b"LASF" + bytes(20) + b"\x01\x05" + bytes(300), "is a LAS of a newer version"),
        (b"\x89MCAP1\r\n" + bytes(90), "is an MCAP of a newer version"),
        (b"#ROSBAG V1.2\n" + bytes(90), "is a ROS bag of another version"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "run `git lfs pull`"),
        (b"<!DOCTYPE html>\n<html><body>1 2 3</body></html>\n", "is a web page"),
        (b'{"points": [\n1 2 3\n]}', "is JSON"),
        (b'[{"x": 1.5, "y": 2}]\n', "is JSON"),
        (b"[[1, 2, 3], [4, 5, 6]]\n", "is JSON"),
        (b"# Blender\nv 1.0 2.0 3.0\nv 1 2 3\nf 1 2 3\n", "is a mesh"),
        (
            b'--abc\r\nContent-Disposition: form-data; name="f"; filename="a.bin"\r\n\r\n' + bytes(90),
            "an upload's form",
        ),
        (gzip.compress(gzip.compress(bytes(900), mtime=0), mtime=0), "is packed twice; unpack it once"),
        (b"QUJD" * 18 + b"\n" + b"QUJD" * 18 + b"\n" + b"QUJD" * 18 + b"\n", "is base64"),
        (b"2\n1\n" + b"0 0 0\n" * 4 + b"0 0 0 1\n" * 4 + b"1 2 3 0.5\n" * 2, "is a PTX"),
        (zipped("a.bin"), r"is a ZIP archive without arrays \(it has a.bin\); unpack it"),
        (b"\x89PNG\r\n\x1a\n" + bytes(90), "is a picture"),
        (b"\x76\x2f\x31\x01\x02\0\0\0" + bytes(90), "is a picture"),
        (b"%time,field.header.seq,field.data0\n1700,1,5\n", "is a print of messages .*; name the recording"),
        (b"header: \n  seq: 1\n  stamp: \n    secs: 1\ndata: [1, 2, 3]\n", "is a print of messages"),
        (b"header:\n  stamp:\n    sec: 1\n", "is a print of messages"),
        (b"rosbag2_bagfile_information:\n  version: 5\n", "is the description of a ROS 2 bag; name its folder"),
        (b'{"a": 1,\n "lidar_mode": "1024x10"}\n', "is the description of an Ouster sensor; name the capture"),
        (b"P0: 7.1e+02 0 0 0 0 1\n", "is a calibration; name it with --calib"),
        (b"$GPGGA,123519,4807.038,N,01131.000,E,1,08\n", "is a log of a satellite receiver"),
        (b"0\nSECTION\n2\nENTITIES\n", "is a DXF drawing"),
        (b"ULog\x01\x12\x35\x01" + bytes(90), "is a log of a flight controller"),
        (b"\xa3\x95\x80\x80\x59FMT" + bytes(90), "is a log of a flight controller"),
        (b"pnts\x01\0\0\0" + bytes(90), "is a tile of 3D Tiles"),
        (zipped("[Content_Types].xml"), "is a sheet or document of an office program; save it as CSV"),
        (zipped("mimetype"), "is a sheet or document"),
        (zipped("archive/data.pkl"), "is a file of PyTorch"),
    ],
)
@pytest.mark.parametrize("name", ["a.bin", "a.csv", "a"])
def test_it_is_named(tmp_path, content, says, name):
    path = made.write(tmp_path, name, content)
    with pytest.raises(InputError, match=says) as caught:
        read(path)
    assert str(path) in str(caught.value) and "damaged" not in str(caught.value)


def test_no_row_of_floats_begins_so():
    random = np.random.default_rng(0)
    data = random.normal(0, 30, 1 << 20).astype("<f4").tobytes()
    starts, path = range(0, len(data) - 400, 16), made.Path("a.bin")
    assert [start for start in starts if foreign_kind(data[start : start + 400], path)] == []


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("name", ["a.csv", "a.pcd", "a.ply"])
def test_marks_before_the_first_byte(tmp_path, encoding, name):
    text = {
        "a.csv": "x;y;z\n1,5;2;3\n4;5;6\n",
        "a.pcd": "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
        "1.5 2 3\n4 5 6\n",
        "a.ply": "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1.5 2 3\n4 5 6\n",
    }[name]
    path = made.write(tmp_path, name, text.encode(encoding))
    assert read(path).xyz.tolist() == [[1.5, 2, 3], [4, 5, 6]]


def test_other_bytes_stay_as_they_are():
    for data in (b"", b"\xff\xfe", bytes(100), np.arange(50, dtype="<f4").tobytes(), b"\xef\xbb\xbf\x41" * 30):
        assert plain_text(data) == data


@pytest.mark.parametrize("name", ["a.tfrecord", "a.tfrecord-00003-of-01000", "a.TFRecord.part"])
def test_records_of_tensorflow_are_named_by_their_files(tmp_path, name):
    with pytest.raises(InputError, match="is a TFRecord"):
        read(made.write(tmp_path, name, b"\x81\x12" + bytes(6) + b"\xaa\xbb\xcc\xdd" + bytes(90)))


def test_splats_are_no_scan(tmp_path):
    names = ("x", "y", "z", "f_dc_0", "opacity", "rot_0")
    header = "".join(f"property float {name}\n" for name in names)
    text = f"ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n1 2 3 4 5 6\n"
    with pytest.raises(InputError, match="holds Gaussian splats, a scene learned from photographs"):
        read(made.write(tmp_path, "a.ply", text.encode()))
