"""Fuzzing guided by coverage (atheris): bytes to the reader that takes them, with limits of memory and time.

    .venv/bin/python tests/fuzz/fuzz_readers.py --corpus FOLDER        # writes one small scan of each format
    .venv/bin/python tests/fuzz/fuzz_readers.py FOLDER -max_total_time=3600 -rss_limit_mb=700 -timeout=10

A fault is any exception but InputError. `make fuzz` runs it after the seeded mutants; so does OSS-Fuzz (oss-fuzz/).
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import atheris  # pyright: ignore[reportMissingImports] Linux alone

with atheris.instrument_imports(include=["lidar2pano"]):
    from lidar2pano.errors import InputError
    from lidar2pano.formats.file_contents import HEAD_BYTES
    from lidar2pano.formats.interpretation import interpret
    from lidar2pano.formats.readers import READERS

MOST_BYTES = 1 << 16  # of an input
PATH = Path("scan")


def read_input(data: bytes) -> None:
    """Decode and interpret bytes as the program does with a file of that content, without an ending."""
    try:
        for reader in READERS:
            if reader.accepts(data[:HEAD_BYTES], PATH):
                interpret(reader.decode(data, PATH))
                return
    except InputError as error:
        if len(str(error)) > 5000:
            raise AssertionError("a message of 5000 characters") from error


def write_corpus(folder: Path) -> None:
    """Write a small scan of each format."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / "support"))
    import sample_files

    folder.mkdir(parents=True, exist_ok=True)
    for name, content in sample_files.every_format(*sample_files.street(beams=4, columns=16)).items():
        (folder / name).write_bytes(content)


def main() -> None:
    """Run, with the words of libFuzzer."""
    if sys.argv[1:2] == ["--corpus"]:
        write_corpus(Path(sys.argv[2]))
        return
    warnings.simplefilter("ignore")
    atheris.Setup([*sys.argv, f"-max_len={MOST_BYTES}"], read_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
