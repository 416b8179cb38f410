"""Compare the simulator's LiDAR with a real one: figures as a Markdown table, and an image.

    python runs/lidar_comparison.py SIMULATED REAL OUT.png [--scans N]

SIMULATED and REAL are data sets in SemanticKITTI's layout (sequences/*/velodyne/*.bin, labels/*.label) of an HDL-64E,
whose files hold ring after ring, each from straight ahead to the left. Scans without labels are left out. The labels
of KITTI's raw recordings are a network's: its classes are blurred at the edges of things, the simulator's are not.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.labels import SEMANTIC_KITTI

RINGS = 64
FIRING = 360 / 2156  # degrees
CLASSES = (
    "road", "sidewalk", "terrain", "vegetation", "building", "fence", "car", "person", "trunk", "pole", "traffic-sign",
)  # fmt: skip
SPANS = ((3, 10), (10, 20), (20, 30), (30, 45), (45, 80))  # metres
SIMULATED, REAL = (214, 96, 40), (40, 90, 170)


@dataclass(frozen=True, eq=False)
class Points:
    """Returns of some scans, one after the other: all (N,)."""

    distance: np.ndarray
    remission: np.ndarray
    azimuth: np.ndarray
    ring: np.ndarray
    label: np.ndarray
    scans: int
    first: np.ndarray  # (n, 4): the first scan's points

    def of(self, name: str) -> np.ndarray:
        return self.label == SEMANTIC_KITTI.id_of(name)

    def within(self, span: tuple[int, int]) -> np.ndarray:
        return (self.distance >= span[0]) & (self.distance < span[1])


def read(root: Path, scans: int) -> Points:
    bins = [
        path
        for path in sorted(root.glob("sequences/*/velodyne/*.bin"))
        if (path.parents[1] / "labels" / f"{path.stem}.label").exists()
    ]
    if not bins:
        raise SystemExit(f"{root}: no labelled scans; name a data set in SemanticKITTI's layout")
    bins = [bins[i] for i in np.unique(np.linspace(0, len(bins) - 1, min(scans, len(bins))).astype(int))]
    rows, first = [], np.zeros((0, 4), np.float32)
    for path in bins:
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        raw = np.fromfile(path.parents[1] / "labels" / f"{path.stem}.label", "<u4")
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
        ring = np.concatenate([[0], np.cumsum(np.diff(azimuth) < -180)]).clip(0, RINGS - 1)
        distance = np.linalg.norm(points[:, :3], axis=1)
        label = SEMANTIC_KITTI.from_raw(raw)
        rows.append(np.stack([distance, points[:, 3], azimuth, ring, label]))
        first = first if len(first) else points
    distance, remission, azimuth, ring, label = np.concatenate(rows, axis=1).astype(np.float32)
    return Points(distance, remission, azimuth, ring.astype(np.int64), label.astype(np.int64), len(bins), first)


def spread(values: np.ndarray) -> float:
    """Standard deviation, from the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) else float("nan")


def neighbours(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Per point whether both neighbours on its ring are the next firings, and its residual to their line, metres."""
    step = np.diff(points.azimuth)
    near = (np.diff(points.ring) == 0) & (step > 0) & (step < 1.6 * FIRING)
    r = points.distance
    paired = np.zeros(len(r), dtype=bool)
    paired[1:-1] = near[:-1] & near[1:] & (np.maximum(np.abs(r[:-2] - r[1:-1]), np.abs(r[2:] - r[1:-1])) < 0.3)
    share = np.full(len(r), 0.5)
    share[1:-1] = step[:-1] / np.maximum(step[:-1] + step[1:], 1e-6)
    residual = np.zeros(len(r))
    residual[1:-1] = r[1:-1] - r[:-2] * (1 - share[1:-1]) - r[2:] * share[1:-1]
    return paired, residual / np.sqrt(1 + share**2 + (1 - share) ** 2)


def missing(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Per point whether an even surface goes on to the next point of its ring, and how many returns miss between."""
    step, r = np.diff(points.azimuth, append=0), points.distance
    even = (np.diff(points.ring, append=-1) == 0) & (step > 0) & (step < 4.5 * FIRING)
    even &= np.abs(np.diff(r, append=0)) < 0.01 * r + 0.03
    return even, np.maximum(np.round(step / FIRING) - 1, 0)


def between(points: Points) -> list[tuple[int, int]]:
    """For edges of 0.5-1.5 m and of 3-30 m: how many there are, and how many have a point between their two sides."""
    r, ring = points.distance, points.ring
    step = np.diff(points.azimuth)
    row = (np.diff(ring) == 0) & (step > 0) & (step < 1.6 * FIRING)
    whole = row[:-3] & row[1:-2] & row[2:-1] & row[3:]
    a, b, middle, c, d = r[:-4], r[1:-3], r[2:-2], r[3:-1], r[4:]
    stable = whole & (np.abs(a - b) < 0.1 + 0.01 * a) & (np.abs(c - d) < 0.1 + 0.01 * d) & (middle < 30)
    share = (middle - np.minimum(b, c)) / np.maximum(np.abs(c - b), 1e-6)
    inside = (share > 0.12) & (share < 0.88)
    jump = np.abs(c - b)
    spans = [stable & (jump >= low) & (jump < high) for low, high in ((0.5, 1.5), (3, 30))]
    return [(int(span.sum()), int((span & inside).sum())) for span in spans]


Row = tuple[str, Callable[[Points], str]]


def table(simulated: Points, real: Points) -> list[str]:
    """Markdown rows: figure, simulated, real."""
    rows = [*shape_rows(), *range_rows(), *remission_rows()]
    lines = [f"| {name} | {figure(simulated)} | {figure(real)} |" for name, figure in rows]
    return ["| figure | simulated | real |", "|---|---:|---:|", *lines]


def shape_rows() -> list[Row]:
    rows: list[Row] = [
        ("scans", lambda p: f"{p.scans}"),
        ("points a scan", lambda p: f"{len(p.ring) / p.scans:.0f}"),
    ]
    for low in range(0, RINGS, 16):
        name = f"rings {low}-{low + 15}"
        rows.append((f"returns a ring, {name}", partial(returns, low=low)))
        rows.append((f"median range, {name}", partial(middle_range, low=low)))
    return rows


def range_rows() -> list[Row]:
    rows: list[Row] = []
    for name in ("road", "building", "terrain", "car", "vegetation"):
        for span in SPANS[:3]:
            rows.append((f"range noise, {name}, {span[0]}-{span[1]} m", partial(noise, name=name, span=span)))
    for span in SPANS:
        rows.append((f"single returns missing, {span[0]}-{span[1]} m", partial(lost, span=span)))
    for number, name in enumerate(("0.5-1.5 m", "3-30 m")):
        rows.append((f"edges of {name} with a point between", partial(mixed, number=number)))
    return rows


def remission_rows() -> list[Row]:
    rows: list[Row] = []
    for name in CLASSES:
        rows.append((f"remission of {name} within 25 m: quartiles; zeros", partial(quartiles, name=name)))
    spans = ", ".join(f"{low}-{high}" for low, high in SPANS)
    for name in ("road", "building", "vegetation"):
        rows.append((f"mean remission of {name}, {spans} m", partial(fading, name=name)))
    return rows


def returns(p: Points, low: int) -> str:
    return f"{((p.ring >= low) & (p.ring < low + 16)).sum() / p.scans / 16:.0f}"


def middle_range(p: Points, low: int) -> str:
    return f"{np.median(p.distance[(p.ring >= low) & (p.ring < low + 16)]):.1f} m"


def noise(p: Points, name: str, span: tuple[int, int]) -> str:
    paired, residual = neighbours(p)
    return f"{1e3 * spread(residual[paired & p.of(name) & p.within(span)]):.1f} mm"


def lost(p: Points, span: tuple[int, int]) -> str:
    even, gone = missing(p)
    gone = gone[even & p.within(span)]
    return f"{100 * gone.sum() / max((gone + 1).sum(), 1):.2f} %"


def mixed(p: Points, number: int) -> str:
    edges, inside = between(p)[number]
    return f"{100 * inside / max(edges, 1):.1f} %"


def quartiles(p: Points, name: str) -> str:
    values = p.remission[p.of(name) & (p.distance < 25)]
    if len(values) < 100:
        return "-"
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{low:.2f} {middle:.2f} {high:.2f}; {100 * (values == 0).mean():.0f} %"


def fading(p: Points, name: str) -> str:
    values = [p.remission[p.of(name) & p.within(span)] for span in SPANS]
    return " ".join(f"{v.mean():.2f}" if len(v) > 50 else "-" for v in values)


def raster(points: np.ndarray, channel: str, size: tuple[int, int] = (1000, 128)) -> Image.Image:
    """One scan, ring over azimuth (straight ahead in the middle): log range or remission."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    ring = np.concatenate([[0], np.cumsum(np.diff(azimuth) < -180)]).clip(0, RINGS - 1)
    column = ((180 - azimuth) % 360 / 360 * 1000).astype(int).clip(0, 999)
    image = np.zeros((RINGS, 1000), dtype=np.uint8)
    distance = np.linalg.norm(points[:, :3], axis=1)
    value = points[:, 3] * 1.6 if channel == "remission" else np.log(np.maximum(distance, 1)) / np.log(80)
    image[ring, column] = (40 + 215 * np.clip(value, 0, 1)).astype(np.uint8)
    return Image.fromarray(image).convert("RGB").resize(size, Image.Resampling.NEAREST)


def above(points: np.ndarray, side: int = 500, reach: float = 30.0) -> Image.Image:
    """One scan from above, forward is up, brightness is remission."""
    near = np.abs(points[:, :2]).max(axis=1) < reach
    x, y = (((reach - points[near, axis]) / (2 * reach) * side).astype(int).clip(0, side - 1) for axis in (0, 1))
    image = np.zeros((side, side), dtype=np.uint8)
    np.maximum.at(image, (x, y), (50 + 205 * np.clip(points[near, 3] * 1.6, 0, 1)).astype(np.uint8))
    return Image.fromarray(image).convert("RGB")


def chart(title: str, simulated: np.ndarray, real: np.ndarray, ends: tuple[str, str]) -> Image.Image:
    """Two curves over the same places, from zero to the greater of both."""
    wide, high = 330, 150
    image = Image.new("RGB", (wide, high), "white")
    draw = ImageDraw.Draw(image)
    top = max(float(np.nanmax(simulated)), float(np.nanmax(real)), 1e-9)
    for curve, colour in ((real, REAL), (simulated, SIMULATED)):
        x = np.linspace(8, wide - 8, len(curve))
        y = high - 16 - np.nan_to_num(curve) / top * (high - 44)
        draw.line(list(zip(x.tolist(), y.tolist(), strict=True)), fill=colour, width=2)
    draw.text((8, 3), f"{title} (top {top:.3g})", fill="black")
    draw.text((8, high - 14), ends[0], fill="gray")
    draw.text((wide - 8 - 6 * len(ends[1]), high - 14), ends[1], fill="gray")
    return image


def charts(simulated: Points, real: Points) -> list[Image.Image]:
    def paired(figure: Callable[[Points], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        return figure(simulated), figure(real)

    def histogram(p: Points, name: str) -> np.ndarray:
        values = p.remission[p.of(name)] if name else p.remission
        counts, _ = np.histogram(values, bins=np.arange(-0.005, 1.02, 0.03))  # three whole hundredths a bin
        return counts / max(len(values), 1)

    def per_ring(p: Points) -> np.ndarray:
        return np.bincount(p.ring, minlength=RINGS) / p.scans

    def ring_range(p: Points) -> np.ndarray:
        return np.array([np.median(r) if len(r := p.distance[p.ring == ring]) else 0.0 for ring in range(RINGS)])

    def ring_remission(p: Points) -> np.ndarray:
        near = p.distance < 25
        return np.array([v.mean() if len(v := p.remission[near & (p.ring == ring)]) else 0.0 for ring in range(RINGS)])

    def by_range(p: Points) -> np.ndarray:
        return np.histogram(p.distance, bins=np.arange(0, 81, 2))[0] / len(p.distance)

    rings = ("top ring", "lowest")
    out = [
        chart("returns a ring", *paired(per_ring), rings),
        chart("median range a ring, m", *paired(ring_range), rings),
        chart("mean remission a ring, within 25 m", *paired(ring_remission), rings),
        chart("share of points by range", *paired(by_range), ("0 m", "80 m")),
    ]
    for name in ("", *CLASSES):
        curves = (histogram(simulated, name), histogram(real, name))
        out.append(chart(f"remission, {name or 'all'}", *curves, ("0", "1")))
    return out


def figure_sheet(simulated: Points, real: Points) -> Image.Image:
    drawn = charts(simulated, real)
    rows = -(-len(drawn) // 3)
    sheet = Image.new("RGB", (1000, 20 + 4 * 132 + 524 + rows * 154), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((8, 4), "simulated", fill=SIMULATED)
    draw.text((80, 4), "real", fill=REAL)
    draw.text((120, 4), "range of a simulated scan, of a real one; remission of both; both from above", fill="black")
    for row, (points, channel) in enumerate((p, c) for c in ("range", "remission") for p in (simulated, real)):
        sheet.paste(raster(points.first, channel), (0, 20 + row * 132))
    top = 20 + 4 * 132
    sheet.paste(above(simulated.first), (0, top))
    sheet.paste(above(real.first), (500, top))
    for number, image in enumerate(drawn):
        sheet.paste(image, (number % 3 * 333, top + 524 - 20 + number // 3 * 154))
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("simulated", type=Path)
    parser.add_argument("real", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scans", type=int, default=60, help="at most so many of each")
    options = parser.parse_args()
    simulated, real = read(options.simulated, options.scans), read(options.real, options.scans)
    print("\n".join(table(simulated, real)))
    figure_sheet(simulated, real).save(options.out)


if __name__ == "__main__":
    main()
