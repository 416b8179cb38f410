"""Draw the diagrams of the documentation from the package's own tables: python runs/diagrams.py.

docs/images/stages.svg   the four stages, with the shapes that pass between them
docs/images/frame.svg    the sensor frame seen from above, and where azimuths lie on a raster
docs/images/rasters.jpg  the demo scan on the segmenter's sphere and on the panorama's cylinder
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyBboxPatch

from lidar2pano import VIEWS, View, demo, project, read

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "images"
INK, FILL, ACCENT = "#37474f", "#eceff1", "#e65100"
STYLE = {
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": INK,
    "svg.fonttype": "none",  # text stays text, in the font of the reader
    "svg.hashsalt": "lidar2pano",  # the same bytes each time
}


def raster(view: View) -> str:
    """Rows x columns of a view."""
    return f"{view.rows} x {view.columns}"


def stages(path: Path) -> None:
    """Boxes for the stages; arrows carry what passes between them."""
    sphere, panorama = VIEWS["hdl64e"], VIEWS["panorama"]
    half = panorama.scaled(0.5)
    boxes = [
        ("scan", "N x 4\nx, y, z, remission"),
        ("project", f"sphere {raster(sphere)}\ncylinder {raster(half)}"),
        ("segment", "SalsaNext\n+ 5-neighbour vote\n20 classes per point"),
        ("translate", f"titan-pano\n15 classes + depth\n{raster(half)}"),
        ("paint", f"painter\nRGB {raster(panorama)}"),
    ]
    figure, axes = plt.subplots(figsize=(10, 1.7))
    for number, (title, text) in enumerate(boxes):
        left = number * 2.0
        axes.add_patch(FancyBboxPatch((left, 0), 1.6, 1, boxstyle="round,pad=0.04", facecolor=FILL, edgecolor=INK))
        axes.text(left + 0.8, 0.8, title, ha="center", va="center", fontweight="bold")
        axes.text(left + 0.8, 0.36, text, ha="center", va="center", fontsize=8)
        if number:
            axes.annotate("", (left - 0.05, 0.5), (left - 0.35, 0.5), arrowprops={"arrowstyle": "->", "color": ACCENT})
    axes.set(xlim=(-0.1, 9.7), ylim=(-0.1, 1.1))
    axes.axis("off")
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


def frame(path: Path) -> None:
    """The sensor frame from above beside the columns of a full raster."""
    figure, (above, columns) = plt.subplots(1, 2, figsize=(10, 3), width_ratios=(1, 2.2))
    above.add_patch(plt.Circle((0, 0), 1, fill=False, color=INK, linestyle=":"))
    for (x, y), name in (((0, 1), "x: forward, azimuth 0"), ((-1, 0), "y: left, +90")):
        above.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "color": ACCENT, "linewidth": 2})
        above.text(x * 1.08, y * 1.08 + 0.02, name, ha="right" if x else "center", va="bottom")
    above.text(1.08, 0.02, "-90", va="bottom")
    above.text(0, -1.2, "behind, +180 = -180", ha="center")
    above.text(0.08, -0.16, "z: up", color=ACCENT)
    above.set(xlim=(-2.1, 1.5), ylim=(-1.35, 1.35), aspect="equal")
    above.axis("off")
    columns.set(xlim=(180, -180), ylim=(1, 0), yticks=[], xlabel="azimuth, degrees (counter-clockwise from x)")
    columns.set_xticks(range(180, -181, -45))
    for azimuth, name in ((180, "behind"), (90, "left"), (0, "ahead"), (-90, "right"), (-180, "behind")):
        columns.text(azimuth, 0.5, name, ha="center")
        columns.axvline(azimuth, color=ACCENT, alpha=0.4)
    columns.text(174, 0.1, "row 0, column 0", ha="left", fontsize=8)
    columns.set_title("columns of a full raster, left to right", fontsize=10)
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


def rasters(path: Path) -> None:
    """Ranges of the demo scan on both rasters."""
    scan = read(demo.street())
    sphere, cylinder = VIEWS["hdl64e"], VIEWS["panorama"].scaled(0.5)
    figure, axes = plt.subplots(2, 1, figsize=(10, 4.4), layout="constrained")
    for one, view, unit in ((axes[0], sphere, "elevation, degrees"), (axes[1], cylinder, "tan(elevation)")):
        image = project(scan, view)
        ranges = np.where(image.valid.numpy(), image.channels[0].numpy(), np.nan)
        one.imshow(ranges, cmap="viridis_r", vmax=40, aspect="auto", extent=(180, -180, view.down, view.up))
        one.set(title=f"{view.kind}, {raster(view)}", ylabel=unit, xticks=range(180, -181, -45))
        one.axvline(0, color=ACCENT, linewidth=0.8)
    axes[1].set_xlabel("azimuth, degrees")
    figure.savefig(path, dpi=150, pil_kwargs={"quality": 82})
    plt.close(figure)


def main() -> None:
    """Draw all of them."""
    FOLDER.mkdir(exist_ok=True)
    with mpl.rc_context(STYLE):
        stages(FOLDER / "stages.svg")
        frame(FOLDER / "frame.svg")
        rasters(FOLDER / "rasters.jpg")


if __name__ == "__main__":
    main()
