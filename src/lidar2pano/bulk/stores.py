"""Stores of scans and panoramas: a folder, or any URL of fsspec (s3://, gs://, memory://)."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lidar2pano.drives.folders import head_below, names_below
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import MACHINE, append_bytes, check_target, is_abandoned, reason

SCRATCH = ".lidar2pano-"  # folders of unfinished files: .lidar2pano-MACHINE-PROCESS-xxxx


def open_store(place: str | Path) -> Store:
    """Return the store at a folder or URL; InputError for a URL without access."""
    text = str(place)
    if text.startswith("file://"):
        return Folder(Path(text.removeprefix("file://")))
    return Remote(text) if "://" in text else Folder(Path(text))


@contextmanager
def local_copy(store: Store, name: str) -> Iterator[Path]:
    """Give `store.local`, with errors about the file's place in the store instead of a download's."""
    with store.local(name) as path:
        try:
            yield path
        except InputError as error:
            raise InputError(str(error).replace(str(path), f"{store.place}/{name}")) from None


def put_bytes(store: Store, name: str, data: bytes) -> None:
    """Make bytes the file `name` of a store, complete or not at all; raises InputError."""
    with store.scratch() as scratch:
        (scratch / "new").write_bytes(data)
        store.put(scratch / "new", name)


class Folder:
    """Files by name in a folder of this machine, or in a shared one.

    A name is the path below the root, with slashes.
    place  the root, for messages.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.place = root, str(root)

    def names(self, prefix: str = "") -> Iterator[str]:
        """Yield the names of all files, or of those in the folder `prefix`, as `names_below`."""
        if (self.root / prefix).is_dir():
            yield from (f"{prefix}/{name}" if prefix else name for name in names_below(self.root / prefix))

    def head(self, name: str) -> bytes:
        """Return a file's first bytes, unpacked; b"" if it cannot be read."""
        return head_below(self.root, name)

    def exists(self, name: str) -> bool:
        """Return whether there is such a file."""
        return (self.root / name).is_file()

    @contextmanager
    def local(self, name: str) -> Iterator[Path]:
        """Give the path of a local file or folder with the content; InputError if there is none."""
        yield self.root / name

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Give a local folder for the files of `put`; the folder goes with the context.

        It lies in the folder itself, so that `put` is a renaming; files of killed runs are removed.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self._sweep()
            folder = Path(tempfile.mkdtemp(prefix=f"{SCRATCH}{MACHINE}-{os.getpid()}-", dir=self.root))
        except OSError as error:
            raise _unwritable(self.place, error) from error
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def put(self, file: Path, name: str) -> None:
        """Make a file of the scratch folder the file `name`, complete or not at all; raises InputError."""
        try:
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            check_target(self.root / name)
            file.replace(self.root / name)
        except OSError as error:
            raise _unwritable(str(self.root / name), error) from error

    def append(self, name: str, data: bytes) -> None:
        """Append to a file by one call of the system, so that processes' lines do not mix; raises InputError."""
        try:
            append_bytes(self.root / name, data)
        except OSError as error:
            raise _unwritable(str(self.root / name), error) from error

    def _sweep(self) -> None:
        for folder in self.root.glob(f"{SCRATCH}*"):
            with suppress(FileNotFoundError):  # its own run has just removed it
                if is_abandoned(folder, folder.name.removeprefix(SCRATCH).rpartition("-")[0]):
                    shutil.rmtree(folder, ignore_errors=True)


class Remote:
    """Files by name at a URL that fsspec opens; each is uploaded in one piece, whole or not at all."""

    def __init__(self, url: str) -> None:
        from fsspec.core import url_to_fs

        try:
            self._files, root = url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise InputError(f"{url}: cannot be opened ({error}); name a folder or another URL") from error
        self.place, self._root = url, root.rstrip("/")
        self._known: set[str] | None = None

    def names(self, prefix: str = "") -> Iterator[str]:
        """List the names once, as of Folder.names."""
        return iter(sorted(name for name in self._listed() if not prefix or name.startswith(f"{prefix}/")))

    def exists(self, name: str) -> bool:
        """Return whether the list of names has it."""
        return name in self._listed()

    @contextmanager
    def local(self, name: str) -> Iterator[Path]:
        """Download a file or folder for the time of the context."""
        with tempfile.TemporaryDirectory(prefix=SCRATCH) as folder:
            path = Path(folder, name.rpartition("/")[2])
            for file in list(self.names(name)) or [name]:
                target = Path(f"{path}{file.removeprefix(name)}")
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    self._files.get_file(f"{self._root}/{file}", str(target))
                except OSError as error:
                    raise InputError(f"{self.place}/{file}: cannot be read ({error}); ask for permission") from error
            yield path

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Give a temporary folder."""
        with tempfile.TemporaryDirectory(prefix=SCRATCH) as folder:
            yield Path(folder)

    def put(self, file: Path, name: str) -> None:
        """Upload a file."""
        try:
            self._files.pipe_file(f"{self._root}/{name}", file.read_bytes())
        except OSError as error:
            raise _unwritable(f"{self.place}/{name}", error) from error
        file.unlink()
        if self._known is not None:
            self._known.add(name)

    def _listed(self) -> set[str]:
        if self._known is None:
            names = (path.removeprefix(self._root).lstrip("/") for path in self._files.find(self._root))
            self._known = {name for name in names if not any(part.startswith(".") for part in name.split("/")[:-1])}
        return self._known


Store = Folder | Remote


def _unwritable(place: str, error: OSError) -> InputError:
    return InputError(f"{place}: cannot be written ({reason(error)}); choose another --out")
