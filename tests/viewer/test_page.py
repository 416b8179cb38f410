"""The page as a file: self-contained, escaped, complete; and panoramas that were saved."""

from __future__ import annotations

import base64
import hashlib
import html.parser
import io
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lidar2pano
from lidar2pano.demo import street as demo_street
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_png
from lidar2pano.labels import COMMON15
from lidar2pano.viewer.page import CONFIDENCE_STEPS, PageWriter, facts_of, title_of
from lidar2pano.viewer.saved_frames import panorama_files, read_frame, saved_view
from lidar2pano.views import VIEWS
from random_weights import street
from small_panoramas import VIEW, page_frame, small_panorama

HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror=alert(1)>{{data}}&amp;\u2028'\"\udcff"


class Elements(html.parser.HTMLParser):
    """All elements of a page, with attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), ""))

    def handle_endtag(self, tag):
        self.found.append(("", {}, ""))  # what follows is not the element's text

    def handle_data(self, data):
        if self.found:
            tag, attributes, text = self.found[-1]
            self.found[-1] = tag, attributes, text + data

    def of(self, tag: str) -> list[tuple[dict[str, str | None], str]]:
        return [(attributes, text) for name, attributes, text in self.found if name == tag]


def written(tmp_path: Path, *frames, title="a title") -> str:
    writer = PageWriter(title)
    for frame in frames:
        writer.add(frame)
    path = writer.write(tmp_path / "page.html")
    writer.close()
    return path.read_text(encoding="utf-8")


def index_of(page: str) -> dict:
    (text,) = [text for attributes, text in Elements(page).of("script") if attributes.get("id") == "index"]
    return json.loads(text)


def test_the_page_holds_what_was_added(tmp_path):
    page = written(tmp_path, page_frame(0, "one"), page_frame(1, "two", camera=True))
    index, blocks = index_of(page), {a["id"]: text for a, text in Elements(page).of("script") if "id" in a}
    assert [frame["name"] for frame in index["frames"]] == ["one", "two"]
    assert [list(frame["layers"]) for frame in index["frames"]] == [
        ["colour", "classes", "depth", "confidence"],
        ["colour", "classes", "depth", "confidence", "camera", "source"],
    ]
    for seed, frame in enumerate(index["frames"]):
        block, mime = frame["layers"]["colour"]
        with Image.open(io.BytesIO(base64.b64decode(blocks[block]))) as image:
            assert mime == "image/png"
            np.testing.assert_array_equal(np.array(image), small_panorama(seed).colour)
        assert frame["view"] == pytest.approx([VIEW.up, VIEW.down, np.pi, -np.pi])
        assert frame["size"] == [96, 1152] and frame["origin"] == list(VIEW.origin)
        assert frame["points"][1:3] == [len(street())] * 2
        intensity = np.frombuffer(zlib.decompress(base64.b64decode(blocks[frame["points"][3]])), dtype=np.uint8)
        bright = np.quantile(street().remission, 0.98)
        np.testing.assert_allclose(intensity, np.clip(street().remission / bright, 0, 1) * 255, atol=0.51)
    assert [entry["name"] for entry in index["sources"]] == ["invented", "front", "camera 2"]
    assert [entry["name"] for entry in index["classes"]] == list(COMMON15.classes)
    assert index["classes"][0]["present"] is False and index["classes"][1]["present"] is True
    assert len(index["depth"]["colours"]) == 256
    assert len(index["confidence"]["colours"]) == CONFIDENCE_STEPS + 1


def test_the_page_says_what_its_panoramas_are_of(tmp_path):
    facts = facts_of("world", street())
    assert facts[0] == "weights world" and re.fullmatch(r"made \d{4}-\d\d-\d\d", facts[-1])
    writer = PageWriter("t", facts)
    writer.add(page_frame())
    text = writer.write(tmp_path / "a.html").read_text(encoding="utf-8")
    writer.close()
    assert index_of(text)["about"] == list(facts) and "colours are invented" in text
    assert [entry["name"] for entry in index_of(text)["sources"]] == ["invented"], "no camera, nothing named"


def test_the_sensor_is_among_the_facts():
    assert facts_of("w", lidar2pano.read(demo_street()))[1:3] == ("64 beams", "like Velodyne HDL-64E")


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    page = written(tmp_path, page_frame())
    elements = Elements(page)
    assert not elements.of("img") and not elements.of("iframe")
    assert [attributes["href"] for attributes, _ in elements.of("link")] == ["data:,"]
    assert not any("src" in attributes for attributes, _ in elements.of("script"))
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|fetch\(|XMLHttp|import\(", page)
    (policy,) = [a["content"] for a, _ in elements.of("meta") if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy and policy.startswith("default-src 'none'; img-src data: blob:;")
    code = [text for attributes, text in elements.of("script") if "type" not in attributes] + [
        elements.of("style")[0][1]
    ]
    assert len(code) == 2
    for text in code:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy, "the browser would refuse it"


def test_names_from_outside_are_text(tmp_path):
    page = written(tmp_path, replace(page_frame(), name=HOSTILE), title=HOSTILE)
    elements = Elements(page)
    assert not elements.of("img")
    assert sum("type" not in attributes for attributes, _ in elements.of("script")) == 1
    assert index_of(page)["frames"][0]["name"] == HOSTILE
    assert [text for _, text in elements.of("title")] == [HOSTILE.replace("\udcff", "?")]


def test_only_cylinders_and_at_least_one_frame(tmp_path):
    writer = PageWriter("t")
    with pytest.raises(InputError, match="is no cylinder"):
        writer.add(page_frame(view=VIEWS["hdl64e"]))
    with pytest.raises(ValueError, match="a page needs a frame"):
        writer.write(tmp_path / "a.html")
    writer.add(page_frame())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        writer.write(tmp_path / "file" / "a.html")
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(("frames", "mime", "columns"), [(4, "png", 1152), (5, "webp", 1152), (8, "webp", 576)])
def test_the_number_of_frames_decides_how_they_are_coded(tmp_path, monkeypatch, frames, mime, columns):
    monkeypatch.setattr("lidar2pano.viewer.page.MOST_FRAMES", 6)
    monkeypatch.setattr("lidar2pano.viewer.page.MOST_FRAMES", 6)
    page = written(tmp_path, *(replace(page_frame(seed), depth_m=None, xyz=None) for seed in range(frames)))
    index, blocks = index_of(page), {a["id"]: text for a, text in Elements(page).of("script") if "id" in a}
    assert [frame["layers"]["colour"][1] for frame in index["frames"]] == [f"image/{mime}"] * frames
    for seed, frame in enumerate(index["frames"]):
        with Image.open(io.BytesIO(base64.b64decode(blocks[frame["layers"]["classes"][0]]))) as image:
            assert image.size == (columns, columns // 12)
            skip = 1152 // columns
            np.testing.assert_array_equal(
                np.array(image)[..., 0], small_panorama(seed).segments[skip // 2 :: skip, skip // 2 :: skip]
            )


def test_titles(tmp_path):
    assert title_of([Path("/data/sequences/00/velodyne")]) == "00/velodyne"
    assert title_of([tmp_path / "a" / "b.bin", Path("c"), Path("d")]) == "a/b.bin and 2 more"
    assert title_of([Path("/")]) == ""


# --- panoramas that were saved ---------------------------------------------------------------------------------------


def test_saved_panoramas_are_frames(tmp_path):
    view = replace(VIEW, up=0.3, down=-0.25, origin=(1.0, 2.0, 3.0))
    around = replace(small_panorama(), view=view)
    around.save(tmp_path, ("rgb", "segments", "labels", "depth", "confidence"), stem="b")
    around.save(tmp_path, ("rgb",), stem="a")
    (tmp_path / "a.camera.png").write_bytes((tmp_path / "a.png").read_bytes())
    around.save_points(tmp_path / "b.ply", street())
    files = panorama_files(tmp_path)
    assert [file.name for file in files] == ["a.png", "b.png"]
    plain, whole = (read_frame(file) for file in files)
    assert (plain.name, plain.segments, plain.depth_m, plain.xyz, plain.view) == ("a", None, None, None, view)
    np.testing.assert_array_equal(whole.colour, around.colour)
    np.testing.assert_array_equal(whole.segments, around.segments)
    np.testing.assert_allclose(whole.depth_m, around.depth_m, atol=1 / 512)
    assert plain.confidence is None and whole.confidence is not None
    np.testing.assert_allclose(whole.confidence, around.confidence, atol=0.5 / 255 + 1e-6)
    assert whole.xyz is not None and whole.xyz.dtype == np.float32
    np.testing.assert_array_equal(whole.xyz, street().xyz)
    assert whole.remission is not None
    np.testing.assert_array_equal(whole.remission, street().remission)
    around.save(tmp_path, stem="c", image_format="webp")
    assert [file.name for file in panorama_files(tmp_path)] == ["a.png", "b.png", "c.webp"]
    assert panorama_files(tmp_path / "a.png") == [tmp_path / "a.png"]
    assert panorama_files(tmp_path / "none") == []


@pytest.mark.parametrize("text", [None, "{", '{"rows": 1}', "[1]", '{"rows": 2, "columns": 2, "up": 0, "down": 1}'])
def test_images_without_a_view_get_the_usual_one(tmp_path, text):
    texts = {} if text is None else {"lidar2pano-view": text}
    write_png(tmp_path / "a.png", np.zeros((96, 1152, 3), dtype=np.uint8), texts)
    assert saved_view(tmp_path / "a.png") == VIEW


def test_other_images_are_refused(tmp_path):
    write_png(tmp_path / "photo.png", np.zeros((37, 124, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="124x37 pixels are no panorama"):
        read_frame(tmp_path / "photo.png")
    small_panorama().save(tmp_path, stem="a")
    write_png(tmp_path / "a.depth.png", np.zeros((96, 1152, 3), dtype=np.uint8))
    with pytest.raises(InputError, match=r"a\.depth\.png: has colours where numbers belong"):
        read_frame(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="no readable image"):
        read_frame(tmp_path / "a.png")
