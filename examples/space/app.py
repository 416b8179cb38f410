"""A page to try lidar2pano in a browser, ready for a Gradio Space: python examples/space/app.py."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from PIL import Image

import lidar2pano
from lidar2pano import demo

WEIGHTS = "world"  # Apache-2.0; "best" takes the best family that is installed
TEXT = (
    "One LiDAR scan in, a 360-degree colour panorama out. Classes and depth come from the points and the networks;"
    " colours are invented, because a scan does not show them."
)


@functools.cache
def pipeline(weights: str) -> lidar2pano.Pipeline:
    return lidar2pano.load(weights)


def paint(file: str | None) -> tuple[Image.Image, Image.Image, str]:
    """Return colours, classes and a line about the panorama of a scan's file; without one, of the package's scan."""
    panorama = pipeline(WEIGHTS)(lidar2pano.read(file or demo.street()))
    return panorama.to_pil(), Image.fromarray(lidar2pano.COMMON15.paint(panorama.segments)), repr(panorama)


def page() -> Any:
    """Return the page; needs Gradio, which a Space has and lidar2pano does not require."""
    import gradio

    def answer(file: str | None) -> tuple[Image.Image, Image.Image, str]:
        try:
            return paint(file)
        except lidar2pano.InputError as error:
            place = f"{Path(file).parent}/" if file else ""  # on the server, which is nobody's concern
            raise gradio.Error(str(error).replace(place, "")) from None

    return gradio.Interface(
        fn=answer,
        inputs=gradio.File(
            label="A scan: .bin, .pcd, .ply, .las, .npy, .csv (none: the package's own)", type="filepath"
        ),
        outputs=[gradio.Image(label="Panorama"), gradio.Image(label="Classes"), gradio.Textbox(label="Result")],
        title="lidar2pano",
        description=TEXT,
    )


if __name__ == "__main__":
    page().launch()
