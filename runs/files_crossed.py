"""Which files of the package a scan crosses in `lidar2pano translate`, or a batch in `lidar2pano train`.

    python runs/files_crossed.py [WEIGHTS]              from the reading of the second scan to its written PNG
    python runs/files_crossed.py train RECIPE OPTION... the second step of a training

The first scan and the first step are left out (sys.setprofile), so that everything is imported and loaded.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import FrameType

import lidar2pano
from lidar2pano.cli import main
from lidar2pano.demo import street

PACKAGE = f"{Path(lidar2pano.__file__).parent}/"


def traced(command: list[str], begins: Callable[[str, str], bool], ends: Callable[[str, str], bool]) -> Counter[str]:
    """Calls per file of the package from the second event of one sort to the second of another.

    begins, ends  of the event ("call" or "return") and the function's name.
    """
    calls: Counter[str] = Counter()
    begun = ended = 0

    def note(frame: FrameType, event: str, _: object) -> None:
        nonlocal begun, ended
        file, name = frame.f_code.co_filename, frame.f_code.co_name
        if event not in ("call", "return") or not file.startswith(PACKAGE):
            return
        begun += begins(event, name)
        if event == "call" and begun > 1 and ended < 2:
            calls[file.removeprefix(PACKAGE)] += 1
        ended += ends(event, name)
        if ended == 2:
            raise SystemExit  # the rest of the command counts for nothing

    sys.setprofile(note)
    try:
        with redirect_stdout(StringIO()):
            main(command)
    except SystemExit:
        pass
    finally:
        sys.setprofile(None)
    return calls


def of_a_scan(weights: str) -> Counter[str]:
    """Files that the second of two scans crosses."""
    with tempfile.TemporaryDirectory() as folder:
        scans = [Path(folder) / f"{number}.bin" for number in range(2)]
        for scan in scans:
            scan.write_bytes(street().read_bytes())
        command = ["translate", *map(str, scans), "--out", folder, "--weights", weights, "--device", "cpu"]
        return traced(command, lambda *it: it == ("call", "read"), lambda *it: it == ("return", "save"))


def of_a_batch(recipe: str, options: list[str]) -> Counter[str]:
    """Files that the second batch of a training of three steps crosses: loading, losses, optimiser."""
    with tempfile.TemporaryDirectory() as folder:
        steps = ["--set", "training.steps=3", "--set", "training.workers=0"]
        command = ["train", recipe, "--out", folder, *steps, *options]
        return traced(command, lambda *it: it == ("call", "_step"), lambda *it: it == ("return", "_step"))


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        found = of_a_batch(sys.argv[2], sys.argv[3:])
    else:
        found = of_a_scan(sys.argv[1] if len(sys.argv) > 1 else "streets")
    for name, count in sorted(found.items()):
        print(f"{count:6d}  {name}")
    print(len(found), "files")
