"""Makes docs/images/view.jpg: the page of the demo's scan in headless Chromium (Debian's `chromium`, Playwright)."""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ADDRESS = "#layer=classes&compare=0.6&points=1&yaw=-8&fov=40"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--browser", default="/usr/bin/chromium", help="program of the browser")
    parser.add_argument("--weights", default="world", help="family of weights")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "view.jpg")
    options = parser.parse_args()
    from PIL import Image
    from playwright.sync_api import sync_playwright

    from lidar2pano.cli import main as lidar2pano
    from lidar2pano.demo import street

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "view.html"
        lidar2pano(["view", str(street()), "--weights", options.weights, "--no-open", "--out", str(file)])
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=options.browser, args=flags)
        page = browser.new_page(viewport={"width": 1200, "height": 620})
        page.goto(file.as_uri() + ADDRESS)
        page.wait_for_selector("body[data-ready]")
        page.wait_for_timeout(1000)
        with Image.open(io.BytesIO(page.screenshot())) as image:
            image.convert("RGB").save(options.out, quality=80)
        browser.close()


if __name__ == "__main__":
    main()
