"""A child process that works on strangers' files: its memory, processor time and written bytes have limits.

Libraries let no bound be set on their work; the operating system does. What a child takes, it gives back at its end.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import pickle
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError

try:
    import resource
except ImportError:  # not on Windows: there functions are called in this process, without limits
    resource = None

BASE_BYTES, BASE_S = 1 << 28, 6.0  # for a file of any size
# Of memory, a byte of a file: six times what it unpacks to, eight times packed; and of speed, the slowest library's.
BYTES_PER_BYTE, BYTES_PER_S = 6 * 8, 2e7
MOST_BYTES = 1 << 32
KEPT_BYTES = 3 << 26  # of memory may stay with the child after a call; the libraries themselves take half of it
WALL = 10  # so many times as long may the work take in a busy machine
START_S = 60.0  # to start, with libraries from a cold disk
LENGTHS = struct.Struct("<QQ")  # of a message, and of its array number n
TRUSTED = ("lidar2pano.", "numpy.")  # modules whose classes may stand in an answer
PLAIN = {"builtins": {"slice", "complex", "bytearray", "set", "frozenset"}, "numpy": {"dtype", "ndarray"}}
PLAIN |= {"pathlib": {"PosixPath", "PurePosixPath", "Path"}}
PROGRAM = "import sys; from lidar2pano.child_process import work; work(int(sys.argv[1]))"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """Limits of a call: bytes of memory, seconds of processor time."""

    bytes: int
    seconds: float

    @classmethod
    def of(cls, path: Path) -> Bound:
        """Return the limits for reading a file, or all files of a folder: low for a small one."""
        try:
            files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
            size = sum(_stored_bytes(file.stat()) for file in files)
        except OSError:
            size = 0
        return cls(bytes=min(BASE_BYTES + BYTES_PER_BYTE * size, MOST_BYTES), seconds=BASE_S + size / BYTES_PER_S)


def _stored_bytes(status: os.stat_result) -> int:
    """Return the bytes that a file takes on the disk: a sparse one may claim any length."""
    return min(status.st_size, 512 * getattr(status, "st_blocks", sys.maxsize))


STARTED: weakref.WeakSet[ChildProcess] = weakref.WeakSet()


class ChildProcess:
    """A process that calls functions, one at a time; it starts with the first call, and after one that ended it.

    It ends with this process, at the latest when its work is done.
    """

    def __init__(self, *, keeps: bool = False) -> None:
        """keeps  whether a call may need objects of an earlier one; if not, it ends when one has made it large."""
        self._keeps = keeps
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._temporary = ""  # the folder of its temporary files: they would outlive it
        STARTED.add(self)

    def call(self, bound: Bound, title: str, function: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
        """Return function(*arguments), called in the child; both are named in modules and can be pickled.

        title  of the file that is worked on. Raises InputError with it if a limit is reached or the child is lost, and
        InputError as the function does; RuntimeError in place of any other exception.
        """
        if resource is None:
            return function(*arguments)
        with self._lock:
            try:
                kind, value, grown = self._answer(bound, title, (bound, _folder(), function, arguments))
            except BaseException:
                self.end()
                raise
            if grown and not self._keeps:
                self.end()
        if kind == "value":
            return value
        if kind == "memory":
            raise InputError(_excess(title, f"more than {bound.bytes >> 20} MiB of memory"))
        raise InputError(value) if kind == "input" else RuntimeError(value)

    def start(self) -> None:
        """Start the process unless it runs; the first call does, too."""
        if resource is not None:
            with self._lock:
                self._start()

    def close(self) -> None:
        """End the process when it is not working."""
        with self._lock:
            self.end()

    def end(self) -> None:
        """End the process at once, whoever waits for it, and remove its temporary files."""
        process, channel, folder = self._process, self._socket, self._temporary
        self._process, self._socket, self._temporary = None, None, ""
        if process is not None:
            process.kill()
            process.wait()
        if channel is not None:
            channel.close()
        if folder:
            shutil.rmtree(folder, ignore_errors=True)

    def _answer(self, bound: Bound, title: str, request: object) -> tuple[str, Any, bool]:
        process, channel = self._start()
        channel.settimeout(bound.seconds * WALL)
        try:
            send(channel, request)
            kind, value = receive(channel, bound.bytes, AnswerUnpickler)
            return kind, value, receive(channel, BASE_BYTES, AnswerUnpickler)
        except TimeoutError:
            raise InputError(_excess(title, f"more than {bound.seconds * WALL:.0f} s")) from None
        except (EOFError, OSError):  # it has ended
            status = process.wait(START_S)
        if status in (-signal.SIGXCPU, -signal.SIGKILL):
            raise InputError(_excess(title, f"more than {bound.seconds:.0f} s of processor time"))
        raise InputError(f"{title}: ends the library that reads it (status {status}); it is damaged, fetch it again")

    def _start(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        if self._process is not None and self._socket is not None and self._process.poll() is None:
            return self._process, self._socket
        self.end()
        self._socket, theirs = socket.socketpair()
        paths = os.pathsep.join(dict.fromkeys(path for path in sys.path if path))
        settings = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
        with contextlib.suppress(OSError):
            self._temporary = settings["TMPDIR"] = tempfile.mkdtemp(prefix="lidar2pano-")
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", PROGRAM, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | settings | {"PYTHONPATH": paths},
            )
        self._socket.settimeout(START_S)
        receive(self._socket, BASE_BYTES, AnswerUnpickler)  # it is ready
        return self._process, self._socket

    def __del__(self) -> None:
        """End the process with its object."""
        with contextlib.suppress(Exception):
            self.end()


@atexit.register
def end_children() -> None:
    """End the processes of all objects at once, whoever waits for them."""
    for child in list(STARTED):
        child.end()


def _folder() -> str:
    """Return the folder that relative paths begin in, now; a removed one has no files."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return "/"


def _excess(title: str, amount: str) -> str:
    return f"{title}: takes {amount} to be read, as no scan of its size does; it is damaged or no scan, name another"


class AnswerUnpickler(pickle.Unpickler):
    """Builds nothing but arrays, plain values and classes of our own: a library may have been taken over by a file."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """Return a class by its name; UnpicklingError for any other object."""
        if name in PLAIN.get(module, ()) or f"{module}.".startswith(TRUSTED):
            value = super().find_class(module, name)
            if isinstance(value, type) or module.startswith("numpy"):
                return value
        raise pickle.UnpicklingError(f"{module}.{name} has no place in an answer")


def send(channel: socket.socket, message: object) -> None:
    """Send a message; arrays go beside it, uncopied."""
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    parts = [buffer.raw() for buffer in buffers]
    channel.sendall(LENGTHS.pack(len(text), len(parts)) + b"".join(LENGTHS.pack(part.nbytes, 0) for part in parts))
    for part in (memoryview(text), *parts):
        channel.sendall(part)


def receive(channel: socket.socket, most: int, unpickler: type[pickle.Unpickler] = pickle.Unpickler) -> Any:  # noqa: ANN401
    """Return the next message, of at most so many bytes; EOFError if the other side has ended."""
    length, count = LENGTHS.unpack(_received(channel, LENGTHS.size))
    if LENGTHS.size * count > most:
        raise EOFError
    sizes = [LENGTHS.unpack(_received(channel, LENGTHS.size))[0] for _ in range(count)]
    if length + sum(sizes) > most:
        raise EOFError
    text, *buffers = [_received(channel, size) for size in (length, *sizes)]
    return unpickler(io.BytesIO(text), buffers=buffers).load()


def _received(channel: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        if not (count := channel.recv_into(view)):
            raise EOFError
        view = view[count:]
    return data


def work(descriptor: int) -> None:
    """Make the calls that the parent asks for, until it ends: the program of the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is meant for the parent, which then ends this process
    with socket.socket(fileno=descriptor) as channel, contextlib.suppress(EOFError, OSError):
        send(channel, "ready")
        begin = _data_bytes()
        while True:
            bound, folder, function, arguments = receive(channel, sys.maxsize)
            try:
                os.chdir(folder)
                send(channel, _called(bound, function, arguments))
            except MemoryError:  # for the answer; nothing of it is sent yet
                send(channel, ("memory", ""))
                grown = True
            else:  # the answer is gone
                grown = _data_bytes() > begin + KEPT_BYTES
            send(channel, grown)


def _called(bound: Bound, function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[str, Any]:
    _limit(bound)
    try:
        return "value", function(*arguments)
    except InputError as error:
        return ("memory" if isinstance(error.__cause__, MemoryError) else "input"), str(error)
    except MemoryError:
        return "memory", ""
    except BaseException as error:
        return "fault", f"{type(error).__name__}: {error}"


def _data_bytes() -> int:
    """Return the memory that RLIMIT_DATA counts; 0 where the system does not tell, which Linux alone does."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path("/proc/self/status").read_text(encoding="ascii").partition("VmData:")[2].split()[0]) << 10
    return 0


def _limit(bound: Bound) -> None:
    """Set limits for this process from now on; beyond, memory is refused, and time ends the process."""
    assert resource is not None
    spent = time.process_time()
    limits = [(resource.RLIMIT_CPU, int(spent + bound.seconds) + 1), (resource.RLIMIT_FSIZE, bound.bytes)]
    if taken := _data_bytes():
        limits.append((resource.RLIMIT_DATA, taken + bound.bytes))
    for limit, value in limits:
        hard = resource.getrlimit(limit)[1]
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
