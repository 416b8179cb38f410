"""Sectors to learn the latent painter from: the scene of a scan, and the photograph of a camera beside it.

A sector is made once, by released networks, and kept in a file. A labelled photograph without a scan is a sector as
well, whose scene has its labelled classes alone.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

from lidar2pano.bounded_files import sha256_of
from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame, SampleIndex
from lidar2pano.data.labelled_images import LabelledImage
from lidar2pano.data.layouts import frames_of
from lidar2pano.data.panorama_crops import panorama_on
from lidar2pano.data.photographs import as_signed, cameras
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.torch_files import read_tensors
from lidar2pano.geometry.camera import at_camera, camera_in_panorama
from lidar2pano.geometry.rasters import nearest_row
from lidar2pano.hardware import Timer, fast_arithmetic
from lidar2pano.labels import COMMON15
from lidar2pano.models.autoencoder import FACTOR
from lidar2pano.models.latent_painter import (
    FOLD,
    GEOMETRY,
    MEASUREMENT,
    REMISSION,
    STRIDE,
    class_sums,
    conditions_of,
    mirrored,
    style_of,
)
from lidar2pano.pipeline import Pipeline
from lidar2pano.scan import remission_curve
from lidar2pano.scene.depth import FAR_M
from lidar2pano.scene.record import Scene
from lidar2pano.views import FULL_TURN, View

ASSUMED_FIELD_DEG = 50  # from the left to the right edge of a photograph without calibration (Cityscapes': 48.7)
FORM = 1  # raised when the files of the same frames hold something else
SCENES = 8  # raised when scenes of the same networks are others
SECTOR_DEG = 100  # width of a camera's sector, about: a multiple of STRIDE columns
QUALITY = 95  # of photographs in the files, as JPEG without subsampled colours
BYTE = 255  # probabilities, remissions and shares are kept in a byte


class LatentSample(NamedTuple):
    """A crop of a sector, H x W pixels of the scene; after collation every tensor gains a leading B.

    conditions  (CONDITIONS, H, W) float32.
    latents     (L, H/4, W/4) float32 of the photograph, of the autoencoder.
    coverage    (H/4, W/4) bool: the camera shows all of their pixels.
    look        () int64: number of the look.
    style       (2L + 1,) float32: `style_of` latents of some columns of a camera of its moment, not normalised.
    palette     (16, L + 1) float32: `class_sums` of the same columns, not normalised.
    picture     (3, 2H, 2W) float32 in [-1, 1], the photograph;  shown: (2H, 2W) bool, its pixels in view. Both
                have no rows but from PicturedFrames.
    """

    conditions: Tensor
    latents: Tensor
    coverage: Tensor
    look: Tensor
    style: Tensor
    palette: Tensor
    picture: Tensor
    shown: Tensor


class Encoded(NamedTuple):
    """Latents (L, h, w) float16 of a sector's photograph and of its mirror image, and their coverage (h, w) bool.

    shares  (16, h, w) float16: class probabilities.
    """

    latents: Tensor
    mirrored: Tensor
    coverage: Tensor
    shares: Tensor


class LatentFrames:
    """Crops of the sectors of some splits: at random for a SampleIndex, in the middle for an int.

    pipeline     makes the scenes;  encoder: that of an Autoencoder, makes the latents.
    networks     files of the pipeline's networks: sectors made by others are made again.
    looks        names of the looks; the first one is of photographs, the others are named by a world.json.
    columns      of a crop on the scene's raster;  cache: folder of the sectors' files; "": .lidar2pano of a data set.
    octaves      largest change of remission's level in half of the crops drawn at random, as of other makes of sensor.
    """

    def __init__(  # noqa: PLR0913, PLR0917 data, networks and how they are read
        self,
        root: Path,
        splits: tuple[str, ...],
        pipeline: Pipeline,
        encoder: nn.Module,
        networks: tuple[str, str],
        looks: tuple[str, ...],
        columns: int,
        cache: str = "",
    ) -> None:
        self.frames, self.pipeline, self.encoder = frames_of(root, splits), pipeline, encoder.eval()
        most = sector_columns(pipeline.view)
        if columns % STRIDE or columns > most:
            raise InputError(f"options.columns={columns}: must be a multiple of {STRIDE}, at most {most}")
        self.columns, self.cache, self.octaves = columns, cache, 0.0
        digest = hashlib.sha256(f"{SCENES} {pipeline.view}".encode())
        for file in networks:
            digest.update(bytes.fromhex(sha256_of(file)))
        self._made_by = f"{FORM} {digest.hexdigest()}"
        self.places = [
            (number, camera, self._look(frame, looks))
            for number, frame in enumerate(self.frames)
            for camera in cameras(frame)
        ]
        self._moments: dict[int, list[int]] = {}
        for index, (number, _, _) in enumerate(self.places):
            self._moments.setdefault(number, []).append(index)
        self._encoded: dict[Path, Encoded] = {}  # by the sector's file: a split that is named twice is encoded once

    @staticmethod
    def _look(frame: Frame, looks: tuple[str, ...]) -> int:
        look = (_look_of_data_set(frame.root) if frame.root else "") or looks[0]
        if look not in looks:
            raise InputError(f"{frame.name}: its look {look!r} is none of {', '.join(looks)}")
        return looks.index(look)

    def __len__(self) -> int:
        """Return the number of sectors."""
        return len(self.places)

    def __getitem__(self, key: SampleIndex | int) -> LatentSample:
        """Return a crop of which a camera sees some, mirrored by chance."""
        index = key if isinstance(key, int) else key.index
        encoded, cells = self.encoded(index), self.columns // FOLD
        generator = None if isinstance(key, int) else np.random.default_rng(key.seed)
        start = self._start(encoded.coverage, cells, generator)
        conditions = self.conditions(index, start * FOLD, self.columns)
        window = (..., slice(start, start + cells))
        latents, coverage = encoded.latents[window], encoded.coverage[window]
        picture, shown = self.picture(index, start, cells)
        if generator is not None and generator.random() < 0.5:
            spare = encoded.coverage.shape[1] - start - cells
            conditions = mirrored(conditions)
            coverage, picture, shown = (part.flip(-1) for part in (coverage, picture, shown))
            latents = encoded.mirrored[..., spare : spare + cells]
        if generator is not None and generator.random() < 0.5:
            curve = remission_curve(generator, self.octaves)  # of another make of sensor
            conditions[REMISSION] = curve(conditions[REMISSION]).clamp(0, 1)
        look = torch.tensor(self.places[index][2])
        style, palette = self._style(self._beside(index, generator), generator)
        return LatentSample(conditions, latents.float(), coverage, look, style, palette, picture, shown)

    def _beside(self, index: int, generator: np.random.Generator | None) -> Encoded:
        """Return the sector of a camera of the same moment, drawn at random; the sector itself without a generator."""
        moment = self._moments[self.places[index][0]]
        return self.encoded(index if generator is None else int(generator.choice(moment)))

    @staticmethod
    def _style(encoded: Encoded, generator: np.random.Generator | None) -> tuple[Tensor, Tensor]:
        """Return style and palette of a sector's columns between two that are drawn; of all without a generator."""
        columns = encoded.coverage.shape[1]
        ends = np.sort(generator.integers(0, columns, 2)) if generator is not None else (0, columns - 1)
        part = (..., slice(int(ends[0]), int(ends[1]) + 1))
        latents, mask = encoded.latents[part][None].float(), encoded.coverage[part][None, None].float()
        return style_of(latents, mask)[0], class_sums(latents, encoded.shares[part][None] * mask)[0]

    def picture(self, index: int, start: int, cells: int) -> tuple[Tensor, Tensor]:  # noqa: ARG002, PLR6301 see below
        """Return the picture of a crop that begins at a cell of the latents, and its pixels in view: no rows."""
        return torch.zeros(3, 0, 0), torch.zeros(0, 0, dtype=torch.bool)

    @staticmethod
    def _start(coverage: Tensor, cells: int, generator: np.random.Generator | None) -> int:
        """Return the first column of a crop: a quarter of it, at least, lies between the outermost covered columns."""
        columns = coverage.any(0).nonzero()
        spare = coverage.shape[1] - cells
        if not len(columns):
            return spare // 2
        first, last = int(columns[0]), int(columns[-1]) + 1
        if generator is None:
            return min(max((first + last - cells) // 2, 0), spare)
        least = min(max(first - 3 * cells // 4, 0), spare)
        return int(generator.integers(least, max(min(last - cells // 4, spare), least) + 1))

    def conditions(self, index: int, start: int, columns: int) -> Tensor:
        """Return the conditions (CONDITIONS, H, columns) of a sector from column `start` on."""
        conditions = conditions_of(self.scene(index, start, columns))[0]
        if isinstance(self.frames[self.places[index][0]], LabelledImage):
            conditions[GEOMETRY], conditions[MEASUREMENT] = 0, 0
        return conditions

    def scene(self, index: int, start: int, columns: int) -> Scene:
        """Return the scene of a sector's columns from `start` on."""
        kept = self.kept(index)
        view = self.pipeline.view.window(0, kept["depth_m"].shape[1]).window(start, columns)
        part = (..., slice(start, start + columns))
        probabilities = kept["probabilities"][part].float()
        probabilities = probabilities / probabilities.sum(0, keepdim=True).clamp(min=1)
        measured = kept["measured"][part]
        channels = torch.zeros(5, *measured.shape)
        channels[0], channels[4] = (measured > 0).float(), (measured.float() - 1).clamp(min=0) / (BYTE - 1)
        return Scene(
            view=view,
            channels=channels[None],
            probabilities=probabilities[None],
            depth_m=kept["depth_m"][part][None],
            viewpoint_m=kept["viewpoint_m"],
        )

    def photograph(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the photograph of a sector, (3, 2H, 2w) float32 in [-1, 1], and its coverage (2H, 2w) bool."""
        kept = self.kept(index)
        with Image.open(io.BytesIO(kept["photograph"].numpy().tobytes()), formats=("JPEG",)) as image:
            picture = as_signed(np.array(image))
        coverage = np.unpackbits(kept["coverage"].numpy(), axis=1, count=picture.shape[2])
        return picture, torch.from_numpy(coverage).bool()

    def encoded(self, index: int) -> Encoded:
        """Return the latents of a sector; they are kept in memory from the first use on."""
        file = self._file(index)
        if file not in self._encoded:
            picture, coverage = self.photograph(index)
            pictures = torch.stack([picture, picture.flip(-1)]).contiguous(memory_format=torch.channels_last)
            with torch.no_grad(), fast_arithmetic(torch.device("cpu")):
                latents = torch.cat([self.encoder(part) for part in pictures.split(1)]).half()
            unknown = max_pool2d((~coverage)[None, None].float(), FACTOR)[0, 0]
            shares = avg_pool2d(self.kept(index)["probabilities"].float(), FOLD) / BYTE
            self._encoded[file] = Encoded(latents[0], latents[1], unknown == 0, shares.half())
        return self._encoded[file]

    def kept(self, index: int) -> dict[str, Tensor]:
        """Return the content of a sector's file; the first use makes it."""
        file = self._file(index)
        if not file.is_file():
            number, camera, _ = self.places[index]
            frame = self.frames[number]
            made = (self._labelled if isinstance(frame, LabelledImage) else self._made)(frame, camera)
            write_whole(file, lambda temporary: save_file(made, temporary), "options.cache")
        return read_tensors(file, "remove it, and it is made again")

    def _file(self, index: int) -> Path:
        number, camera, _ = self.places[index]
        frame = self.frames[number]
        assert frame.root is not None, "frames of data sets have one"
        root = frame.root.resolve()
        folder, place = (Path(self.cache), root) if self.cache else (root / ".lidar2pano", "")
        key = hashlib.sha256(os.fsencode(f"{self._made_by} {place}")).hexdigest()[:16]
        stem = "-".join(part for part in (root.name, *frame.name.split("/"), camera) if part)
        return folder / "sectors" / key / f"{stem}.safetensors"

    @torch.inference_mode()
    def _made(self, frame: Frame, camera: str) -> dict[str, Tensor]:
        view, picture, coverage = self._pictured(frame, camera)
        whole = replace(self.pipeline, view=replace(self.pipeline.view, origin=view.origin))
        scene = whole.translate(frame.scan, Timer(whole.device))
        start = round((whole.view.left - view.left) * whole.view.columns / (whole.view.left - whole.view.right))
        columns = (torch.arange(view.columns) + start) % whole.view.columns
        channels = scene.channels[0, ..., columns]
        remission = (channels[4].clamp(0, 1) * (BYTE - 1)).round() + 1
        made = {
            "probabilities": (scene.probabilities[0, ..., columns] * BYTE).round().byte(),
            "depth_m": scene.depth_m[0, :, columns],  # halves of it would make normals of steps
            "measured": (remission * (channels[0] > 0)).byte(),
            "viewpoint_m": scene.viewpoint_m.float(),
        }
        return {name: value.contiguous() for name, value in made.items()} | pictured(picture, coverage)

    def _labelled(self, frame: Frame, camera: str) -> dict[str, Tensor]:
        """Make the sector of a photograph without a scan: labelled classes are sure, unknown ones no class at all."""
        view, picture, coverage = self._pictured(frame, camera)
        _, calibration, _ = calibrated_image(frame, camera)
        (labels,) = frame.require("camera_labels")
        ids = camera_in_panorama(view, calibration).nearest(torch.from_numpy(CITYSCAPES_TO_COMMON15[labels]), IGNORE)
        classes = torch.arange(len(COMMON15))[:, None, None]
        made = {
            "probabilities": (ids == classes).byte() * BYTE,
            "depth_m": torch.full(ids.shape, FAR_M),
            "measured": torch.zeros(ids.shape, dtype=torch.uint8),
            "viewpoint_m": torch.zeros(1),
        }
        return made | pictured(picture, coverage)

    def _pictured(self, frame: Frame, camera: str) -> tuple[View, Tensor, Tensor]:
        """Return a sector's raster, its picture (3, 2H, 2w) uint8 on one twice as fine, and its coverage."""
        view = self.pipeline.view
        if not camera and frame.panorama_for(view) is not None:
            truth = panorama_on(frame, view.scaled(2), camera_labels=True)
            picture = torch.from_numpy(truth.image).movedim(2, 0)
            return replace(view, origin=truth.view.origin), picture, torch.from_numpy(truth.valid)
        image, calibration, ego_mask = calibrated_image(frame, camera)
        sector = sector_around(at_camera(view, calibration), calibration)
        look_up = camera_in_panorama(sector.scaled(2), calibration)
        picture = look_up.linear(torch.from_numpy(image).movedim(2, 0).float()).round().byte()
        if ego_mask is None:
            return sector, picture, look_up.valid
        return sector, picture, look_up.valid & (look_up.nearest(torch.from_numpy(ego_mask).byte(), 1) == 0)


class PicturedFrames(LatentFrames):
    """Crops with their photographs."""

    def picture(self, index: int, start: int, cells: int) -> tuple[Tensor, Tensor]:
        """Return the photograph of a crop, and its pixels in view."""
        window = (..., slice(start * FACTOR, (start + cells) * FACTOR))
        picture, shown = self.photograph(index)
        return picture[window], shown[window]


def pictured(picture: Tensor, coverage: Tensor) -> dict[str, Tensor]:
    """Return a picture (3, H, W) uint8, as JPEG, and its coverage (H, W) bool, as bits, for a sector's file."""
    stream = io.BytesIO()
    filled = Image.fromarray(without_gaps(picture, coverage).movedim(0, 2).contiguous().numpy())
    filled.save(stream, "JPEG", quality=QUALITY, subsampling=0)
    photograph = torch.frombuffer(bytearray(stream.getvalue()), dtype=torch.uint8)
    return {"photograph": photograph, "coverage": torch.from_numpy(np.packbits(coverage.numpy(), axis=1))}


def level_camera(width: int, height: int) -> Calibration:
    """Return the calibration of a camera that looks level along x, ASSUMED_FIELD_DEG wide, from the sensor's place."""
    focal = width / 2 / math.tan(math.radians(ASSUMED_FIELD_DEG / 2))
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    T_camera_lidar = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return Calibration(K=K, T_camera_lidar=T_camera_lidar, size=(width, height))


def calibrated_image(frame: Frame, camera: str) -> tuple[np.ndarray, Calibration, np.ndarray | None]:
    """Return a camera's image (h, w, 3) uint8, its calibration, and its vehicle's pixels, (h, w) bool, or None."""
    if isinstance(frame, LabelledImage):
        (image,) = frame.require("image")
        return image, level_camera(image.shape[1], image.shape[0]), None
    if not (camera and isinstance(frame, SurroundFrame)):
        image, calibration = frame.require("image", "calibration")
        return image, calibration, None
    taken = frame.cameras[camera]
    assert isinstance(taken.calibration, Calibration), "lenses are left out"
    return taken.image, taken.calibration, taken.ego_mask


def sector_around(view: View, calibration: Calibration) -> View:
    """Return the window of a circular raster, SECTOR_DEG wide, in whose middle the camera looks."""
    width, height = calibration.size
    middle = np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
    x, y, _ = np.linalg.solve(calibration.K @ calibration.T_camera_lidar[:3, :3], middle)
    column = (math.radians(view.left) - math.atan2(y, x)) * view.focal_px
    columns = sector_columns(view)
    return view.window(round(column) - columns // 2, columns)


def sector_columns(view: View) -> int:
    """Return the number of columns of a camera's sector on a circular raster."""
    return round(view.columns * SECTOR_DEG / FULL_TURN / STRIDE) * STRIDE


def without_gaps(picture: Tensor, coverage: Tensor) -> Tensor:
    """Return a picture (3, H, W) whose uncovered pixels have the colour of the nearest covered one in their column.

    Columns without any are copies of the nearest one with some; a picture without coverage stays as it is.
    """
    columns = coverage.any(0).nonzero()[:, 0]
    if not len(columns):
        return picture
    shown = coverage[:, columns]
    source = len(shown) - 1 - nearest_row(shown.flip(0)).flip(0)  # of equally near ones the upper
    filled = picture[:, :, columns].gather(1, source.expand(len(picture), -1, -1))
    nearest = (torch.arange(coverage.shape[1])[:, None] - columns).abs().argmin(1)
    return filled[:, :, nearest]


@cache
def _look_of_data_set(root: Path) -> str:
    """Return the look of a simulated data set, whose world.json is read once; "" for a real one."""
    file = root / "world.json"
    return str(read_json(file).get("look", "")) if file.is_file() else ""
