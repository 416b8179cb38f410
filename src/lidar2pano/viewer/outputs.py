"""Files of `translate` about all of its scans together: the page, a video, a log for Rerun."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.errors import require_extra
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.image_files import DEPTH_STEPS, write_whole
from lidar2pano.geometry.camera import camera_in_panorama
from lidar2pano.labels import COMMON15
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan
from lidar2pano.viewer.page import RATE_HZ, PageWriter, facts_of, page_frame
from lidar2pano.views import View

VIDEO_COLUMNS = 3840  # at most: wider H.264 is not decoded by hardware
VIDEO_QUALITY = 20  # x264's constant rate factor


@dataclass(frozen=True, kw_only=True)
class OutputFiles:
    """Paths of the files about all panoramas of a run; None: not asked for.  title: of the page."""

    page: Path | None = None
    title: str = ""
    video: Path | None = None
    rerun: Path | None = None

    @contextmanager
    def opened(self, weights: str) -> Iterator[list[Output]]:
        """Give outputs for these files, closed in the end; InputError for a missing extra.  weights: their name."""
        with ExitStack() as stack:
            outputs: list[Output] = []
            if self.page:
                outputs.append(stack.enter_context(closing(PageOutput(self.page, self.title, weights))))
            if self.video:
                outputs.append(stack.enter_context(closing(VideoOutput(self.video))))
            if self.rerun:
                outputs.append(stack.enter_context(closing(RerunOutput(self.rerun))))
            yield outputs


class PageOutput:
    """The page to look around in."""

    def __init__(self, path: Path, title: str, weights: str) -> None:
        self.path, self.weights = path, weights
        self.writer = PageWriter(title)
        self.close = self.writer.close  # removes everything kept for the file

    def add(self, panorama: Panorama, scan: Scan, source: Path, name: str) -> None:
        """Take the next panorama, its scan, the scan's file or recording, and its name among all."""
        if not len(self.writer):
            self.writer.facts = facts_of(self.weights, scan)
        self.writer.add(page_frame(panorama, scan, name, camera_layer(source, panorama.view)))

    def finish(self) -> Path | None:
        """Write the file, complete or not at all, and return its path; None if no panorama was added."""
        return self.writer.write(self.path) if len(self.writer) else None


class _GrowingFile:
    """A library's file, in a temporary folder until it is complete.  frames: number of panoramas in it."""

    def __init__(self, path: Path) -> None:
        self.path, self.frames = path, 0
        self._folder = tempfile.TemporaryDirectory()
        self.part = Path(self._folder.name, f"part{path.suffix}")

    def end(self) -> None:
        """Let the library complete its file; nothing happens a second time."""
        raise NotImplementedError

    def finish(self) -> Path | None:
        """See PageOutput."""
        self.end()
        return write_whole(self.path, lambda whole: shutil.copyfile(self.part, whole)) if self.frames else None

    def close(self) -> None:
        """See PageOutput."""
        self.end()
        self._folder.cleanup()


class VideoOutput(_GrowingFile):
    """A video (MP4, H.264) of the panoramas, ten a second."""

    def __init__(self, path: Path) -> None:
        with require_extra("recordings", "--video"):
            import av
        super().__init__(path)
        self._to_frame = av.VideoFrame.from_ndarray
        self._container = av.open(str(self.part), "w", format="mp4")
        self._stream: Any = None

    def add(self, panorama: Panorama, scan: Scan, source: Path, name: str) -> None:
        """See PageOutput."""
        rows, columns = panorama.colour.shape[:2]
        if self._stream is None:
            self._stream = self._container.add_stream("libx264", rate=round(RATE_HZ))
            width = min(columns, VIDEO_COLUMNS) // 2 * 2
            self._stream.width, self._stream.height = width, max(round(rows * width / columns / 2), 1) * 2
            self._stream.pix_fmt = "yuv420p"
            self._stream.options = {"crf": str(VIDEO_QUALITY), "preset": "fast"}
        image = Image.fromarray(panorama.colour)
        size = (self._stream.width, self._stream.height)
        image = image if image.size == size else image.resize(size, Image.Resampling.LANCZOS)
        frame = self._to_frame(np.asarray(image), format="rgb24")
        self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def end(self) -> None:
        """Write the frames left in the coder."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()
        self._stream = None


class RerunOutput(_GrowingFile):
    """A recording for Rerun (rerun.io): points, panorama, classes and depth over time."""

    def __init__(self, path: Path) -> None:
        with require_extra("recordings", "--rerun"):
            import rerun
        self._rerun = rerun
        super().__init__(path)
        self._log = self._rerun.RecordingStream("lidar2pano", recording_id=path.stem)
        self._log.save(str(self.part))
        names = [
            (index, name, colour)
            for index, (name, colour) in enumerate(zip(COMMON15.classes, COMMON15.colours, strict=True))
        ]
        self._log.log("/", self._rerun.AnnotationContext(names), static=True)
        self._log.log("/", self._rerun.ViewCoordinates.FLU, static=True)

    def add(self, panorama: Panorama, scan: Scan, source: Path, name: str) -> None:
        """See PageOutput."""
        rr, log = self._rerun, self._log
        log.set_time("frame", sequence=self.frames)
        log.set_time("time", duration=self.frames / RATE_HZ)
        usable = np.isfinite(scan.xyz).all(axis=1)
        points = panorama.colour_points(scan)
        steps = np.clip(np.round(panorama.depth_m * DEPTH_STEPS), 0, 0xFFFF).astype(np.uint16)
        log.log("scan", rr.Points3D(scan.xyz[usable], colors=points.colour[usable]))
        log.log("panorama/colour", rr.Image(panorama.colour).compress(jpeg_quality=90))
        log.log("panorama/classes", rr.SegmentationImage(panorama.segments))
        log.log("panorama/depth", rr.DepthImage(steps, meter=DEPTH_STEPS))
        log.log("name", rr.TextLog(f"{source}: {name}"))
        self.frames += 1

    def end(self) -> None:
        """Write the rest of the log."""
        self._log.disconnect()


Output = PageOutput | VideoOutput | RerunOutput


def camera_layer(scan_file: Path, view: View) -> np.ndarray | None:
    """Return the camera's image on a panorama, (h, w, 4) uint8 RGBA, transparent outside the image; None without one.

    SemanticKITTI's layout only: <sequence>/velodyne/<stem>.bin, image_2/<stem>.png or .jpg, calib.txt. The scene is
    taken to be far away, or the panorama's origin to be the camera's centre. A simulated world has an image all around.
    Raises InputError for a damaged file.
    """
    if scan_file.resolve().parent.name != "velodyne":
        return None
    frame = SemanticKittiFrame(scan_file.resolve().parents[1], stem_of(scan_file))
    if (world := frame.panorama) is not None and world.view.circular:
        return np.dstack([world.image, np.uint8(255) * world.valid])
    if frame.image_file is None or not (frame.folder / "calib.txt").is_file():
        return None
    image, calibration = frame.require("image", "calibration")
    lookup = camera_in_panorama(view, calibration)
    colour = lookup.linear(torch.from_numpy(image).movedim(2, 0).float()).round().to(torch.uint8).movedim(0, 2)
    return np.dstack([colour.numpy(), np.uint8(255) * lookup.valid.numpy()])
