"""Write the table "What it costs" of README.md: python runs/readme.py.

Time comes from RESULTS.md (`lidar2pano bench`), memory from running the demo, sizes and licences from the cards.
"""

from __future__ import annotations

import math
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from lidar2pano.models.card import read_card
from lidar2pano.models.families import DISTRIBUTIONS, families

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- costs: written by runs/readme.py -->", "<!-- end of costs -->"
MIB = 2**20
DEMOS = 5  # runs differ by a tenth


def time_of(results: str) -> tuple[str, str]:
    """Return (milliseconds of a whole panorama, threads) in the table of times of RESULTS.md."""
    time = re.search(r"^\| whole panorama \| ([\d.]+) \|", results, flags=re.MULTILINE)
    threads = re.search(r"^device cpu, threads (\d+)", results, flags=re.MULTILINE)
    if not time or not threads:
        raise SystemExit("RESULTS.md has no row 'whole panorama' measured on a CPU; run runs/results.sh")
    return time[1], threads[1]


def arithmetic_of(results: str) -> str:
    """Return the engine and arithmetic of the table of times: what a machine without them does not reach."""
    line = re.search(r"^device cpu.*$", results, flags=re.MULTILINE)
    values = dict(re.findall(r"(\w+) (\w+)(?:, |$)", line[0])) if line else {}
    engine = {"openvino": "OpenVINO, extra `fast`"}.get(values.get("engine", ""), values.get("engine", "torch"))
    return f"{engine}; {'bfloat16 in hardware' if values.get('bfloat16') == 'True' else 'float32'}"


def peak_mib() -> float:
    """Return the largest resident memory of DEMOS runs of `lidar2pano demo`."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "lidar2pano", "demo", "--out", folder]
        for _ in range(DEMOS):
            subprocess.run(command, check=True, capture_output=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def licences() -> str:
    """Return each family with its licence and size."""
    parts = []
    for name, folder in families().items():
        files = sorted(folder.glob("*.safetensors"))
        licence = " and ".join(sorted({str(read_card(file).licence) for file in files}))
        note = ", not for commercial use" if "NC" in licence else ""
        origin = f", by `pip install {DISTRIBUTIONS[name]}`" if name in DISTRIBUTIONS else ""
        size = sum(file.stat().st_size for file in files) / MIB
        parts.append(f"`{name}`: {licence}{note}, {size:.0f} MiB{origin}")
    return "; ".join(parts)


def costs(results: str, memory_mib: float) -> str:
    """Return the table, with its markers."""
    milliseconds, threads = time_of(results)
    rows = [
        ("time", f"{float(milliseconds) / 1000:.1f} s per panorama on {threads} CPU cores ({arithmetic_of(results)})"),
        ("memory", f"{math.ceil(memory_mib / 102.4) / 10:.1f} GiB at most, for `demo`"),
        ("download", "none: the weights are part of the package"),
        ("licence", f"code Apache-2.0; weights {licences()}"),
    ]
    table = "\n".join(["| cost | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])
    return f"{BEGIN}\n{table}\n{END}"


def main() -> None:
    """Replace the table in README.md."""
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    tail = rest.partition(END)[2]
    results = (ROOT / "RESULTS.md").read_text(encoding="utf-8")
    readme.write_text(head + costs(results, peak_mib()) + tail, encoding="utf-8")


if __name__ == "__main__":
    main()
