"""Write RESULTS.md from the scores in docs/results: python runs/results.py.

`runs/results.sh` measures them: CSV files of `lidar2pano evaluate`, and texts of other scripts.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, NamedTuple

from lidar2pano.evaluate.report import Row, entry_cell, number_cell
from lidar2pano.labels import COMMON14
from lidar2pano.markdown import markdown_table
from lidar2pano.reproduce.paper_tables import ROWS as PAPER

ROOT = Path(__file__).resolve().parent.parent
SCORES = ROOT / "docs" / "results"
FAMILIES = ("streets", "world")
MEASURED_BY = {"without-pandaset": "streets"}  # runs that have not seen a place stand for the family that has
PUBLISHED = {"TITAN-Net": PAPER["titan"], "TITAN-Next": PAPER["titan-next"]}
Scores = dict[tuple[str, str, str], dict[str, Any]]  # (system, sector, metric) -> value, low, high, frames


class Headline(NamedTuple):
    """A row of the first table: the set, sector and metric, how it is shown, and the suffix of the system's name."""

    scores: str
    sector: str
    metric: str
    row: Row
    suffix: str = ""


SETS = {
    "val": "KITTI",
    "towns": "towns",
    "tall": "tall towns",
    "pandaset": "PandaSet",
    "nuscenes": "nuScenes",
    "labelled": "SemanticKITTI",
}
HEADLINES = (
    Headline("val", "camera", "miou", Row("camera: mIoU of 14 classes, %", 1, 100, interval=True)),
    Headline("val", "camera", "accuracy", Row("camera: accuracy, %", 1, 100, interval=True)),
    Headline("val", "camera", "ssim", Row("camera: SSIM", 3, interval=True)),
    Headline("val", "camera", "swd_pairs", Row("camera: SWD of image pairs", 2, interval=True)),
    Headline("val", "camera", "fid", Row("camera: FID", 1)),
    Headline("val", "camera", "patch_frechet_ratio", Row("camera: patch Frechet / real-to-real", 2, interval=True)),
    Headline("val", "points", "miou", Row("points: mIoU of 19 classes, %", 1, 100, interval=True)),
    Headline("towns", "panorama", "miou", Row("all around: mIoU of 14 classes, %", 1, 100, interval=True)),
    Headline("towns", "panorama", "depth_abs_rel", Row("all around: depth AbsRel", 3, interval=True)),
    Headline(
        "towns", "panorama", "warping_error", Row("video: warping error x 1000", 1, 1000, interval=True), "+steady"
    ),
    Headline("pandaset", "panorama", "miou", Row("all around: mIoU of 10 classes, %", 1, 100, interval=True)),
)
COLUMNS = {
    "miou": Row("mIoU"),
    "accuracy": Row("accuracy"),
    "ssim": Row("SSIM"),
    "swd_pairs": Row("SWD of pairs", 2),
    "swd": Row("SWD x 1000", 1),
    "patch_frechet_ratio": Row("patch Frechet ratio", 2),
    "patch_frechet_halved_ratio": Row("of half size", 2),
    "edge_frechet_ratio": Row("of edge features", 2),
    "edge_frechet_halved_ratio": Row("of both", 2),
    "depth_abs_rel": Row("depth AbsRel"),
    "depth_rmse_m": Row("depth RMSE, m", 1),
    "warping_error": Row("warping error x 1000", 1, 1000),
    "seam_ratio": Row("seam ratio", 2),
}
COMPARABLE = """
Higher is better for mIoU, accuracy and SSIM, lower for the others. In brackets: 95 % intervals over frames. TITAN-Net
and TITAN-Next: published values, on SemanticKITTI's validation sequence, with the authors' camera labels.

- **KITTI**: {val} street images (`val` of kitti-mini). The camera's rows have the paper's definitions and may be
  compared with its columns as orders of magnitude, not digit by digit: the images are others, and few. Labels are
  predictions of other networks, as in the paper. Earlier stages of `streets` were chosen by these images, which
  flatters it; the last one was not: it was compared on streets that its runs had not seen (below). `world` has seen
  no scan and no image of KITTI.
- **towns**: {towns} frames of simulated streets that no network was trained on, the only ground truth all around. There
  are no published scores of panoramas to compare with. The warping error is that of `NAME+steady`, which is given the
  sensor's poses; the ground truth's own is {still}.
- **tall towns**: {tall} frames of simulated town centres as an OS1-128 sees them, from -32 to 24 degrees
  (`--elevation=-32,24`); no network was trained on them.
- **PandaSet**: {pandaset} frames of one street, Pandar64 and six cameras. It teaches both families: `streets` is
  therefore measured by networks that were not shown the place, a segmenter from before its last stage and a translator
  of the last one (but for taller panoramas), and `world` not at all.
- Depths are compared with ground truth on towns alone: elsewhere the target is the very scan that the system was given.
- FID needs Inception's published weights (`evaluate --inception FILE`). SWD of image pairs says little: unrelated
  photographs of KITTI are at 2.6. The patch Frechet distance compares textures; 1 is as far as real images
  are from each other. Its features are EfficientNet-Lite2's (the painters were trained against its smaller sister
  Lite0) and, as edge features, those of VGG-16 fine-tuned on edges (HED), on images of full and of half size.
"""
TEXTS = {
    "folds": "A street of KITTI that networks have not seen: `before` and after the last stage of the translator",
    "unseen": "Streets of KITTI, of which `world` has seen none",
    "beams": "Fewer beams: every, every second and every fourth beam of the scans of KITTI",
    "remission": "Without remission: mIoU of point classes with constants in its place",
    "memory": "Numbers of the memory of streams (memory.py), each changed alone, on a simulated drive",
    "depth": "Numbers of measured depths (depth.py), each changed alone: hidden points of real scans, and towns",
    "evidence": "Evidence beside the translator's classes",
    "times": "Times",
}


def read_scores(path: Path) -> Scores:
    """Return the values of a CSV file of `lidar2pano evaluate`; empty values are None. No file has no values.

    Runs of MEASURED_BY have their family's name.
    """
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as file:
        return {
            (MEASURED_BY.get(line["system"], line["system"]), line["sector"], line["metric"]): {
                name: float(line[name]) if line[name] else None for name in ("value", "low", "high", "frames")
            }
            for line in csv.DictReader(file)
        }


def first_table(scores: dict[str, Scores]) -> str:
    """Return the headline numbers of the families beside the published ones."""
    rows = []
    for number in HEADLINES:
        ours = [
            scores[number.scores].get((f"{family}{number.suffix}", number.sector, number.metric)) for family in FAMILIES
        ]
        published = [
            row.miou if number.metric == "miou" else row.paper.get(number.metric) for row in PUBLISHED.values()
        ]
        theirs = [
            f"{value:g}" if value and number.scores == "val" and number.sector == "camera" else "-"
            for value in published
        ]
        if number.metric == "fid" and not any(ours):
            cells = ["not measured"] * len(ours)
        else:
            cells = [entry_cell(entry, number.row) for entry in ours]
        rows.append([number.row.title, SETS[number.scores], *cells, *theirs])
    return markdown_table(["", "measured on", *(f"`{family}`" for family in FAMILIES), *PUBLISHED], rows)


def class_table(scores: Scores) -> str:
    """Return the camera's IoU by class, in percent."""
    row, rows = Row("", 1, 100), []
    for number, name in enumerate(COMMON14.classes[1:]):
        ours = [entry_cell(scores.get((family, "camera", f"iou {name}")), row) for family in FAMILIES]
        rows.append([name, *ours, f"{PUBLISHED['TITAN-Net'].classes[number]:g}"])
    return markdown_table(["class", *(f"`{family}`" for family in FAMILIES), "TITAN-Net"], rows)


def sector_table(scores: dict[str, Scores], sector: str) -> str:
    """Return a row per set and system with the sector's values."""
    metrics = [
        name for name in COLUMNS if any(key[1:] == (sector, name) for values in scores.values() for key in values)
    ]
    rows = []
    for name, values in scores.items():
        for system in dict.fromkeys(
            system for system, owner, _ in values if owner == sector and not (sector == "points" and "+" in system)
        ):
            cells = [entry_cell(values.get((system, sector, metric)), COLUMNS[metric]) for metric in metrics]
            rows.append([SETS[name], system, *cells])
    return markdown_table(["measured on", "system", *(COLUMNS[metric].title for metric in metrics)], rows)


def page(scores: dict[str, Scores], texts: dict[str, str]) -> str:
    """Return RESULTS.md."""
    frames = {
        name: max((entry["frames"] or 0 for key, entry in values.items() if key[2] == "miou"), default=0)
        for name, values in scores.items()
    }
    still = scores["towns"].get(("ground truth", "panorama", "warping_error"), {"value": None})["value"]
    notes = COMPARABLE.format(
        **{name: f"{count:.0f}" for name, count in frames.items()},
        still=number_cell(None if still is None else 1000 * still, 1),
    )
    parts = ["# Results", "Written by `runs/results.sh`; not edited by hand.", first_table(scores), notes.strip()]
    links = ", ".join(f"[{SETS[name]}](docs/results/{name}.csv)" for name in scores)
    parts += [f"Every value with its interval and class as CSV: {links}."]
    sections = {
        "Classes in KITTI's camera: IoU in percent": class_table(scores["val"]),
        "In the camera": sector_table(scores, "camera"),
        "All around": sector_table(scores, "panorama"),
        "Points": sector_table(scores, "points"),
    }
    sections |= {TEXTS[name]: text.strip() for name, text in texts.items()}
    parts += [f"## {title}\n\n{text}" for title, text in sections.items()]
    return "\n\n".join(parts) + "\n"


def text() -> str:
    """Return RESULTS.md of the files in docs/results."""
    scores = {name: read_scores(SCORES / f"{name}.csv") for name in SETS}
    files = {name: SCORES / f"{name}.txt" for name in TEXTS}
    texts = {name: file.read_text(encoding="utf-8") for name, file in files.items() if file.is_file()}
    return page(scores, texts)


def main() -> None:
    """Write RESULTS.md."""
    (ROOT / "RESULTS.md").write_text(text(), encoding="utf-8")


if __name__ == "__main__":
    main()
