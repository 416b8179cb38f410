"""Write what became of every file of a folder: how it was read, and how fast beside other libraries.

    python runs/format_table.py FOLDER [--panoramas DIR] [--page FILE.md] [--sheet FILE.jpg]

Other libraries are used where they are installed: pypcd4, plyfile, laspy, pyarrow and NumPy; points must equal theirs
exactly. With the panoramas that `lidar2pano translate FOLDER/* --out DIR` wrote, the sheet shows those of the scans
that were taken outdoors all around.
"""

from __future__ import annotations

import argparse
import gzip
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.cli.inspect import described
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import open_path

RECORDINGS = {".bag", ".db3", ".mcap", ".pcap", ".osf"}  # have pages of their own
IGNORED = {".md", ".json"}
FIELDS = ("x", "y", "z", "intensity")  # that are read with other libraries, too
REPEAT = 21  # timings, of which the median counts
WIDTH, HEIGHT = 1000, 167  # of a panorama on the sheet


def numpy_points(path: Path) -> np.ndarray:
    """Points as NumPy alone reads them: arrays, tables as text, rows of float32."""
    if path.suffix in {".npy", ".npz"}:
        found = np.load(path)
        return (found if path.suffix == ".npy" else found[found.files[0]])[:, :3]
    if path.suffix in {".txt", ".csv"}:
        lines = [line.rstrip(",").replace(",", " ") for line in path.read_text().splitlines()]
        return np.loadtxt(lines[len(lines[0].split()) == 1 :])[:, :3]
    data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    return np.frombuffer(data, "<f4").reshape(-1, 5 if path.name.endswith(".pcd.bin") else 4)[:, :3].copy()


def theirs(path: Path) -> tuple[str, np.ndarray]:
    """The library that reads this file, and the points (N, 3) that it gives."""
    match path.suffix:
        case ".pcd":
            from pypcd4 import PointCloud as Pcd

            found = Pcd.from_path(path)
            return "pypcd4", found.numpy([name for name in FIELDS if name in found.fields])[:, :3]
        case ".ply":
            from plyfile import PlyData

            vertex = PlyData.read(path)["vertex"]
            return "plyfile", np.column_stack([vertex[name] for name in (*"xyz", "scalar_intensity")])[:, :3]
        case ".las" | ".laz":
            import laspy

            return "laspy", np.asarray(laspy.read(path).xyz)
        case ".feather":
            from pyarrow import feather

            table = feather.read_table(path)
            return "pyarrow", np.column_stack([table[axis].to_numpy() for axis in "xyz"])
    return "NumPy", numpy_points(path)


def ours(path: Path) -> PointCloud:
    """The cloud of a file."""
    return open_path(path).cloud(path)


def milliseconds(task: Callable[[], object]) -> float:
    """Median processor time of a call: other programs on the machine do not count."""
    times = []
    for _ in range(REPEAT):
        start = time.process_time()
        task()
        times.append(1000 * (time.process_time() - start))
    return float(np.median(times))


def beside(path: Path) -> str:
    """Whether another library gives the same points, and its time over ours."""
    try:
        library, xyz = theirs(path)
    except ModuleNotFoundError as error:
        return f"{error.name} is not installed"
    equal = np.array_equal(ours(path).xyz, xyz, equal_nan=True)
    ratio = milliseconds(lambda: theirs(path)) / milliseconds(lambda: ours(path))
    return f"{library}: {'equal' if equal else 'DIFFERENT'}, {ratio:.1f}x"


def row(path: Path) -> str:
    """The table's row of a file."""
    if path.suffix in RECORDINGS:
        return f"| `{path.name}` | recording | | | | | |"
    try:
        cloud = ours(path)
        milli = milliseconds(lambda: ours(path))
        scan, found = interpret(cloud, Overrides(invent=True))
    except InputError as error:
        return f"| `{path.name}` | refused: {str(error).removeprefix(f'{path}: ')} | | | | | |"
    record = described(scan, found)
    angles = record["elevations_deg"]
    beams = f"{len(angles)} ({angles[0]:.0f}..{angles[-1]:.0f})" if angles else "-"
    height = f"{found.ground_m:.2f} m" if found.ground_m is not None else "-"
    view_deg = 360 - sum(left - right for left, right in found.gaps_deg)
    try:
        interpret(cloud)
        outcome = "panorama" if view_deg == 360 else f"panorama of {view_deg:.0f} degrees, the rest unknown"
    except InputError as error:
        outcome = f"refused: {error}"
    moved = " (vehicle frame)" if any(found.viewpoint_m) else ""
    facts = [
        f"{cloud.format}, {found.points}" + (f" ({found.no_returns} no returns)" if found.no_returns else ""),
        f"{beams} {record['sensor']}".strip(),
        f"{found.forward} forward, sensor at {height}{moved}, remission {found.remission}",
        f"{milli:.1f} ms",
        beside(path),
        outcome,
    ]
    return f"| `{path.name}` | " + " | ".join(facts) + " |"


def page(folder: Path) -> Iterator[str]:
    """Lines of the table."""
    yield "| file | format, points | beams (degrees), sensor | read as | time | points beside | outcome |"
    yield "| --- | --- | --- | --- | ---: | --- | --- |"
    for path in sorted(folder.iterdir()):
        if path.suffix not in IGNORED:
            yield row(path)


def sheet(folder: Path, panoramas: Path) -> Image.Image:
    """Panoramas of scans all around with a street below them, one below the other, named."""
    chosen = []
    for path in sorted(folder.iterdir()):
        image = panoramas / f"{stem_of(path)}.png"
        if not image.exists() or path.suffix in RECORDINGS | IGNORED:
            continue
        _, found = interpret(ours(path))
        if not found.gaps_deg and found.ground_m is not None and 1 < found.ground_m < 3:
            chosen.append((path.name, image))
    whole = Image.new("RGB", (WIDTH, len(chosen) * HEIGHT))
    for place, (name, image) in enumerate(chosen):
        with Image.open(image) as opened:
            whole.paste(opened.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS), (0, place * HEIGHT))
        ImageDraw.Draw(whole).text((6, place * HEIGHT + 4), name, fill="white", stroke_width=2, stroke_fill="black")
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--panoramas", type=Path)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--sheet", type=Path)
    arguments = parser.parse_args()
    lines = "\n".join(page(arguments.folder))
    print(lines)
    if arguments.page:
        head, _, rest = arguments.page.read_text(encoding="utf-8").partition("<!-- table -->\n")
        tail = rest.partition("<!-- end -->")[2]
        arguments.page.write_text(f"{head}<!-- table -->\n{lines}\n<!-- end -->{tail}", encoding="utf-8")
    if arguments.sheet and arguments.panoramas:
        sheet(arguments.folder, arguments.panoramas).save(arguments.sheet, quality=60)


if __name__ == "__main__":
    main()
