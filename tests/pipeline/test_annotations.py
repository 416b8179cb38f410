"""Annotated panoramas, read back by others' tools and by the words of their documentation."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidar2pano.annotations import FORMS, Annotation, parse_forms, save_annotations
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES_IDS, COMMON15, THINGS
from lidar2pano.viewer.saved_frames import panorama_files
from random_weights import street
from small_panoramas import small_panorama

CAR, PERSON, OTHER, ROAD = (COMMON15.id_of(name) for name in ("car", "person", "other-vehicle", "road"))


@pytest.fixture(scope="module")
def around():
    """A road with a car, a person, a bus, a car across the seam, and one that no point has met."""
    panorama = small_panorama(scan=street())
    segments = np.full(panorama.segments.shape, ROAD, dtype=np.uint8)
    measured = np.zeros(segments.shape, dtype=bool)
    measured[::2] = True
    segments[20:40, 100:150], segments[30:60, 300:310], segments[20:60, 500:600] = CAR, PERSON, OTHER
    segments[50:70, 1132:] = segments[50:70, :30] = CAR
    segments[70:90, 800:850], measured[70:90, 800:850] = CAR, False
    confidence = np.full(segments.shape, 0.5, dtype=np.float32)
    confidence[20:40, 100:150] = 0.75
    return replace(
        panorama, segments=segments, measured=measured, confidence=confidence, depth_m=np.full_like(confidence, 10)
    )


@pytest.fixture(scope="module")
def written(around, tmp_path_factory):
    out = tmp_path_factory.mktemp("annotated")
    return out, save_annotations(around, out, "my_scan", FORMS)


def test_each_form_has_its_files(written):
    out, files = written
    names = ["my_scan.panoptic.json", "my_scan.panoptic.png", "my_scan.txt"]
    cityscapes = [f"my%5Fscan_000000_000000_gtFine_{kind}.png" for kind in ("labelIds", "instanceIds")]
    assert sorted(path.name for path in files) == sorted(names + cityscapes)
    (out / "my_scan.png").write_bytes((out / "my_scan.panoptic.png").read_bytes())
    assert [path.name for path in panorama_files(out)] == ["my_scan.png"]


def test_pycocotools_reads_coco(written, around):
    """Its index knows boxes, not panoptic images: images and categories are indexed, masks measured by it."""
    coco_tool = pytest.importorskip("pycocotools.coco")
    mask_tool = pytest.importorskip("pycocotools.mask")
    out, _ = written
    coco = coco_tool.COCO()
    data = json.loads((out / "my_scan.panoptic.json").read_text())
    (annotation,) = data.pop("annotations")
    coco.dataset = data
    coco.createIndex()
    (image,) = coco.loadImgs(annotation["image_id"])
    assert (image["file_name"], image["height"], image["width"]) == ("my_scan.png", 96, 1152)
    pixels = np.asarray(Image.open(out / annotation["file_name"])).astype(np.int64)
    values = pixels @ [1, 256, 256**2]  # as panopticapi's rgb2id
    segments = {segment["id"]: segment for segment in annotation["segments_info"]}
    assert set(np.unique(values)) == set(segments)
    for value, segment in segments.items():
        mask = mask_tool.encode(np.asfortranarray(values == value, dtype=np.uint8))
        assert segment["area"] == mask_tool.area(mask)
        assert segment["bbox"] == mask_tool.toBbox(mask).tolist()
        (category,) = coco.loadCats(segment["category_id"])
        assert set(around.segments[values == value]) == {COMMON15.id_of(category["name"])}
    found = [(coco.cats[s["category_id"]]["name"], s["iscrowd"], s["score"], s["measured"]) for s in segments.values()]
    assert sorted(found) == [
        ("car", 0, 0.5, 0.5),  # across the seam
        ("car", 0, 0.75, 0.5),
        ("car", 1, 0.5, 0.0),  # without a point: the class alone
        ("other-vehicle", 0, 0.5, 0.5),
        ("person", 0, 0.5, 0.5),
        ("road", 0, 0.5, 0.5),
    ]
    assert {category["name"] for category in coco.cats.values() if category["isthing"]} == {
        COMMON15.classes[thing] for thing in THINGS
    }


def test_images_that_are_put_together_have_numbers_of_their_own(around):
    numbers = {Annotation(around).coco(stem, f"{stem}.png")["images"][0]["id"] for stem in ("a", "b", "c")}
    assert len(numbers) == 3 and all(0 < number < 2**53 for number in numbers)


def test_cityscapes_has_its_names_and_values(written, around):
    """The conventions of cityscapesscripts: getCsFileInfo's four underscores, id x 1000 + number, see labels.py."""
    out, _ = written
    city, sequence, frame, kind, part = Path("my%5Fscan_000000_000000_gtFine_labelIds.png").stem.split("_")
    assert (sequence, frame, kind, part) == ("000000", "000000", "gtFine", "labelIds")
    labels = np.asarray(Image.open(out / f"{city}_000000_000000_gtFine_labelIds.png"))
    instances = np.asarray(Image.open(out / f"{city}_000000_000000_gtFine_instanceIds.png")).astype(int)
    ids = {"car": 26, "person": 24, "road": 7, "dynamic": 5}  # as cityscapesscripts numbers them
    assert all(CITYSCAPES_IDS.id_of(name) == number for name, number in ids.items())
    for name, theirs in (("car", "car"), ("person", "person"), ("road", "road"), ("other-vehicle", "dynamic")):
        assert set(labels[around.segments == COMMON15.id_of(name)]) == {ids[theirs]}
    assert set(np.unique(instances)) == {26000, 26001, 26, 24000, 7, 5}
    big = instances >= 1000
    assert np.array_equal(instances[big] // 1000, labels[big]) and np.array_equal(instances[~big], labels[~big])


def test_yolo_has_a_box_for_each_instance_and_two_across_the_seam(written):
    """Ultralytics' text format: class x_center y_center width height, in parts of the image, one line a box."""
    out, _ = written
    lines = [line.split() for line in (out / "my_scan.txt").read_text().splitlines()]
    boxes = set()
    for word, *numbers in lines:
        assert word.isdecimal() and all(re.fullmatch(r"0\.\d{6}|1\.000000", number) for number in numbers)
        x, y, width, height = (float(n) * size for n, size in zip(numbers, (1152, 96, 1152, 96), strict=True))
        corners = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        boxes.add((COMMON15.classes[THINGS[int(word)]], *(round(corner) for corner in corners)))
    assert boxes == {
        ("car", 100, 20, 150, 40),
        ("person", 300, 30, 310, 60),
        ("other-vehicle", 500, 20, 600, 60),
        ("car", 1132, 50, 1152, 70),
        ("car", 0, 50, 30, 70),
    }


def test_nothing_that_is_painted_is_read(around, tmp_path):
    repainted = replace(around, colour=255 - around.colour)
    first, second = (save_annotations(p, tmp_path / n, "a", FORMS) for p, n in ((around, "x"), (repainted, "y")))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_a_panorama_without_confidence_and_points_claims_none(around):
    segments = Annotation(replace(around, confidence=None, measured=None)).segments
    assert {segment["score"] for segment in segments} == {None} and {segment["measured"] for segment in segments} == {
        0.0
    }


def test_an_unknown_form_is_one_line(capsys):
    assert parse_forms("yolo, coco") == ("coco", "yolo") and parse_forms("") == ()
    with pytest.raises(InputError, match="--annotations: no form 'voc'; there is cityscapes, coco, yolo"):
        parse_forms("coco,voc")
    assert main(["translate", "scan.bin", "--annotations", "voc"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_translate_writes_them_and_keeps_a_scan_of_text(random_weights, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savetxt("a.txt", np.column_stack([street().xyz, street().remission]))
    before = Path("a.txt").read_bytes()
    words = ["translate", "a.txt", "--weights", str(random_weights), "--device", "cpu", "--annotations", "coco,yolo"]
    assert main([*words, "--json"]) == 0
    outputs = json.loads(capsys.readouterr().out)["outputs"]
    assert [Path(path).name for path in outputs] == ["a.png", "a.panoptic.json", "a.panoptic.png", "a.txt"]
    assert all(Path(path).is_file() for path in outputs)
    assert main([*words, "--out", "."]) == 2
    assert "would be replaced by its own annotation" in capsys.readouterr().err
    assert Path("a.txt").read_bytes() == before
