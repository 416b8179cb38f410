"""What strangers send costs little: the inputs of a review, tried in processes of their own, with memory and seconds.

A process without torch takes some 70 MiB; what is refused may take LIMIT_MIB beside that, however it is packed.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import pickle
import resource
import shutil
import signal
import sqlite3
import stat
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image

import sample_files
from lidar2pano.child_process import AnswerUnpickler, Bound, ChildProcess, _data_bytes
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import read_image, write_whole
from lidar2pano.formats.readers import read
from lidar2pano.recordings import reading_process
from random_weights import street, write_scan

LIMIT_MIB, BASE_MIB, LIMIT_S = 256, 80, 10
ZEROS = bytes(1 << 24)
SCHEMA = """
CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT); INSERT INTO schema VALUES(4, 'humble');
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,
  offered_qos_profiles TEXT, type_description_hash TEXT);
INSERT INTO topics VALUES(1, '/p', 'sensor_msgs/msg/PointCloud2', 'cdr', '', '');
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
INSERT INTO messages VALUES(1, 1, 5, x'00');
"""
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT"


class Cost(NamedTuple):
    """The end of a process: its exit code, what it said, and the processor time and memory of it and its children."""

    code: int
    error: str
    seconds: float
    mib: float


def cost(*words: str, python: str = "from lidar2pano.cli import main; import sys; sys.exit(main())") -> Cost:
    """Run a command, in a process that reports on its children alone."""
    watch = (
        "import json, resource, subprocess, sys;"
        "done = subprocess.run(sys.argv[1:], capture_output=True, text=True);"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(json.dumps([done.returncode, done.stderr, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]))"
    )
    command = [sys.executable, "-c", watch, sys.executable, "-c", python, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    return Cost(*json.loads(done.stdout))


def npy(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def archive(method: int, name: str, points: bytes, data: bytes) -> bytes:
    """An archive whose only member says that it has these points, and unpacks to more."""
    check = zlib.crc32(points)
    sizes = struct.pack("<III", check, len(data), len(points))
    local = struct.pack("<4s5H", b"PK\3\4", 63, 0, method, 0, 33) + sizes + struct.pack("<HH", len(name), 0)
    local += name.encode()
    entry = struct.pack("<4s6H", b"PK\1\2", 63, 63, 0, method, 0, 33) + sizes
    entry += struct.pack("<5HII", len(name), 0, 0, 0, 0, 0, 0) + name.encode()
    end = struct.pack("<4s4HIIH", b"PK\5\6", 0, 0, 1, 1, len(entry), len(local) + len(data), 0)
    return local + data + entry + end


TEN = npy(np.ones((10, 4), np.float32))


def bzip2_archive() -> bytes:
    """Ten points that unpack to half a GiB, more than the memory that may be taken."""
    import bz2

    packer = bz2.BZ2Compressor()
    parts = [packer.compress(TEN), *(packer.compress(ZEROS) for _ in range(32)), packer.flush()]
    return archive(zipfile.ZIP_BZIP2, "points.npy", TEN, b"".join(parts))


def deflated_archive() -> bytes:
    """Ten points that unpack to 2.5 GiB: one block of zeros, again and again."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    begin = packer.compress(TEN) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(ZEROS) + packer.flush(zlib.Z_FULL_FLUSH)
    return archive(zipfile.ZIP_DEFLATED, "points.npy", TEN, begin + 160 * block + packer.flush())


def wide_archive() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("points.npy", npy(np.zeros((15_000_000, 4), np.float32)))
    return data.getvalue()


def database(statement: str) -> bytes:
    connection = sqlite3.connect(":memory:")
    connection.executescript(SCHEMA + statement)
    data = connection.serialize()
    connection.close()
    return data


def endless_definitions() -> bytes:
    columns = "x AS id, 'a' AS topic_type, 'b' AS encoding, 'c' AS encoded_message_definition"
    return database(f"CREATE VIEW message_definitions AS {ENDLESS} {columns}, 'd' AS type_description_hash FROM c")


def endless_messages() -> bytes:
    return database(
        "DROP TABLE messages; CREATE TABLE message_definitions(id INTEGER, topic_type TEXT, encoding TEXT,"
        f" encoded_message_definition TEXT, type_description_hash TEXT); CREATE VIEW messages AS {ENDLESS}"
        " x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM c"
    )


def lines(text: bytes) -> Callable[[], bytes]:
    return lambda: gzip.compress(text, 1)


def many_topics() -> bytes:
    return database(
        "CREATE TABLE message_definitions(id INTEGER, topic_type TEXT, encoding TEXT, encoded_message_definition TEXT,"
        " type_description_hash TEXT); INSERT INTO topics WITH RECURSIVE c(x) AS (SELECT 2 UNION ALL SELECT x + 1"
        " FROM c WHERE x < 12000) SELECT x, '/t' || x, 'std_msgs/msg/String', 'cdr', '', '' FROM c"
    )


def wide_parquet() -> bytes:
    """A table whose description of itself takes most of it."""
    import pyarrow as pa
    from pyarrow import parquet

    data = io.BytesIO()
    parquet.write_table(pa.table({f"c{number}": [0.0] for number in range(15_000)}), data)
    return data.getvalue()


def laz() -> bytes:
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    cloud = laspy.LasData(header)
    cloud.x = cloud.y = cloud.z = np.zeros(8_000_000)
    data = io.BytesIO()
    cloud.write(data, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    return data.getvalue()


def feather() -> bytes:
    import pyarrow as pa
    from pyarrow import feather as writer

    data = io.BytesIO()
    table = pa.table({name: np.zeros(12_000_000) for name in ("x", "y", "z", "a", "b", "c")})
    writer.write_feather(table, data, compression="zstd")
    return data.getvalue()


def mcap_of_small_records() -> bytes:
    """A chunk of 200 MiB that holds 20 million empty records."""
    import zstandard

    body = b"\x0f" + struct.pack("<Q", 4) + bytes(4)
    packed_body = zstandard.compress(body * 16_000_000)
    chunk = struct.pack("<QQQI", 0, 0, len(body) * 16_000_000, 0) + struct.pack("<I", 4) + b"zstd"
    chunk += struct.pack("<Q", len(packed_body)) + packed_body
    start = b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 8) + bytes(8)
    return start + b"\x06" + struct.pack("<Q", len(chunk)) + chunk + b"\x89MCAP0\r\n"


HOSTILE: dict[str, Callable[[], bytes]] = {
    "bzip2.npz": bzip2_archive,
    "wide.npz": wide_archive,
    "rows.txt.gz": lines(b"1 2 3\n" * 9_000_000 + b"1 2\n"),
    "comments.txt.gz": lines(b"x y z\n" + b"#\n" * 20_000_000),
    "cells.csv.gz": lines(b"x,y,z\n" + b"1,2,\n" * 9_000_000),
    "one-line.txt.gz": lines(b"1 2 3\n" + b"1 " * 50_000_000),
    "faces.ply.gz": lines(
        b"ply\nformat ascii 1.0\nelement vertex 9000000\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n" + b"1 2 3\n" * 9_000_000
    ),
    "zeros.bin.gz": lambda: gzip.compress(bytes(1 << 30), 1),
    "members.bin.gz": lambda: gzip.compress(b"", 9) * 400_000,
    "definitions.db3": endless_definitions,
    "topics.db3": many_topics,
    "messages.db3": endless_messages,
    "packed.laz": laz,
    "packed.feather": feather,
    "wide.parquet": wide_parquet,
    "records.mcap": mcap_of_small_records,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_refused_costs_little(tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE[name]())
    code, error, seconds, mib = cost("inspect", str(tmp_path / name))
    assert code == 2 and error.count("\n") == 1 and error.startswith("lidar2pano: ") and name in error, error
    assert mib < LIMIT_MIB + BASE_MIB and seconds < LIMIT_S, (seconds, mib)


@pytest.mark.parametrize("size", [(1 << 28) - 16, (1 << 30) - 16])
def test_a_sparse_file_is_as_small_as_it_is(tmp_path, size):
    path = tmp_path / "a.bin"
    path.touch()
    os.truncate(path, size)
    code, error, seconds, mib = cost("inspect", str(path))
    assert code == 2 and mib < LIMIT_MIB + BASE_MIB and seconds < LIMIT_S, (error, seconds, mib)


def test_of_a_table_numbers_alone_are_unpacked(tmp_path):
    """A column of texts that takes six kilobytes, and 200 MB where it is unpacked."""
    import pyarrow as pa
    from pyarrow import parquet

    xyz = np.random.default_rng(0).uniform(-30, 30, (2000, 3)).astype(np.float32)  # no line, as of a trajectory
    columns = dict(zip("xyz", xyz.T, strict=True))
    texts = pa.array(["a" * 100_000] * 2000)
    parquet.write_table(pa.table({**columns, "text": texts, "place": [{"x": 1.0, "y": "b"}] * 2000}), tmp_path / "a")
    code, error, _, mib = cost("inspect", str(tmp_path / "a"))
    assert code == 0 and mib < 50 + BASE_MIB, (error, mib)


def test_a_member_that_unpacks_to_more_than_it_says_is_read_no_farther(tmp_path):
    (tmp_path / "a.npz").write_bytes(deflated_archive())
    code, _, seconds, mib = cost("inspect", str(tmp_path / "a.npz"))
    assert code == 0 and mib < LIMIT_MIB + BASE_MIB and seconds < LIMIT_S


@pytest.mark.parametrize("name", ["street.bin", "street.npy", "street.txt", "street.txt.gz"])
def test_a_valid_scan_takes_six_times_its_size_at_most(tmp_path, name):
    xyz, _ = sample_files.street(beams=64, columns=8_000 if ".txt" in name else 24_000)
    rows = np.column_stack([xyz, np.linspace(0, 1, len(xyz))]).astype(np.float32)
    path = tmp_path / name
    if name.endswith(".bin"):
        rows.tofile(path)
    elif name.endswith(".npy"):
        np.save(path, rows)
    else:
        text = "\n".join("{:.3f} {:.3f} {:.3f} {:.3f}".format(*row) for row in rows.tolist()).encode()
        path.write_bytes(gzip.compress(text, 1) if name.endswith(".gz") else text)
    size = len(text) if ".txt" in name else path.stat().st_size
    rows[:: len(rows) // 100].tofile(tmp_path / "small.bin")
    code, error, _, mib = cost("inspect", str(path))
    assert code == 0, error
    program_mib = cost("inspect", str(tmp_path / "small.bin")).mib  # Python, numpy and the program
    assert program_mib < BASE_MIB
    assert mib - program_mib < 6 * size / (1 << 20), (mib, program_mib, size >> 20)


TEXTS = """
import sys, time
from pathlib import Path
from lidar2pano.calibration import read_calib
from lidar2pano.data.poses import read_poses
from lidar2pano.drives import drive_motion, folders, viewpoints
from lidar2pano.errors import InputError
from lidar2pano.formats.yaml_files import read_document

def peak():
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) >> 10

here, begin = Path(sys.argv[1]), peak()
document = lambda path: read_document(path, "mend it")
times = lambda path: folders.times([here / "0.bin"])
for name, unit, read in [
    ("lists.json", "[],", document), ("objects.json", '{"a":0},', document), ("texts.json", '"ab",', document),
    ("a.yaml", "- {a: b}\\n", document), ("times.txt", "0\\n", times), ("timestamps.json", "{},", times),
    ("oxts.txt", "0 ", drive_motion._oxts_numbers), ("calib.txt", "P2: 0\\n", read_calib),
    ("poses.txt", "1\\n", lambda path: read_poses(path, 12, "12 numbers")), ("one-line.txt", "1 ", read_calib),
    ("places.csv", "1,\\n", lambda path: viewpoints._read_places(path, None)),
]:
    with (here / name).open("w") as file:
        file.write("[" * name.endswith("json"))
        for _ in range(66):
            file.write(unit * (1_000_000 // len(unit)))
        file.write(unit[:-1] + "]" if name.endswith("json") else unit)
    try:
        read(here / name)
    except InputError as error:
        print(name, str(error).count("\\n"), file=sys.stderr)
    (here / name).unlink()
print(peak() - begin, file=sys.stderr)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone tells how much memory a process has")
def test_texts_of_many_values_cost_little(tmp_path):
    """Texts that the program itself reads: 66 MB of shortest values, which would become two GiB of objects."""
    code, error, seconds, _ = cost(str(tmp_path), python=TEXTS)
    *refused, mib = error.splitlines()
    assert code == 0 and [line.split()[1] for line in refused] == 11 * ["0"], error
    assert int(mib) < LIMIT_MIB and seconds < 2 * LIMIT_S, (seconds, mib)  # of eleven texts


# --- the gate ---------------------------------------------------------------------------------------------------------


def test_a_picture_is_read_by_its_own_decoder_alone(tmp_path):
    """Pillow would start Ghostscript for a text that begins so."""
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4608 384\nshowpage\n%%EOF\n")
    started = (
        "import subprocess, sys; from lidar2pano.cli import main;"
        "subprocess.Popen = subprocess.run = None; sys.exit(main())"
    )
    done = cost("view", str(tmp_path / "a.png"), "--no-open", "--out", str(tmp_path / "a.html"), python=started)
    assert done.code == 2 and "is no readable image" in done.error


def test_a_jpeg_of_many_passes_is_refused(tmp_path):
    """A scan of 50 bytes costs 40 ms where the picture is large; a progressive picture as usual has ten."""
    data = io.BytesIO()
    Image.new("RGB", (64, 48), (9, 9, 9)).save(data, "JPEG", progressive=True)
    content = data.getvalue()
    (tmp_path / "a.jpg").write_bytes(content)
    assert read_image(tmp_path / "a.jpg").shape == (48, 64, 3)
    scan = content[content.rfind(b"\xff\xda") : -2]
    (tmp_path / "a.jpg").write_bytes(content[:-2] + 200 * scan + content[-2:])
    with pytest.raises(InputError, match="is no readable image"):
        read_image(tmp_path / "a.jpg")


@pytest.fixture
def socket_path(tmp_path):
    import socket

    place = socket.socket(socket.AF_UNIX)
    place.bind(str(tmp_path / "s.bin"))
    yield tmp_path / "s.bin"
    place.close()


@pytest.mark.parametrize("command", ["inspect {}", "translate {} --device cpu", "view {} --no-open --device cpu"])
def test_a_fifo_or_a_socket_is_refused_at_once(tmp_path, socket_path, command, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo(tmp_path / "x.bin")
    for path in (tmp_path / "x.bin", socket_path):
        assert main(command.format(path).split()) == 2
        error = capsys.readouterr().err
        assert "device, FIFO or socket" in error or "No such device" in error, error


@pytest.mark.parametrize("command", ["translate {} --weights {} --device cpu", "bulk {} --weights {} --device cpu"])
def test_a_fifo_in_a_folder_costs_one_line(tmp_path, random_weights, command, capsys):
    scans = tmp_path / "scans"
    scans.mkdir()
    write_scan(scans / "a.bin")
    write_scan(scans / "z.bin")
    os.mkfifo(scans / "m.bin")
    words = [*command.format(scans, random_weights).split(), "--out", str(tmp_path / "out")]
    assert main(words) == (3 if "bulk" in command else 2)
    error = capsys.readouterr().err
    assert error.count("device, FIFO or socket") == 1 and "Error" not in error
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {"a.png", "z.png"}


@pytest.mark.parametrize("command", ["translate {} --annotations coco,cityscapes,yolo --ply", "bulk {}"])
def test_names_may_be_no_utf8(tmp_path, random_weights, command):
    name = os.fsdecode(b"b\xff\xfe y")
    (tmp_path / name).mkdir()
    write_scan(tmp_path / name / f"{name}.bin")
    shutil.copytree(random_weights, tmp_path / name / "weights")
    words = [word.format(tmp_path / name) for word in command.split()]
    words += ["--weights", str(tmp_path / name / "weights"), "--device", "cpu", "--out", str(tmp_path / name / "out")]
    assert main(words) == 0
    assert (tmp_path / name / "out" / f"{name}.png").is_file()


# --- targets ----------------------------------------------------------------------------------------------------------


def test_a_link_or_a_device_is_never_replaced(tmp_path, capsys):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "link.html").symlink_to(tmp_path / "precious")
    os.mkfifo(tmp_path / "fifo.html")
    (tmp_path / "dangling.html").symlink_to(tmp_path / "nowhere")
    before = {path.name: path.lstat().st_ino for path in tmp_path.iterdir()}
    for name in ("link.html", "fifo.html", "dangling.html"):
        with pytest.raises(InputError, match="it is a link, device, FIFO or socket"):
            write_whole(tmp_path / name, lambda part: part.write_text("x"))
        assert main(["view", str(write_scan(tmp_path / "a.bin")), "--out", str(tmp_path / name), "--no-open"]) == 2
        assert "link, device, FIFO or socket" in capsys.readouterr().err
        (tmp_path / "a.bin").unlink()
    assert {path.name: path.lstat().st_ino for path in tmp_path.iterdir()} == before
    assert (tmp_path / "precious").read_text() == "mine"


def test_bulk_replaces_no_link(tmp_path, random_weights, capsys):
    (tmp_path / "scans").mkdir()
    (tmp_path / "out").mkdir()
    write_scan(tmp_path / "scans" / "a.bin")
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "out" / "a.png").symlink_to(tmp_path / "nowhere")
    words = ["bulk", str(tmp_path / "scans"), "--out", str(tmp_path / "out"), "--weights", str(random_weights)]
    assert main([*words, "--device", "cpu"]) == 2
    assert "link, device" in capsys.readouterr().err and (tmp_path / "out" / "a.png").is_symlink()


def test_the_name_of_an_unfinished_file_cannot_be_foretold(tmp_path):
    names = []
    for _ in range(3):
        write_whole(tmp_path / "a", lambda part: names.append(part.name) or part.write_text("x"))
    assert len(set(names)) == 3
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# --- the child --------------------------------------------------------------------------------------------------------


def test_a_child_has_limits_of_its_own():
    child, bound = ChildProcess(), Bound(bytes=64 << 20, seconds=1.0)
    try:
        assert child.call(bound, "a", len, b"abc") == 3
        with pytest.raises(InputError, match="a: takes more than 64 MiB of memory to be read"):
            child.call(bound, "a", bytes, 256 << 20)
        with pytest.raises(InputError, match="b: takes more than (1 s of processor time|10 s)"):
            child.call(bound, "b", exec, "while True: pass")
        with pytest.raises(InputError, match="c: ends the library that reads it"):
            child.call(bound, "c", os._exit, 7)
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            child.call(bound, "d", divmod, 1, 0)
        with pytest.raises(InputError, match="takes more than 2 s"):
            child.call(Bound(bytes=64 << 20, seconds=0.2), "e", time.sleep, 60)
        assert child.call(bound, "f", len, b"abcd") == 4
    finally:
        child.close()


def test_an_answer_builds_nothing_but_data():
    class Bad:
        def __reduce__(self) -> tuple:
            return os.system, ("true",)

    with pytest.raises(pickle.UnpicklingError, match="has no place in an answer"):
        AnswerUnpickler(io.BytesIO(pickle.dumps(Bad()))).load()


def test_a_child_is_where_its_parent_is(tmp_path, monkeypatch):
    for name, points in (("a", 50), ("b", 60)):
        (tmp_path / name).mkdir()
        write_scan(tmp_path / name / "x.bin", street(points))
        monkeypatch.chdir(tmp_path / name)
        assert len(reading_process.read_cloud(Path("x.bin"))) == points


def test_a_child_reads_as_this_process_does(tmp_path):
    xyz, ring = sample_files.street(beams=4, columns=64)
    for name, content in sample_files.every_format(xyz, ring).items():
        (tmp_path / name).write_bytes(content)
        apart, here = reading_process.read_cloud(tmp_path / name), read(tmp_path / name)
        assert len(apart) == len(here) and apart.name


def test_a_child_ends_with_its_parent(tmp_path):
    program = (
        "import os, sys, time; from lidar2pano.recordings import reading_process as r; r.get_ready();"
        "print(r._child()._process.pid, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    end = time.monotonic() + 20
    while Path(f"/proc/{child}").exists() and Path(f"/proc/{child}/stat").read_text().split()[2] != "Z":
        assert time.monotonic() < end
        time.sleep(0.05)


# --- signals ----------------------------------------------------------------------------------------------------------

STUCK = """
import sys, threading, time
from concurrent.futures import ThreadPoolExecutor
from lidar2pano.cli import main
from lidar2pano.recordings import reading_process

def stuck(*_, **__):
    print("stuck", flush=True)
    threading.Event().wait()

reading_process.describe = reading_process.read_cloud = stuck
with ThreadPoolExecutor(1) as pool:
    if "thread" in sys.argv:
        sys.argv.remove("thread")
        pool.submit(stuck)
    sys.exit(main())
"""


@pytest.mark.parametrize("words", [["inspect"], ["inspect", "thread"]])
def test_sigterm_ends_a_command_whatever_a_thread_waits_for(tmp_path, words):
    command = [sys.executable, "-c", STUCK, *words, str(write_scan(tmp_path / "a.bin"))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "stuck\n"
    time.sleep(1)
    begin = time.monotonic()
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 143 and "terminated" in error and time.monotonic() - begin < 20


ENDED_SLOWLY = """
import atexit, sys, time
from lidar2pano.child_process import Bound, ChildProcess
from lidar2pano.cli import main

app = sys.modules["lidar2pano.cli.app"]
child = ChildProcess()  # as a library's own objects: in use until the interpreter ends
child.call(Bound(bytes=1 << 28, seconds=5.0), "a", len, ())
where, folder = child._process.pid, child._temporary

def wait():
    print(where, folder, flush=True)
    time.sleep(99)

class Slow:
    def __del__(self, sleep=time.sleep):
        sleep(60)

if "exit" in sys.argv:
    atexit.register(time.sleep, 60)
sys.modules["__main__"].slow = Slow()
sys.argv[1:] = ["--version"]
app.make_program = lambda: type("Command", (), {"make_context": lambda *_: wait()})()
sys.exit(main())
"""


@pytest.mark.parametrize("words", [[], ["exit"]])
def test_sigterm_ends_a_command_whose_libraries_take_long_to_leave(words):
    """Exit functions may take what is left of the time; the interpreter is not taken down."""
    command = [sys.executable, "-c", ENDED_SLOWLY, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child, folder = process.stdout.readline().split()
        assert Path(folder).is_dir()
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        _, error = process.communicate(timeout=90)
        taken_s = time.monotonic() - begin
    assert (process.returncode, error) == (143, "lidar2pano: terminated\n")
    assert taken_s < 20  # in a busy machine
    assert not Path(folder).exists() and not Path(f"/proc/{child}").exists()


PAUSED = """
import signal, sys, threading
from lidar2pano.cli import main

def pause():
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    print("ready", flush=True)
    stop.wait()
    raise KeyboardInterrupt("paused at step 3")

sys.argv[1:] = ["--version"]
sys.modules["lidar2pano.cli.app"].make_program = lambda: type("Command", (), {"make_context": lambda *_: pause()})()
sys.exit(main())
"""


def test_sigterm_that_pauses_a_training_is_no_ctrl_c():
    with subprocess.Popen([sys.executable, "-c", PAUSED], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=60)[1] == b"lidar2pano: paused at step 3\n" and process.returncode == 143


AFTERWARDS = """
import signal, sys, time
from lidar2pano.cli import main
sys.modules["lidar2pano.cli.app"].GRACE_S = 0.1
sys.argv = ["lidar2pano", "--version"]
main()
print(signal.getsignal(signal.SIGTERM) is signal.SIG_DFL, signal.set_wakeup_fd(-1))
signal.signal(signal.SIGTERM, lambda *_: None)
signal.raise_signal(signal.SIGTERM)
time.sleep(0.5)
print("alive")
"""


def test_a_command_leaves_its_process_the_signals_that_come_afterwards():
    done = subprocess.run([sys.executable, "-c", AFTERWARDS], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.splitlines()[1:] == ["True -1", "alive"], done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone tells how much memory a process has")
def test_a_child_that_keeps_memory_is_replaced():
    bound, found = Bound(bytes=1 << 30, seconds=5.0), []
    for keeps in (False, True):
        child = ChildProcess(keeps=keeps)
        for mebibytes in (1, 300):  # kept as by a library's pool
            before = child.call(bound, "a", os.getpid)
            child.call(bound, "a", exec, f"import builtins; builtins.pool = bytearray({mebibytes} << 20)")
            found.append(child.call(bound, "a", os.getpid) == before)
        child.close()
    assert found == [True, False, True, True]


def test_a_child_with_a_large_answer_is_kept():
    bound, child = Bound(bytes=1 << 30, seconds=5.0), ChildProcess()
    try:
        before = child.call(bound, "a", os.getpid)
        assert len(child.call(bound, "a", np.zeros, 40 << 20)) == 40 << 20  # 320 MiB
        assert child.call(bound, "a", os.getpid) == before
    finally:
        child.close()


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone tells how much memory a process has")
def test_a_child_that_keeps_objects_keeps_no_answers():
    bound, child = Bound(bytes=1 << 30, seconds=5.0), ChildProcess(keeps=True)
    try:
        assert len(child.call(bound, "a", np.zeros, 10)) == 10
        before = child.call(bound, "a", _data_bytes)
        assert len(child.call(bound, "a", np.zeros, 1 << 24)) == 1 << 24
        assert child.call(bound, "a", _data_bytes) < before + (1 << 25)
    finally:
        child.close()


# --- weights ----------------------------------------------------------------------------------------------------------


def checkpoint(path: Path) -> zipfile.ZipFile:
    torch.save({"a": torch.ones(4)}, path)
    return zipfile.ZipFile(path, "a")


def test_parts_of_a_checkpoint_that_share_bytes_are_refused(tmp_path, capsys):
    path = tmp_path / "a.pth"
    with checkpoint(path) as file:
        for number in range(200):  # names for the same bytes
            part = zipfile.ZipInfo(f"archive/data/{number + 9}")
            first = file.filelist[1]
            part.file_size = part.compress_size = 1 << 16
            part.header_offset, part.CRC = first.header_offset, first.CRC
            file.filelist.append(part)
        file._didModify = True
    assert main(["weights", "import", str(path), "--as", "salsanext", "--out", str(tmp_path / "o")]) == 2
    assert "cannot be read as weights" in capsys.readouterr().err


def test_an_archive_that_only_torch_would_find_is_refused(tmp_path, capsys):
    path = tmp_path / "a.pth"
    checkpoint(path).close()
    path.write_bytes(path.read_bytes() + bytes(67_000))
    assert main(["weights", "import", str(path), "--as", "salsanext", "--out", str(tmp_path / "o")]) == 2
    assert "cannot be read as weights" in capsys.readouterr().err


def test_memory_of_a_process_is_measured():
    """The measure itself: what takes 300 MiB is seen to."""
    assert cost(python="x = bytearray(b'1') * (300 << 20)").mib > 300
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss > 0
