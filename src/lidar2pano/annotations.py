"""Panoramas as annotated images: COCO panoptic, Cityscapes' label images, YOLO's boxes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import COLOUR_FORMATS, write_ids, write_png, write_whole
from lidar2pano.labels import CITYSCAPES_IDS, COMMON15, THINGS
from lidar2pano.panorama import Panorama, Writer
from lidar2pano.scene.surfaces import thing_instances

FORMS = ("coco", "cityscapes", "yolo")
# Cityscapes has buses, trains, caravans and trailers, and no class for all of them: "dynamic", which is not scored.
TO_CITYSCAPES = COMMON15.table_to(CITYSCAPES_IDS, {"other-vehicle": "dynamic", "traffic-sign": "traffic sign"})
CITYSCAPES_THINGS = tuple(CITYSCAPES_IDS.id_of(name) for name in ("person", "car", "truck", "motorcycle", "bicycle"))
MOST_INSTANCES = 1000  # of a class: an instance's value is the class's id x 1000 and its number


@dataclass(frozen=True, eq=False)
class Annotation:
    """A panorama's segments, by its classes, depth, confidence and points alone: nothing that was painted is read."""

    panorama: Panorama

    @cached_property
    def values(self) -> np.ndarray:
        """(h, w) int32: each pixel's segment: the class, or behind the classes the number of the instance; 0: none."""
        segments, measured = self.panorama.segments, self.panorama.measured
        measured = np.ones(segments.shape, dtype=bool) if measured is None else measured
        instances = thing_instances(segments, self.panorama.depth_m, measured, circular=self.panorama.view.circular)
        return np.where(instances > 0, instances + (len(COMMON15) - 1), segments).astype(np.int32)

    @cached_property
    def segments(self) -> list[dict[str, Any]]:
        """All instances of things, and of other pixels all of a class, as COCO's segments_info, in order of their ids.

        id       in `values`;  iscrowd: whether it may be several things.
        score    mean confidence of its pixels, None where it is not known;  measured: share with a point of the scan.
        """
        value, counts = np.unique(self.values, return_counts=True)
        pixels = np.split(np.argsort(self.values, axis=None, kind="stable"), counts.cumsum()[:-1])
        return [self._segment(int(number), part) for number, part in zip(value, pixels, strict=True) if number]

    def _segment(self, value: int, pixels: np.ndarray) -> dict[str, Any]:
        row, column = np.divmod(pixels, self.values.shape[1])
        confidence, measured = self.panorama.confidence, self.panorama.measured
        category = int(self.panorama.segments[row[0], column[0]])
        x, y = int(column.min()), int(row.min())
        return {
            "id": value,
            "category_id": category,
            "iscrowd": int(category in THINGS and not is_instance(value)),
            "area": len(row),
            "bbox": [x, y, int(column.max()) - x + 1, int(row.max()) - y + 1],
            "score": None if confidence is None else round(float(confidence[row, column].mean()), 4),
            "measured": 0.0 if measured is None else round(float(measured[row, column].mean()), 4),
        }

    def coco(self, stem: str, image: str) -> dict[str, Any]:
        """Return the JSON of COCO panoptic for this one image, whose file is called `image`."""
        rows, columns = self.values.shape
        number = int(hashlib.sha256(os.fsencode(stem)).hexdigest()[:12], 16)  # differs among images put together
        categories = [
            {"id": index, "name": name, "supercategory": name, "isthing": int(index in THINGS), "color": list(colour)}
            for index, (name, colour) in enumerate(zip(COMMON15.classes, COMMON15.colours, strict=True))
            if index
        ]
        annotation = {"image_id": number, "file_name": f"{stem}.panoptic.png", "segments_info": self.segments}
        images = [{"id": number, "file_name": image, "height": rows, "width": columns}]
        return {"images": images, "annotations": [annotation], "categories": categories}

    def panoptic_image(self) -> np.ndarray:
        """Return the values (h, w, 3) uint8 as COCO writes them: red + 256 green + 65536 blue."""
        return np.stack([self.values >> shift & 0xFF for shift in (0, 8, 16)], -1).astype(np.uint8)

    @cached_property
    def cityscapes(self) -> tuple[np.ndarray, np.ndarray]:
        """Cityscapes' label ids (h, w) uint8, and its instance ids (h, w) uint16."""
        labels = TO_CITYSCAPES[self.panorama.segments]
        table, counts = np.zeros(self.values.max() + 1, dtype=np.uint16), dict.fromkeys(CITYSCAPES_THINGS, 0)
        for segment in self.segments:
            label = table[segment["id"]] = int(TO_CITYSCAPES[segment["category_id"]])
            if is_instance(segment["id"]) and label in counts and counts[label] < MOST_INSTANCES:
                table[segment["id"]] = label * 1000 + counts[label]
                counts[label] += 1
        return labels, table[self.values]

    def yolo(self) -> str:
        """Return a line for every instance: class (its place in THINGS), centre and size, in parts of the image.

        One across the panorama's seam has a box at either edge.
        """
        rows, columns = self.values.shape
        lines = [
            f"{THINGS.index(segment['category_id'])} {(x + w / 2) / columns:.6f} {(y + h / 2) / rows:.6f}"
            f" {w / columns:.6f} {h / rows:.6f}\n"
            for segment in self.segments
            if is_instance(segment["id"])
            for x, y, w, h in self._parts(segment["id"], *segment["bbox"])
        ]
        return "".join(lines)

    def _parts(self, value: int, x: int, _: int, width: int, __: int) -> Iterator[tuple[int, int, int, int]]:
        """Yield the boxes of an instance's parts left and right of a gap of empty columns across the middle."""
        inside = self.values[:, x : x + width] == value
        empty = np.flatnonzero(~inside.any(0))
        crosses = width == self.values.shape[1] and len(empty)
        for part in (slice(0, empty[0]), slice(empty[-1] + 1, width)) if crosses else (slice(0, width),):
            row, column = np.nonzero(inside[:, part])
            left, top = x + part.start + int(column.min()), int(row.min())
            yield left, top, int(np.ptp(column)) + 1, int(np.ptp(row)) + 1


def is_instance(value: int) -> bool:
    """Whether a segment is an instance: values behind the classes are."""
    return value >= len(COMMON15)


def parse_forms(text: str) -> tuple[str, ...]:
    """Return the forms of a list such as "coco,yolo"; InputError for an unknown one."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if unknown := [name for name in names if name not in FORMS]:
        raise InputError(f"--annotations: no form {unknown[0]!r}{closest(unknown[0], FORMS)}")
    return tuple(form for form in FORMS if form in names)


def save_annotations(
    panorama: Panorama,
    out: Path,
    stem: str,
    forms: Sequence[str],
    image_format: str = "png",
    source: Path | None = None,
) -> list[Path]:
    """Write a panorama's annotations beside its image <stem>.png, each complete or not at all; return their paths.

    coco        <stem>.panoptic.json and <stem>.panoptic.png;
    cityscapes  <stem>_000000_000000_gtFine_labelIds.png and ..._instanceIds.png, the stem's own "_" as %5F;
    yolo        <stem>.txt.
    source      the scan's file, which is not replaced. Raises InputError where one cannot be written.
    """
    written = []
    for form, name, write in _files(Annotation(panorama), stem, image_format):
        if form not in forms:
            continue
        if source is not None and (out / name).resolve() == source.resolve():
            raise InputError(f"{source}: would be replaced by its own annotation; choose another --out")
        written.append(write_whole(out / name, write))
    return written


def _files(annotation: Annotation, stem: str, image_format: str) -> Iterator[Writer]:
    """Yield the form, name and writing function of every file; texts are ASCII."""
    image = stem + COLOUR_FORMATS[image_format][0]
    yield "coco", f"{stem}.panoptic.json", lambda path: path.write_text(json.dumps(annotation.coco(stem, image)) + "\n")
    yield "coco", f"{stem}.panoptic.png", lambda path: write_png(path, annotation.panoptic_image())
    city = stem.replace("%", "%25").replace("_", "%5F") + "_000000_000000_gtFine"
    yield "cityscapes", f"{city}_labelIds.png", lambda path: write_ids(path, annotation.cityscapes[0])
    yield "cityscapes", f"{city}_instanceIds.png", lambda path: write_ids(path, annotation.cityscapes[1])
    yield "yolo", f"{stem}.txt", lambda path: path.write_text(annotation.yolo())
