"""Files of other kinds, known by their first bytes: what they are, and what to do with them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from lidar2pano.formats.delimited_text import CONTROL


class Foreign(NamedTuple):
    """A kind of file without a reader.

    name  as in "it is NAME";  advice: what to do instead.
    """

    name: str
    advice: str


UNPACK = "unpack it and name a scan of it, or its folder"
TAR = "unpack it (`tar -xf FILE`) and name a scan of it, or its folder"
OTHER_PACKING = "unpack it (gzip, bzip2, xz and zstd are read)"
POINTS = "export its points as PCD, PLY or LAS"
RECORDED = "convert its points to a ROS bag, an MCAP or PCDs"
NEWER = "write it in an older version, or install a newer lidar2pano"
DOWNLOAD, OTHER = "fetch the file itself", "name a scan"

# The first bytes of each kind as a pattern, long enough for no row of float32 to begin alike.
BYTES = {
    rb"\x04\x22\x4d\x18": Foreign("packed with lz4, which is not read", OTHER_PACKING),
    rb"\x1f\x9d\x90": Foreign("packed with compress, which is not read", OTHER_PACKING),
    rb"LZIP\x01": Foreign("packed with lzip, which is not read", OTHER_PACKING),
    rb"\x5d\0\0..\xff{8}": Foreign("packed with lzma, which is not read", OTHER_PACKING),
    rb"\xff\x06\0\0sNaPpY": Foreign("packed with snappy, which is not read", OTHER_PACKING),
    rb"\x1f\x8b\x08|\x28\xb5\x2f\xfd|BZh[1-9]1AY&SY|\xfd7zXZ\0": Foreign("packed twice", "unpack it once"),
    rb"7z\xbc\xaf\x27\x1c": Foreign("a 7z archive", UNPACK),
    rb"Rar!\x1a": Foreign("a RAR archive", UNPACK),
    rb".{257}ustar": Foreign("a tar archive", TAR),
    rb"!<arch>\n|xar!|MSCF\0": Foreign("an archive", UNPACK),
    rb"CCB2": Foreign("a BIN of CloudCompare", f"{POINTS} from CloudCompare"),
    rb"livox_tech": Foreign("an LVX of Livox Viewer", "export it as CSV or LAS from Livox Viewer"),
    rb"DRACO": Foreign("a point cloud packed by Draco", POINTS),
    rb"glTF": Foreign("a glTF scene", POINTS),
    rb"\x89HDF\r\n": Foreign("an HDF5 container", "save its points as NPY or NPZ"),
    rb"pnts|b3dm|cmpt|i3dm": Foreign("a tile of 3D Tiles", POINTS),
    rb"MATLAB [57]\.\d MAT-file": Foreign("a MAT-file of MATLAB", "write it there with pcwrite, or as CSV"),
    rb"\xd0\xcf\x11\xe0\xa1\xb1": Foreign("a project of another program", POINTS),
    rb"LASF.{20}(?:\x01[\x05-\xff]|[\x02-\xff])": Foreign("a LAS of a newer version than 1.4", NEWER),
    rb"\x89MCAP[^0]": Foreign("an MCAP of a newer version", NEWER),
    rb"#ROSBAG V(?!2\.0)": Foreign("a ROS bag of another version than 2.0", "convert it to version 2.0"),
    rb"\xed\xa1\xda\x01": Foreign("a log of LCM", RECORDED),
    rb"ULog\x01\x12\x35|\xa3\x95\x80\x80": Foreign("a log of a flight controller, without points", OTHER),
    rb"CARLA_RECORDER": Foreign("a log of CARLA", RECORDED),
    rb"IFHD|MDF     |TDSm": Foreign("a recording of another measuring system", RECORDED),
    rb"\x80[\x04\x05]\x95.{6}\0\0|\x80[\x02\x03][}\](cq]": Foreign(
        "a Python pickle, which can run programs", "save its points as NPY or PCD"
    ),
    rb"Obj\x01": Foreign("a table in Avro", "write it as Parquet or CSV"),
    rb"\x89PNG\r\n|\xff\xd8\xff[\xdb\xe0-\xef]|GIF8|BM.{4}\0{4}|II\*\0|MM\0\*|RIFF.{4}WEBP": Foreign(
        "a picture", OTHER
    ),
    rb"\x76\x2f\x31\x01|II\+\0|MM\0\+": Foreign("a picture", OTHER),
    rb".{4}ftyp|RIFF.{4}AVI |\x1aE\xdf\xa3": Foreign("a video", OTHER),
    rb"%PDF-": Foreign("a document", OTHER),
    rb"\x7fELF|MZ\x90\0": Foreign("a program", OTHER),
    rb"(?i:--[^\r\n]{1,200}\r?\ncontent-[a-z]+:)": Foreign("an upload's form around a file", "send the file alone"),
    rb"(?i:content-[a-z]+: |HTTP/[\d.]+ \d+)": Foreign("an answer of a server, with its header", DOWNLOAD),
}
ECHO = Foreign("a print of messages (`rostopic echo`, `ros2 topic echo`)", "name the recording they are of")
# Likewise of texts.
TEXTS = {
    rb"%time,field\.|(?:---\s*)?header: *\n +(?:seq|stamp):": ECHO,
    rb"rosbag2_bagfile_information:": Foreign("the description of a ROS 2 bag", "name its folder"),
    rb"\s*\{(?s:.*)\"(?:beam_altitude_angles|beam_intrinsics|lidar_mode)\"": Foreign(
        "the description of an Ouster sensor", "name the capture (.pcap) beside it"
    ),
    rb"calib_time:|(?:P0|P2|R0_rect|Tr_velo_to_cam|Tr): *[-+\d]": Foreign("a calibration", "name it with --calib"),
    rb"\$(?:G[PNLA]|P)[A-Z]{3},": Foreign("a log of a satellite receiver, without points", OTHER),
    rb"\s*0\s*\n *SECTION|AutoCAD Binary DXF": Foreign("a DXF drawing", POINTS),
    rb"version https://git-lfs": Foreign("a pointer of Git LFS, not the file", "run `git lfs pull`"),
    rb"[./]*(?:\.git)?/annex/objects/": Foreign("a pointer of git-annex, not the file", "run `git annex get`"),
    rb"(?i:\s*(?:<!--.*?-->\s*)?<(?:!doctype )?html)": Foreign("a web page, not the file", f"{DOWNLOAD}, logged in"),
    rb"\s*(?:<\?xml[^>]*>\s*)?<VTKFile|# vtk DataFile": Foreign("a VTK file", f"{POINTS}, e.g. from ParaView"),
    rb"\s*<\?xml|\s*<[a-zA-Z]": Foreign("XML", DOWNLOAD),
    rb"data:[\w/.+-]*;base64,|(?:[\w+/]{60,76}\r?\n){3}": Foreign("base64", "decode it first"),
    rb"\d+\s*\n\d+\s*\n(?:\S+ \S+ \S+\s*\n){4}(?:\S+ \S+ \S+ \S+\s*\n){4}": Foreign("a PTX of Leica", POINTS),
    rb"(?:ST|C|N)*OFF\s|solid |(?:#[^\n]*\n|mtllib[^\n]*\n|\s)*v -?\d": Foreign("a mesh (OFF, STL or OBJ)", POINTS),
    rb"\s*(?:\{|\[(?![\s\[]*[-+.\d][^\]\n]*\],?\s*\n))": Foreign("JSON", "write its points as CSV, PCD or NPY"),
    rb"%!PS|\{\\rtf|#!/": Foreign("a document or program", OTHER),
}
NAMED = {
    ".label": Foreign("labels of points", "name the scan in the folder velodyne beside it"),
    ".tfrecord": Foreign("a TFRecord, as of Waymo", f"{RECORDED}, e.g. with waymo-open-dataset"),
}
# And of ZIP archives, by the name of a member.
ARCHIVES = {
    r"\[Content_Types\]\.xml|mimetype": Foreign("a sheet or document of an office program", "save it as CSV"),
    r"(?:.*/)?data\.pkl": Foreign("a file of PyTorch, whose pickle can run programs", "save its points as NPY"),
    r"(?:.*/)?doc\.kml": Foreign("a KMZ of places", OTHER),
}
PATTERNS = {re.compile(pattern, re.DOTALL): kind for pattern, kind in BYTES.items()}
TEXT_PATTERNS = {re.compile(pattern, re.DOTALL): kind for pattern, kind in TEXTS.items()}


def foreign_kind(head: bytes, path: Path) -> Foreign | None:
    """Return the kind of a file without a reader, by its first bytes, or else its name; None for any other."""
    patterns = PATTERNS if CONTROL.search(head) else PATTERNS | TEXT_PATTERNS
    kinds = (kind for pattern, kind in patterns.items() if pattern.match(head))
    endings = (re.split(r"-\d+-of-\d+$", path.name.lower())[0]).split(".")[1:]
    return next(kinds, next((NAMED[f".{ending}"] for ending in endings if f".{ending}" in NAMED), None))


def archive_kind(members: Iterable[str]) -> Foreign | None:
    """Return the kind of a ZIP archive by the names of its members; None for any other."""
    members = list(members)
    kinds = (kind for pattern, kind in ARCHIVES.items() if any(re.fullmatch(pattern, name) for name in members))
    return next(kinds, None)
