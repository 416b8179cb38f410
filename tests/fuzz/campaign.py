"""A campaign: mutants for so many seconds, in turn over all targets; each fault is kept in corpus/.

    .venv/bin/python tests/fuzz/campaign.py --seconds 3600 [--seed 7] [--target "scan binary.pcd"]

A file of the corpus is called TARGET--HASH; `test_fuzz.py` tries all of them first, whatever the time.
"""

from __future__ import annotations

import argparse
import faulthandler
import hashlib
import os
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
sys.path[:0] = [str(HERE), str(HERE.parent / "support")]

from targets import Target, all_targets  # noqa: E402

from lidar2pano.errors import InputError  # noqa: E402
from random_weights import write_weights  # noqa: E402

TURN, TURN_S = 50, 0.05  # mutants and processor time of a target before the next one has its turn
SLOW_S = 2.0  # no mutant takes so long
MOST_BYTES = 256 << 20  # nor so much memory at once, above what it began with


class Peak:
    """The most memory that this process has had; Linux alone tells. Its files stay open: opening takes the time.

    (ru_maxrss begins with that of the process that started it, and cannot begin anew.)
    """

    def __init__(self) -> None:
        self.status = self.reset = -1
        with suppress(OSError):
            self.status = os.open("/proc/self/status", os.O_RDONLY)
            self.reset = os.open("/proc/self/clear_refs", os.O_WRONLY)

    def begin(self) -> int:
        """Begin anew; the bytes that are held now."""
        with suppress(OSError):
            os.pwrite(self.reset, b"5", 0)
        return self.bytes()

    def bytes(self) -> int:
        """The peak since then."""
        text = os.pread(self.status, 4096, 0) if self.status >= 0 else b""
        return int(text.partition(b"VmHWM:")[2].split(None, 1)[0]) << 10 if b"VmHWM:" in text else 0


PEAK = Peak()
SLOWEST, LARGEST = [0.0, ""], [0, ""]  # seconds, bytes of a mutant, and its target


class Fault(NamedTuple):
    """A mutant that raised something else than InputError, whose message is no line, or that took too much."""

    target: str
    data: bytes
    where: str


def attempt(name: str, target: Target, data: bytes) -> Fault | None:
    """Feed a target; what is wrong with how it took it."""
    held = PEAK.begin()
    began = time.process_time()
    try:
        target.run(data)
    except InputError as error:
        if "\n" in str(error).strip("\n") and not _quotes_newline(str(error)):
            return Fault(name, data, f"a message of several lines: {error!s:.200}")
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        ours = [one for one in traceback.extract_tb(error.__traceback__) if "lidar2pano" in one.filename]
        at = ours[-1] if ours else last
        return Fault(name, data, f"{type(error).__name__} at {Path(at.filename).name}:{at.lineno}: {error!s:.200}")
    took_s, more = time.process_time() - began, PEAK.bytes() - held
    for worst, value in ((SLOWEST, took_s), (LARGEST, more)):
        worst[:] = max(worst, [value, name])
    if took_s > SLOW_S:
        return Fault(name, data, f"took {took_s:.1f} s")
    if more > MOST_BYTES:
        return Fault(name, data, f"took {more >> 20} MiB")
    return None


def _quotes_newline(message: str) -> bool:
    """The command line makes one line of any message (`print_error`); a quoted name may hold anything."""
    return len(message) < 5000


def replay(targets: Mapping[str, Target]) -> list[Fault]:
    """The faults of what once broke."""
    files = sorted(path for path in CORPUS.iterdir() if "--" in path.name)
    names = {name.replace(" ", "_"): name for name in targets}
    pairs = [(names[path.name.partition("--")[0]], path.read_bytes()) for path in files]
    return [fault for name, data in pairs if (fault := attempt(name, targets[name], data))]


def campaign(
    targets: Mapping[str, Target], seconds: float, seed: int, last: Path | None = None
) -> tuple[int, dict[str, Fault]]:
    """How many mutants were tried, and the first fault of each place where one happened."""
    draw, tried, faults = random.Random(seed), 0, {}
    end = time.monotonic() + seconds
    while True:
        for name, target in targets.items():
            turn_end = time.process_time() + TURN_S
            for _ in range(TURN):
                if time.monotonic() > end:
                    return tried, faults
                if time.process_time() > turn_end:
                    break
                data = target.mutate(draw, draw.choice(target.seeds))
                tried += 1
                if last:
                    last.write_bytes(data)
                if (fault := attempt(name, target, data)) and fault.where.partition(": ")[0] not in faults:
                    faults[fault.where.partition(": ")[0]] = fault


def main() -> int:
    """The program; exit code 1 where there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", default="", help="only targets whose names begin so")
    parser.add_argument("--replay", action="store_true", help="first try what is in the corpus")
    parser.add_argument("--last", type=Path, help="a file for each mutant before its turn: it may end the process")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        small = {"image_channels": 3, "conditions": 4, "width": 2}
        weights = write_weights(Path(folder), "critic", "titan-critic", small).read_bytes()
        targets = all_targets(Path(folder), weights)
        again = replay(targets) if options.replay else []
        chosen = {name: target for name, target in targets.items() if name.startswith(options.target)}
        faulthandler.dump_traceback_later(options.seconds + 60, exit=True)  # what never ends in C
        tried, faults = campaign(chosen, options.seconds, options.seed, options.last)
        faulthandler.cancel_dump_traceback_later()
    for fault in again:
        print(f"{fault.target}: once mended, broken again: {fault.where}")
    for fault in faults.values():
        name = f"{fault.target.replace(' ', '_')}--{hashlib.sha256(fault.data).hexdigest()[:12]}"
        (CORPUS / name).write_bytes(fault.data)
        print(f"{name}: {fault.where}")
    print(f"seed {options.seed}: {tried} mutants, {len(chosen)} targets, {len(faults)} faults")
    print(f"slowest: {SLOWEST[0]:.2f} s, {SLOWEST[1]}; largest: {LARGEST[0] >> 20} MiB, {LARGEST[1]}")
    return 1 if faults or again else 0


if __name__ == "__main__":
    sys.exit(main())
