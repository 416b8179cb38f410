#!/usr/bin/env python
"""Put a reproduction's report into docs/: python runs/reproduce_docs.py DIR [NAME]

DIR is the output of `lidar2pano reproduce`; the report becomes docs/NAME.md (reproduce), its sheets are in docs/NAME/.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).resolve().parent.parent / "docs"
WIDE = 1240  # pixels of a sheet in docs/


def main() -> None:
    """Copy the report; sheets become small JPEGs beside it."""
    source, page = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "reproduce"
    folder = DOCS / page
    folder.mkdir(exist_ok=True)
    text = (source / "RESULTS.md").read_text(encoding="utf-8")
    for sheet in re.findall(r"\(sheets/([^)]+)\)", text):
        with Image.open(source / "sheets" / sheet) as image:
            size = (WIDE, round(WIDE * image.height / image.width))
            small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        name = f"{Path(sheet).stem}.jpg"
        small.save(folder / name, quality=72)
        text = text.replace(f"(sheets/{sheet})", f"({page}/{name})")
    (DOCS / f"{page}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
