"""Which files of the package a scan crosses in `lidar2pano translate`, from the reading of its file to the written PNG.

    python runs/files_crossed.py [WEIGHTS]

Two scans go through one command; the second is traced (sys.setprofile), when everything is imported and loaded.
"""

import sys
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import FrameType

import lidar2pano
from lidar2pano.cli import main
from lidar2pano.demo import street

PACKAGE = f"{Path(lidar2pano.__file__).parent}/"


def trace(weights: str) -> dict[str, int]:
    """Calls per file of the package between the second call of `read` and the second return of `Panorama.save`."""
    calls: dict[str, int] = {}
    reads = saved = 0

    def note(frame: FrameType, event: str, _: object) -> None:
        nonlocal reads, saved
        file = frame.f_code.co_filename
        if event not in ("call", "return") or not file.startswith(PACKAGE):
            return
        reads += (event, frame.f_code.co_name) == ("call", "read")
        saved += (event, frame.f_code.co_name) == ("return", "save")
        if event == "call" and reads > 1 and saved < 2:
            name = file.removeprefix(PACKAGE)
            calls[name] = calls.get(name, 0) + 1

    with tempfile.TemporaryDirectory() as folder:
        scans = [Path(folder) / f"{number}.bin" for number in range(2)]
        for scan in scans:
            scan.write_bytes(street().read_bytes())
        sys.setprofile(note)
        try:
            with redirect_stdout(StringIO()):
                main(["translate", *map(str, scans), "--out", folder, "--weights", weights, "--device", "cpu"])
        finally:
            sys.setprofile(None)
    return calls


if __name__ == "__main__":
    found = trace(sys.argv[1] if len(sys.argv) > 1 else "kitti-mini")
    for name, count in sorted(found.items()):
        print(f"{count:6d}  {name}")
    print(len(found), "files")
