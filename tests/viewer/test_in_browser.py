"""The page in a real browser: headless Chromium, driven by Playwright, drawing by SwiftShader.

LIDAR2PANO_BROWSER names the browser's program; then these tests must run. Otherwise they run where a Chromium of the
system's own and the package `playwright` are found.
"""

from __future__ import annotations

import io
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

import numpy as np
import pytest
from PIL import Image

from lidar2pano import serve
from lidar2pano.labels import COMMON15
from lidar2pano.viewer.page import LOW_TO_HIGH, PageWriter
from small_panoramas import VIEW, page_frame, small_panorama

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PROGRAM = os.environ.get("LIDAR2PANO_BROWSER") or next(filter(None, map(shutil.which, NAMES)), "")
THERE = bool("LIDAR2PANO_BROWSER" in os.environ or (PROGRAM and find_spec("playwright")))
pytestmark = pytest.mark.needs(
    THERE, "a browser: install Chromium (apt-get install chromium) and pip install playwright"
)

FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-color-profile=srgb")
ROOT = ("--no-sandbox",) if hasattr(os, "geteuid") and os.geteuid() == 0 else ()
HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 2'>"
WIDTH, HEIGHT = 640, 480
GROUND, GREY = (20, 23, 28), (128, 128, 128)  # of the dark page, and of points that the panorama does not show
MILLISECONDS = 60_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=PROGRAM, args=[*FLAGS, *ROOT], timeout=MILLISECONDS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Path:
    """A folder with pages: one.html (exact), drive.html (six frames, lossy), hostile.html."""
    folder = tmp_path_factory.mktemp("pages")
    contents = {
        "one": [page_frame(0, "one", camera=True)],
        "drive": [page_frame(seed, f"frame {seed}") for seed in range(6)],
        "hostile": [page_frame(0, HOSTILE), page_frame(1, "b")],
    }
    for name, frames in contents.items():
        writer = PageWriter(HOSTILE if name == "hostile" else name)
        for frame in frames:
            writer.add(frame)
        writer.write(folder / f"{name}.html")
        writer.close()
    return folder


class Tab:
    """An open page, what it asked for, and what it complained about."""

    def __init__(self, page: Any, address: str) -> None:
        self.page, self.address = page, address
        self.requests, self.complaints = [], []
        page.set_default_timeout(MILLISECONDS)
        page.on("request", lambda request: self.requests.append(request.url))
        page.on(
            "console", lambda said: self.complaints.append(said.text) if said.type in {"error", "warning"} else None
        )
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.goto(address)
        page.wait_for_selector("body[data-ready]")

    def go(self, address: str) -> Tab:
        """Look ahead at the first frame's colours, but for what the address says."""
        parts = {"yaw": "0", "pitch": "0", "fov": "30", "layer": "colour", "frame": "0"} | dict(parse_qsl(address))
        self.page.evaluate(f"location.hash = {urlencode(parts)!r}")
        return self.settle()

    def settle(self) -> Tab:
        """Wait until what was asked for is drawn."""
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return self

    def press(self, *keys: str) -> Tab:
        for key in keys:
            self.page.keyboard.press(key)
        return self.settle()

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> Tab:
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move(*end, steps=3)
        self.page.mouse.up()
        return self.settle()

    def wait_for_name(self, start: str) -> Tab:
        """Wait until the frame's number and name begin like that."""
        return self.wait_until(lambda: self.text("#name").startswith(start), f"the name becomes {start!r}")

    def wait_until(self, condition: Callable[[], bool], words: str) -> Tab:
        """Wait until the condition, in these words, holds."""
        end = time.monotonic() + MILLISECONDS / 1000
        while not condition():
            assert time.monotonic() < end, f"it never happens that {words}"
            self.settle()
        return self.settle()

    def box(self, pane: str) -> tuple[int, int, int, int]:
        """Left, top, right, bottom of an element in whole pixels."""
        box = self.page.evaluate(f"document.querySelector({pane!r}).getBoundingClientRect().toJSON()")
        left, top, right, bottom = (math.floor(box[side] + 0.5) for side in ("left", "top", "right", "bottom"))
        return left, top, right, bottom

    def pixels(self, pane: str = "#view") -> np.ndarray:
        """(h, w, 3) uint8 that a pane shows, without what lies over the canvas."""
        over = "document.querySelectorAll('output, #legend, #divider, #tip, #cloudtools, #scale, #compass')"
        self.page.evaluate(f"{over}.forEach(one => one.style.opacity = 0)")
        left, top, right, bottom = self.box(pane)
        data = self.page.screenshot(clip={"x": left, "y": top, "width": right - left, "height": bottom - top})
        self.page.evaluate(f"{over}.forEach(one => one.style.opacity = 1)")
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image.convert("RGB"))

    def text(self, selector: str) -> str:
        return self.page.evaluate(f"document.querySelector({selector!r}).textContent")

    def checked(self) -> list[str]:
        return self.page.locator("[aria-checked=true]").all_text_contents()

    def close(self) -> None:
        """At the end, nothing may have been asked for but the page, nor complained about."""
        self.page.context.close()
        assert (self.requests, self.complaints) == ([self.address], [])


@pytest.fixture(scope="module")
def open_tab(browser, pages) -> Iterator[Callable[..., Tab]]:
    """A function that opens a page in a window of its own."""
    opened: list[Tab] = []

    def make(name: str, script: str = "", **context: Any) -> Tab:
        settings = {"viewport": {"width": WIDTH, "height": HEIGHT}, "color_scheme": "dark"} | context
        page = browser.new_context(**settings).new_page()
        if script:
            page.add_init_script(script)
        opened.append(Tab(page, (pages / f"{name}.html").as_uri()))
        return opened[-1]

    yield make
    for tab in opened:
        tab.close()


@pytest.fixture(scope="module")
def one(open_tab) -> Tab:
    """The page of a single panorama, which tests share."""
    return open_tab("one")


@pytest.fixture(scope="module")
def drive(open_tab) -> Tab:
    """The page of a drive, which tests share."""
    return open_tab("drive")


def expected(
    colour: np.ndarray, shape: tuple[int, ...], yaw: float, pitch: float, fov: float
) -> tuple[np.ndarray, ...]:
    """What a look into the panorama shows, by definition: colours (h, w, 3) float, rows and columns on the raster."""
    h, w = shape[:2]
    focal = w / 2 / np.tan(np.radians(fov) / 2)
    v, u = np.mgrid[0:h, 0:w] + 0.5
    left, up = w / 2 - u, h / 2 - v
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    x = cp * cy * focal - sy * left - sp * cy * up
    y = cp * sy * focal + cy * left - sp * sy * up
    z = sp * focal + cp * up
    column = (np.pi - np.arctan2(y, x)) / (2 * np.pi) * VIEW.columns
    row = (VIEW.up - z / np.hypot(x, y)) / (VIEW.up - VIEW.down) * VIEW.rows
    i, j = np.floor(row - 0.5).astype(int), np.floor(column - 0.5).astype(int)
    a, b = (row - 0.5 - i)[..., None], (column - 0.5 - j)[..., None]

    def at(rows, columns):
        return colour[rows.clip(0, VIEW.rows - 1), columns % VIEW.columns].astype(float)

    top, bottom = ((1 - b) * at(rows, j) + b * at(rows, j + 1) for rows in (i, i + 1))
    return (1 - a) * top + a * bottom, row, column


# --- what is drawn ---------------------------------------------------------------------------------------------------


def test_the_page_opens_and_says_what_it_shows(one):
    assert one.page.title() == "one"
    assert one.text("#direction").startswith("ahead")
    layers = [
        one.page.locator(f"[data-layer={name}]")
        for name in ("colour", "classes", "depth", "camera", "confidence", "source")
    ]
    assert all(layer.is_visible() for layer in layers)
    assert not one.page.locator("#time").is_visible(), "a single panorama has no time"


@pytest.mark.parametrize(("yaw", "pitch"), [(0, 0), (180, 1), (-179.5, -4), (97.3, 3.7), (-45, -7)])
def test_every_pixel_is_the_panoramas(one, yaw, pitch):
    """640 pixels show 64 columns, so colours are interpolated: as the definition says, to 3 levels of 255."""
    found = one.go(f"yaw={yaw}&pitch={pitch}&fov=20").pixels().astype(float)
    wanted, row, column = expected(small_panorama().colour, found.shape, np.radians(yaw), np.radians(pitch), 20)
    inside = (row > 0.01) & (row < VIEW.rows - 0.01)
    assert inside.mean() > 0.5
    assert np.abs(found - wanted)[inside].max() <= 3
    beyond = (row < -0.01) | (row > VIEW.rows + 0.01)
    assert (found[beyond] == (20, 23, 28)).all()
    if abs(yaw) > 179:
        assert column.min() < 5 and column.max() > VIEW.columns - 5, "the seam is in view"


@pytest.mark.parametrize("yaw", [0, 180])
def test_classes_are_not_mixed(one, yaw):
    found = one.go(f"yaw={yaw}&layer=classes").pixels()
    around = small_panorama()
    _, row, column = expected(around.colour, found.shape, np.radians(yaw), 0.0, 30)
    clear = (np.abs(row - np.round(row)) > 0.01) & (np.abs(column - np.round(column)) > 0.01)
    clear &= (row > 0) & (row < VIEW.rows)
    ids = around.segments[row[clear].astype(int), column[clear].astype(int) % VIEW.columns]
    np.testing.assert_array_equal(found[clear], COMMON15.paint(ids))
    assert one.page.locator("#legend button").count() == len(COMMON15) - 1, "all but unlabeled occur"


def test_confidence_has_the_colours_of_its_legend(one):
    found = one.go("layer=confidence").pixels()
    around = small_panorama()
    _, row, column = expected(around.colour, found.shape, 0.0, 0.0, 30)
    clear = (np.abs(row - np.round(row)) > 0.01) & (np.abs(column - np.round(column)) > 0.01)
    clear &= (row > 0) & (row < VIEW.rows)
    share = around.confidence[row[clear].astype(int), column[clear].astype(int) % VIEW.columns]
    channels = [np.interp(np.arange(21) / 20, np.arange(5) / 4, stops) for stops in np.transpose(LOW_TO_HIGH)]
    table = np.stack(channels, axis=1)
    np.testing.assert_array_equal(found[clear], table.round()[np.round(share * 20).astype(int)])


def test_the_map_is_the_whole_panorama(one):
    found = one.go("yaw=90&fov=20&layer=classes").pixels("#map").astype(int)
    painted = COMMON15.paint(small_panorama().segments).astype(int)
    h, w = found.shape[:2]
    v, u = np.mgrid[0:h, 0:w] + 0.5
    sampled = painted[(v / h * VIEW.rows).astype(int), (u / w * VIEW.columns).astype(int)]
    aside = np.abs(u / w - 0.25)  # the view's outline is a quarter from the left edge, 20 / 360 wide
    dark = np.abs(found - sampled * 0.5).max(axis=2) <= 2
    assert dark[aside > 0.04].mean() > 0.95, "but for pixels on the border of two classes"
    bright = np.abs(found - sampled).max(axis=2) <= 2
    slope = VIEW.up - v / h * (VIEW.up - VIEW.down)
    assert bright[(aside < 0.02) & (np.abs(slope) < 0.04)].mean() > 0.9


def test_the_camera_image_lies_on_the_panorama(one):
    ahead = one.go("layer=camera&fov=20").pixels().astype(int)
    _, row, _ = expected(small_panorama().colour, ahead.shape, 0.0, 0.0, 20)
    inside = (row > 0.01) & (row < VIEW.rows - 0.01)
    assert np.abs(ahead - (10, 200, 30))[inside].max() <= 3
    behind = one.go("yaw=180&layer=camera&fov=20").pixels().astype(float)
    wanted, _, _ = expected(small_panorama().colour, behind.shape, np.pi, 0.0, 20)
    assert np.abs(behind - wanted * 0.3)[inside].max() <= 3, "where no camera looks, the panorama is dimmed"


def test_large_panoramas_are_halved_for_small_devices(one, open_tab):
    limit = "const get = WebGL2RenderingContext.prototype.getParameter;"
    limit += "WebGL2RenderingContext.prototype.getParameter = function (name) {"
    limit += "return name === this.MAX_TEXTURE_SIZE ? 600 : get.call(this, name); };"
    small = open_tab("one", script=limit)
    address = "yaw=180&fov=30"
    exact, halved = (tab.go(f"{address}&layer=classes").pixels() for tab in (one, small))
    assert (exact == halved).all(axis=2).mean() > 0.98, "classes come in blocks of 8 x 8 pixels"
    exact, halved = (tab.go(address).pixels().astype(float) for tab in (one, small))
    assert halved.std() < 0.8 * exact.std(), "noise becomes weaker"


# --- what the user does ----------------------------------------------------------------------------------------------


def test_keys_choose_layers(one):
    colour = one.go("").pixels()
    found = {}
    for key, name in (
        ("2", "Classes"),
        ("3", "Depth"),
        ("4", "Camera"),
        ("5", "Confidence"),
        ("6", "Source"),
        ("1", "Colour"),
    ):
        found[key] = one.press(key).pixels()
        assert one.checked() == [name]
    assert np.array_equal(found["1"], colour) and len({image.tobytes() for image in found.values()}) == 6
    assert one.press("3").page.locator("#legend .ticks span").all_text_contents() == [
        "1 m",
        "4 m",
        "16 m",
        "64 m",
        "256 m",
    ]
    ticks = one.press("5").page.locator("#legend .ticks span").all_text_contents()
    assert ticks == ["0 %", "25 %", "50 %", "75 %", "100 %"]
    one.page.get_by_role("radio", name="Classes").click()
    assert np.array_equal(one.settle().pixels(), found["2"])


def test_keys_mouse_and_wheel_look_around(one):
    wide = re.compile(r"(\d+)\u00b0 wide")
    assert one.go("").press("ArrowLeft").text("#direction").startswith("1.9\u00b0 left")
    assert one.press("ArrowRight", "ArrowRight").text("#direction") == "1.9\u00b0 right \u00b7 30\u00b0 wide"
    assert int(wide.findall(one.press("+").text("#direction"))[0]) == 24
    left, top, right, bottom = one.box("#view")
    before = one.go("").pixels()
    dragged = one.drag((320, top + 50), (420, top + 50)).pixels()
    assert "left" in one.text("#direction"), "what is held follows the mouse"
    assert np.abs(dragged[40:60, 420].astype(int) - before[40:60, 320]).max() < 60
    one.page.mouse.wheel(0, -300)
    assert int(wide.findall(one.settle().text("#direction"))[0]) < 30
    assert one.press("r").text("#direction").startswith("ahead")
    left, top, right, bottom = one.box("#map")
    one.page.mouse.click(left + (right - left) * 3 // 4, (top + bottom) // 2)
    assert one.settle().text("#direction").startswith("90.0\u00b0 right")
    assert "yaw=-90" in one.page.evaluate("new Promise(done => setTimeout(() => done(location.hash), 900))")


def dial(tab: Tab) -> float:
    """Degrees clockwise that the dial's sector is turned by."""
    return float(re.findall(r"rotate\((.*)\)", tab.page.locator("#sector").get_attribute("transform"))[0])


def degrees_right(tab: Tab) -> float:
    ((number, side),) = re.findall(r"([\d.]+)\u00b0 (left|right)", tab.text("#direction"))
    return float(number) * (1 if side == "right" else -1)


def test_the_dial_shows_the_direction_and_the_width(one):
    assert dial(one.go("yaw=90")) == -90 and dial(one.go("yaw=-45")) == 45, "left is on the dial's left"
    widths = [one.go(f"fov={fov}").box("#sector") for fov in (20, 60)]
    narrow, wide = (right - left for left, _, right, _ in widths)
    assert wide > 2 * narrow and widths[0][3] - widths[0][1] > narrow, "a sector upwards: ahead"


def test_the_view_turns_by_itself_until_it_is_moved(one):
    one.go("yaw=-20")
    began = time.monotonic()
    one.press("a")
    assert one.page.locator("#revolve").get_attribute("aria-pressed") == "true"
    assert one.page.locator("#direction").get_attribute("aria-live") == "off"
    one.wait_until(lambda: degrees_right(one) > 26, "the view has turned by six degrees")
    right = degrees_right(one)
    assert 26 < right < min(90, 20.1 + 6 * (time.monotonic() - began)), "six degrees a second, to the right"
    one.press("ArrowRight")
    assert one.page.locator("#revolve").get_attribute("aria-pressed") == "false"
    stopped = one.text("#direction")
    one.page.wait_for_timeout(500)
    assert one.text("#direction") == stopped
    one.page.locator("#revolve").click()
    assert one.page.locator("#revolve").get_attribute("aria-pressed") == "true"
    one.press("r")
    assert one.text("#direction").startswith("ahead")


def test_little_motion_is_a_jump_now_and_then(open_tab):
    calm = open_tab("one", reduced_motion="reduce").go("yaw=-20").press("a")
    calm.page.wait_for_timeout(1000)
    assert degrees_right(calm) == 20
    calm.wait_until(lambda: degrees_right(calm) == 65, "the view jumps by an eighth")
    calm.press("a")


def test_help_is_a_key_away(one):
    one.go("").press("?")
    assert one.page.get_by_role("dialog").is_visible()
    one.press("Escape")
    assert not one.page.get_by_role("dialog").is_visible()


def test_the_mouse_reads_class_and_distance(one):
    one.go("yaw=180")
    around = small_panorama()
    left, top, right, bottom = one.box("#view")
    _, row, column = expected(around.colour, (bottom - top, right - left), np.pi, 0.0, 30)
    middle = (np.abs(row % 8 - 4) < 2) & (np.abs(column % 8 - 4) < 2) & (row > 0) & (row < VIEW.rows)
    places = np.argwhere(middle)
    for y, x in places[:: len(places) // 8]:
        one.page.mouse.move(left + int(x), top + int(y))
        i, j = int(row[y, x]), int(column[y, x]) % VIEW.columns
        name, metres = COMMON15.classes[around.segments[i, j]], around.depth_m[i, j]
        said = one.settle().text("#tip")
        assert said.partition(" \u00b7 ")[0] == name
        (share,) = re.findall(r"class: (\d+) %", said)
        assert int(share) / 100 == pytest.approx(around.confidence[i, j], abs=0.0251)
        if metres:
            assert float(re.findall(r"([\d.]+) m", said)[0]) == pytest.approx(metres, rel=0.03, abs=0.06)
        else:
            assert " m " not in said
    one.page.mouse.move(left + 5, bottom + 20)
    assert not one.page.locator("#tip").is_visible()


def test_colour_and_a_layer_stand_side_by_side(one):
    colour, classes = one.go("yaw=20").pixels(), one.go("yaw=20&layer=classes").pixels()
    split = one.go("yaw=20&layer=classes&compare=0.25").pixels()
    assert np.array_equal(split[:, :159], colour[:, :159]) and np.array_equal(split[:, 161:], classes[:, 161:])
    _, top, _, _ = one.box("#view")
    split = one.drag((160, top + 60), (480, top + 60)).pixels()
    assert np.array_equal(split[:, :479], colour[:, :479]) and np.array_equal(split[:, 481:], classes[:, 481:])
    assert np.array_equal(one.press("c").pixels(), classes)
    assert one.press("1", "c").checked() == ["Camera"], "colour is compared with the camera's image where there is one"
    one.press("c")


def test_points_stand_beside_the_panorama(one):
    assert not one.go("layer=classes").page.locator("#points").is_visible()
    assert one.press("p").page.locator("#points").is_visible()
    assert one.text("#count") == "4,000 points \u00b7 grid 10 m"
    found = one.pixels("#points")[2:, 2:]  # without the border
    grid = tuple(round(0.75 * value + 0.125 * 255) for value in GROUND)
    ground = (found == GROUND).all(axis=2) | (np.abs(found.astype(int) - grid) <= 1).all(axis=2)
    assert 0.005 < 1 - ground.mean() < 0.9 and ground.mean() > (found == GROUND).all(axis=2).mean(), "there is a grid"
    colours = {tuple(colour) for colour in found[~ground].tolist()}
    assert colours <= {*COMMON15.colours, GREY}, "classes, or grey where there is none"
    assert len(colours) > 8 and GREY in colours
    left, top, right, bottom = one.box("#points")
    x, y = (left + right) // 2, (top + bottom) // 2
    assert not np.array_equal(one.drag((x, y), (x + 60, y + 20)).pixels("#points")[2:, 2:], found)
    one.press("r").go("layer=colour")


def test_points_have_colours_sizes_and_views_of_their_own(one):
    one.go("layer=classes&points=1")
    images = {"classes": one.pixels("#points")}
    for colouring in ("height", "intensity", "distance"):
        one.page.locator("#colouring").select_option(colouring)
        images[colouring] = one.settle().pixels("#points")
        assert one.page.locator("#scale").is_visible() == (colouring != "distance")
    one.page.locator("#larger").click()
    images["larger"] = one.settle().pixels("#points")
    covered = {name: (image != GROUND).any(axis=2).mean() for name, image in images.items()}
    assert covered["larger"] > 1.1 * covered["distance"]
    one.page.locator("#top").click()
    images["top"] = one.settle().pixels("#points")
    one.page.locator("#fit").click()
    assert np.array_equal(one.settle().pixels("#points"), images["larger"]), "all in sight again"
    assert len({image.tobytes() for image in images.values()}) == 6
    one.page.locator("#smaller").click()
    one.page.locator("#colouring").select_option("layer")
    one.go("layer=colour")


def test_the_legend_chooses_classes(one):
    everything = one.go("layer=classes").pixels()
    buttons = one.page.locator("#legend button")
    name = buttons.first.inner_text()
    buttons.first.click()
    alone = one.settle().pixels()
    colour = COMMON15.colours[COMMON15.id_of(name)]
    of_class = (everything == colour).all(axis=2)
    assert np.array_equal((alone == colour).all(axis=2), of_class) and 0 < of_class.mean() < 0.5
    others = {tuple(pixel) for pixel in alone[~of_class].tolist()}
    assert not others & set(COMMON15.colours)
    buttons.first.press("Enter")
    assert np.array_equal(one.settle().pixels(), everything), "by keyboard, too"


def test_pixels_of_cameras_are_told_from_invented_ones(one):
    invented, camera = (one.go(f"yaw={yaw}&layer=source&fov=20").pixels() for yaw in (-45, 90))
    inside = invented.max(axis=2) != GROUND[2]
    assert (invented.max(axis=2) == invented.min(axis=2))[inside].mean() > 0.5, "grey"
    assert (camera.max(axis=2) == camera.min(axis=2)).mean() < 0.1
    assert one.page.locator("#legend .entry").all_text_contents() == ["invented", "front", "camera 2"]
    assert "invented where no camera sees" in one.text("#about")


def test_a_view_can_be_kept_and_passed_on(one):
    shown = one.go("yaw=33&layer=depth").pixels()
    with one.page.expect_download() as download:
        one.press("s")
    assert download.value.suggested_filename == "one.depth.view.png"
    with Image.open(download.value.path()) as image:
        np.testing.assert_array_equal(np.array(image.convert("RGB")), shown)
    one.press("l")
    assert "yaw=33" in one.page.evaluate("location.hash") and "link" in one.text("#tip")


def test_the_page_is_light_or_dark(open_tab):
    light = open_tab("one", color_scheme="light").go("fov=140")
    corner = light.pixels()[1, 1].tolist()
    assert min(corner) > 200
    assert light.press("t").pixels()[1, 1].tolist() == list(GROUND)


def test_the_middle_is_read_by_keyboard(one):
    one.go("yaw=180")
    assert re.fullmatch(r"[a-z-]+( \u00b7 [\d.]+ m)? \u00b7 class: \d+ % \u00b7 .+", one.press("i").text("#tip"))


def test_layers_are_chosen_by_arrow_keys(one):
    one.go("layer=classes").page.locator("[data-layer=classes]").focus()
    assert one.press("ArrowRight").checked() == ["Depth"] and one.press("ArrowLeft", "ArrowLeft").checked() == [
        "Colour"
    ]
    one.page.locator("#view").focus()


def test_a_drive_plays(drive):
    frames = [drive.go("layer=classes").pixels()]
    frames += [drive.press(".").wait_for_name(f"{number} / 6 \u00b7 frame {number - 1}").pixels() for number in (2, 3)]
    assert len({frame.tobytes() for frame in frames}) == 3
    assert np.array_equal(drive.press(",").wait_for_name("2 / 6").pixels(), frames[1])
    around = small_panorama(1)
    _, row, column = expected(around.colour, frames[1].shape, 0.0, 0.0, 30)
    clear = (np.abs(row - np.round(row)) > 0.01) & (np.abs(column - np.round(column)) > 0.01) & (row > 0) & (row < 96)
    ids = around.segments[row[clear].astype(int), column[clear].astype(int)]
    np.testing.assert_array_equal(frames[1][clear], COMMON15.paint(ids))
    drive.page.locator("#frame").fill("5")
    drive.wait_for_name("6 / 6").page.locator("#view").focus()
    drive.press(" ").wait_for_name("2 / 6")
    assert drive.page.locator("#play").get_attribute("aria-pressed") == "true"
    drive.press(" ")
    assert drive.page.locator("#play").get_attribute("aria-pressed") == "false"


def test_names_from_outside_are_text(open_tab):
    hostile = open_tab("hostile")
    assert hostile.page.title() == HOSTILE and hostile.text("#title") == HOSTILE
    assert hostile.text("#name") == f"1 / 2 \u00b7 {HOSTILE}"
    assert hostile.page.evaluate("window.hacked") is None and hostile.page.locator("img").count() == 0


def test_a_phone_has_room(open_tab):
    phone = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True}
    tab = open_tab("drive", **phone).go("layer=classes&points=1")
    assert tab.page.evaluate("document.documentElement.scrollWidth") == 360
    left, top, right, bottom = tab.box("#view")
    tab.page.touchscreen.tap((left + right) // 2, (top + bottom) // 2)
    assert "class: " in tab.settle().text("#tip"), "a tap tells what hovering tells"
    for selector in ("#layers", "#compare", "#cloud", "#play", "#frame", "#map", "#view", "#points"):
        left, top, right, bottom = tab.box(selector)
        assert 0 <= left < right <= 360 and 0 <= top < bottom <= 740, selector
    assert tab.box("#points")[1] >= tab.box("#view")[3] > tab.box("#view")[1], "one above the other"
    left, top, right, bottom = tab.box("#map")
    tab.page.touchscreen.tap(left + 90, (top + bottom) // 2)
    assert tab.settle().text("#direction").startswith("90.0\u00b0 left")


def test_all_layers_are_in_reach_on_a_phone(open_tab):
    tab = open_tab("one", viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True)
    buttons = tab.page.locator("#layers button:not([hidden])")
    boxes = [buttons.nth(i).bounding_box() for i in range(buttons.count())]
    assert len(boxes) == 6 and all(box["x"] >= 0 and box["x"] + box["width"] <= 360 for box in boxes)


def test_the_first_view_on_a_phone_is_a_cameras(open_tab):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    assert open_tab("drive", **phone).settle().text("#direction") == "ahead \u00b7 55\u00b0 wide"


def test_without_webgl_the_page_says_so(browser, pages):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((pages / "one.html").as_uri())
    assert "needs WebGL 2" in page.get_by_role("alert").inner_text()
    page.context.close()


# --- axe-core ---------------------------------------------------------------------------------------------------------

AXE = os.environ.get("LIDAR2PANO_AXE", "")
SERVED = Path(serve.__file__).parent / "pages"
FAULTS = "async () => (await axe.run()).violations.map(one => [one.id, one.impact, one.nodes[0].html])"


@pytest.mark.needs(THERE and AXE, "axe-core: npm install axe-core; LIDAR2PANO_AXE names its axe.min.js")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
@pytest.mark.parametrize(
    ("name", "keys"), [("view", ""), ("view", "p"), ("view", "?"), ("index.html", ""), ("docs.html", "")]
)
def test_axe_finds_no_fault(browser, pages, name, keys, size, scheme):
    """The pages of `view` and `serve`; the policy, which forbids axe's own script, is bypassed."""
    viewport = {"width": size[0], "height": size[1]}
    context = browser.new_context(viewport=viewport, color_scheme=scheme, bypass_csp=True)
    page = context.new_page()
    page.goto((pages / "one.html" if name == "view" else SERVED / name).as_uri())
    if name == "view":
        page.wait_for_selector("body[data-ready]")
    for key in keys:
        page.keyboard.press(key)
    page.add_script_tag(path=AXE)
    found = page.evaluate(FAULTS)
    context.close()
    assert found == []
