"""Appearance: a painter's input layers, made from a scene by adding everything invisible to a scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.appearance.cars import Boxes, with_cars
from lidar2pano.appearance.invented_textures import against_the_sky, facades, invented_tones, smooth_noise, solid_noise
from lidar2pano.geometry.rasters import as_float, pad_azimuth
from lidar2pano.hardware import inference_dtype
from lidar2pano.labels import COMMON15
from lidar2pano.scene.depth import FAR_M, depth_code
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import cylinder_points, normals, world_columns
from lidar2pano.views import View

SKY, ROAD, BUILDING, PERSON, VEGETATION = map(COMMON15.id_of, ("sky", "road", "building", "person", "vegetation"))
COARSE_M = (0.25, 1.0, 4.0)  # wavelengths of the noise on the translator's raster
FINE_M = (0.0625, 0.125, 0.5)  # and on the panorama's
SHAPE = 8  # channels beside segments and noise: depth, remission, validity, row, height, normals
TONE = 3  # red, green, blue: how much brighter a picture, or a part of it, is than the mean of its look
DEPTH, TONES, OPENINGS = len(COMMON15), slice(-TONE - 1, -1), -1  # of the layers
LAYERS = len(COMMON15) + SHAPE + len(COARSE_M) + TONE + 1
OBJECT_M = 16.0  # wavelength at which things differ in brightness
# Sheet metal, glass and cloth have no noise, which blotched them; most of them move through the noise, too.
VEHICLES = ("car", "bicycle", "motorcycle", "truck", "other-vehicle")
SMOOTH = tuple(map(COMMON15.id_of, (*VEHICLES, "person", "pole", "traffic-sign")))
PLASTER = 0.5  # share of the fine noise that walls are not given: their plaster was speckled
LOWEST_ROW = -0.5  # of 1 to -1: below it painters painted another asphalt, from a line on
FOOT = 16  # rows like the last one that are painted below it and cut off: beside zero padding a network paints flecks
LEAST_FOOT = 2  # of them that the layers on the panorama's raster reach
ENDS = 2  # columns beyond the seam at either side that the network is given, so that it need not copy images
INPUTS_FRAME, NOISE_FRAME = (FOOT, ENDS), (2 * LEAST_FOOT, ENDS)  # rows and columns
FEW, JOINED_ROWS = 4, 6  # channels, and rows, of layers that are joined at a time
WINDOWS = ((5, 3), (11, 7))  # rows, columns: neighbouring beams are up to 4 rows of the raster apart, and holes more
BEAM_RAD = math.pi / 12  # to each side of a pixel, in which a row is of one beam
MIXED_PX, MOST_UNEVEN = 16.0, 3.0  # pixels that the mean counts for in each row's; largest factor between beams
DIM = 0.6  # share of the mean below which a beam's remission of the road says nothing
NOISE, MARK = 1.7, 3.0  # mean deviations from the road's mean up to which remission is noise, from which it is paint
NEARER = 4  # also where it is below that in so small a part of the columns only


class Hints(NamedTuple):
    """Optional tones and openings of an image; missing values, NaN and None, are invented.

    tones     (B, 3, H, W): how much brighter each pixel is than the mean of its class in its look, in [-1, 1]; invented
              by `invented_tones`.
    openings  (B, H, W) in [0, 1]: windows and doors of walls; invented by `facades`.
    sun       whether trees are invented that stand in a sun.
    """

    tones: Tensor | None = None
    openings: Tensor | None = None
    sun: bool = False


NO_HINTS = Hints()


class Appearance(NamedTuple):
    """The input layers of a painter.

    inputs      (1, LAYERS, H, W) and fine_noise (1, 3, 2H, 2W), both in a frame (`framed`), channels last.
    boxes       of the cars that were drawn, in the world; None without a pose.
    """

    inputs: Tensor
    fine_noise: Tensor
    boxes: Boxes | None


def appear(
    scene: Scene, sharp: float, unread: Sequence[int] = (), sun: bool = False, previous: Boxes | None = None
) -> Appearance:
    """Invent the appearance of a scene; the scene itself stays as it is.

    sharp     power that class probabilities are raised to before they sum to 1 again.
    unread    ids of classes whose remission is not read;  sun: as of Hints.
    previous  boxes of the previous scan. They hang in the world: without a pose they are neither used nor returned.
    """
    posed = scene.T_world_sensor is not None
    whole = with_cars(scene, previous if posed else None)
    depth_m = whole.depth_m if scene.surface_share is None else whole.depth_m / scene.surface_share
    drawn = replace(scene, probabilities=whole.segments, depth_m=depth_m)
    drawn = replace(drawn, probabilities=outlined(drawn, sharp))
    inputs, fine_noise = painter_inputs(drawn, Hints(whole.tones, sun=sun), unread, frame=True)
    return Appearance(inputs, fine_noise, whole.boxes if posed else None)


def sharpened(segments: Tensor, power: Tensor | float) -> Tensor:
    """Raise probabilities (B, classes, H, W) to a power, and normalise their sum to 1."""
    raised = segments.float()
    if not isinstance(power, Tensor) and power in (2, 4):  # a quarter of the time of other powers
        for _ in range(int(power) // 2):
            raised = raised.square()
    else:
        raised = raised.pow(power)
    return raised / raised.sum(1, keepdim=True)


def outlined(scene: Scene, power: float) -> Tensor:
    """Sharpen a scene's probabilities (B, classes, H, W) and cut them out against the sky."""
    raised = sharpened(scene.probabilities, power)
    pose = scene.T_world_sensor
    return against_the_sky(raised, scene.probabilities, scene.depth_m, scene.view, pose, SKY, VEGETATION)


def painter_inputs(
    scene: Scene, hints: Hints = NO_HINTS, unread: Sequence[int] = (), frame: bool = False
) -> tuple[Tensor, Tensor]:
    """Make a painter's inputs (B, LAYERS, H, W) and fine noise (B, 3, 2H, 2W), channels last.

    They are float32; in inference they have the convolutions' type (`hardware.inference_dtype`).
    scene   of its channels only remission and validity are read.
    hints   tones and openings that need not be invented.
    unread  ids of classes whose remission and validity are not read.
    frame   whether to frame them (`framed`), which costs nothing here.
    """
    segments, view, pose = scene.probabilities, scene.view, scene.T_world_sensor
    depth_m = scene.depth_m.float()
    sky = segments[:, SKY] == segments.amax(1)
    radius_m, z_m = cylinder_points(depth_m, view)
    height_m = z_m + scene.viewpoint_m[:, None, None]
    shape = torch.cat([(height_m / 4).clamp(-1, 4)[:, None], normals(radius_m, z_m, view)], 1)
    shape.mul_(as_float(~sky[:, None]))
    shape[:, 1:].mul_(1 - segments[:, PERSON, None].float())  # of two beams each, they became scribbles on people
    remission, valid = _remission(scene, unread)
    row = torch.linspace(1, -1, segments.shape[2], device=segments.device).clamp(min=LOWEST_ROW)
    row = row[None, :, None].expand_as(valid)
    flat = torch.stack([depth_code(depth_m.clamp(max=FAR_M)), remission, valid, row], 1)
    coarse = _noise(scene, depth_m, sky, view, COARSE_M)
    fine = _noise(scene, twice(depth_m), twice(sky), view.scaled(2), FINE_M)
    rough = 1 - _sum_of(segments, SMOOTH)
    coarse.mul_(rough[:, None])
    fine.mul_(twice(rough - PLASTER * segments[:, BUILDING].float())[:, None])
    invented, house = facades(segments[:, BUILDING].float(), radius_m, scene.viewpoint_m, view, pose)
    openings = invented if hints.openings is None else torch.where(hints.openings.isnan(), invented, hints.openings)
    noise = smooth_noise(radius_m, z_m, view, OBJECT_M, pose).clamp(-1, 1)
    left = world_columns(view, pose, radius_m.device)[0][1].float() if hints.sun else None
    tones = invented_tones(segments, height_m, radius_m, noise, house, openings, left)
    if hints.tones is not None:
        tones = tones * as_float(hints.tones.isnan()) + hints.tones.nan_to_num()
    parts = [segments.float(), flat, shape, coarse, tones, openings[:, None]]
    dtype = inference_dtype(depth_m.device)
    frames = (INPUTS_FRAME, NOISE_FRAME) if frame else ((0, 0), (0, 0))
    return _joined(parts, dtype, *frames[0]), _joined([fine], dtype, *frames[1])


def _sum_of(segments: Tensor, ids: Sequence[int]) -> Tensor:
    """Sum the probabilities (B, H, W) of classes of (B, classes, H, W); a fraction of the time of indexing them."""
    zero = torch.zeros_like(segments[:, 0], dtype=torch.float32)
    return sum((segments[:, number].float() for number in ids), start=zero)


def twice(x: Tensor) -> Tensor:
    """Repeat the pixels of (..., H, W) on the raster twice as fine: (..., 2H, 2W)."""
    return torch.stack([x, x], -1).flatten(-2).repeat_interleave(2, -2)


def _noise(scene: Scene, depths: Tensor, skies: Tensor, view: View, waves: Sequence[float]) -> Tensor:
    pairs = zip(depths, skies, strict=True)
    noises = [solid_noise(depth_m, sky, view, waves, scene.T_world_sensor) for depth_m, sky in pairs]
    return torch.stack(noises) if len(noises) > 1 else noises[0][None]  # without another copy


def framed(inputs: Tensor, fine_noise: Tensor) -> tuple[Tensor, Tensor]:
    """Frame the result of `painter_inputs`: ENDS columns beyond the seam at either side, and rows below like the last.

    Those are FOOT of the inputs, and of the noise as many as the last layers reach.
    """
    return _framed(inputs, *INPUTS_FRAME), _framed(fine_noise, *NOISE_FRAME)


def _framed(x: Tensor, rows: int, columns: int) -> Tensor:
    return pad_azimuth(torch.cat([x, x[:, :, -1:].expand(-1, -1, rows, -1)], 2), columns)


def _joined(parts: Sequence[Tensor], dtype: torch.dtype, foot: int = 0, ends: int = 0) -> Tensor:
    """Parts (B, C, H, W) float32 one after the other, channels last in memory, in a frame as of `_framed`.

    On a CPU a few channels are copied one by one and many some rows at a time, in less than half the time of `cat` and
    `contiguous`.
    """
    if parts[0].device.type != "cpu":
        joined = torch.cat([part.to(dtype) for part in parts], 1)
        return _framed(joined, foot, ends).contiguous(memory_format=torch.channels_last)
    batch, _, rows, columns = parts[0].shape
    channels = sum(part.shape[1] for part in parts)
    made = parts[0].new_empty(batch, rows + foot, columns + 2 * ends, channels, dtype=dtype)
    inner = made[:, :, ends : ends + columns]
    if channels <= FEW:
        for number, channel in enumerate(channel for part in parts for channel in part.unbind(1)):
            inner[:, :rows, :, number] = channel
    else:
        for top in range(0, rows, JOINED_ROWS):
            strip = torch.cat([part[:, :, top : top + JOINED_ROWS].to(dtype) for part in parts], 1)
            inner[:, top : top + strip.shape[2]] = strip.movedim(1, 3)
    inner[:, rows:] = inner[:, rows - 1 : rows]
    made[:, :, :ends], made[:, :, ends + columns :] = inner[:, :, columns - ends :], inner[:, :, :ends]
    return made.movedim(3, 1)


def _remission(scene: Scene, unread: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return a painter's remission and its validity (B, H, W): equalised, spread over the gaps between beams, quiet."""
    road, share = scene.probabilities[:, ROAD], 1 - _sum_of(scene.probabilities, unread)
    measured = scene.channels[:, 4].float(), as_float(scene.channels[:, 0] > 0)
    reach = round(BEAM_RAD * scene.view.focal_px)
    remission, valid = spread_out(*equalised_beams(*measured, road, reach))
    return quiet_road(remission, valid, road) * share, valid * share


def spread_out(values: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Means over WINDOWS of the valid pixels around every pixel; the first window with any counts.

    values, valid  (B, H, W), valid 0 or 1; columns are circular.
    Returns the means, 0 where no window holds anything, and (B, H, W) 1 where one does.
    """
    sums = torch.stack([values * valid, valid], 1)
    mean, covered = torch.zeros_like(values), torch.zeros_like(values)
    for rows, columns in WINDOWS:
        total, count = _window_sums(sums, rows, columns).unbind(1)
        new = as_float(count > 0) * (1 - covered)
        mean += new * total / count.clamp(min=1)
        covered += new
    return mean, covered


def equalised_beams(remission: Tensor, valid: Tensor, road: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Remission (B, H, W), so that the road's is the same in all rows, and (B, H, W) 1 where it is used, else 0.

    Beams are not calibrated against each other: in KITTI's scans remission doubles from one row to the next, and a line
    was painted across the road there. A DIM beam sees hardly more than noise, which would become lane marks: none of
    its pixels on the road is used.
    valid  (B, H, W), 0 or 1: where there is any;  road: (B, H, W) probabilities.
    reach  columns to each side of a pixel, which are circular, in which a row is of one beam.
    (A sensor that does not stand upright has a beam in other rows on its other side.)
    """
    weight = valid * road.float()
    sums = torch.stack([remission * weight, weight])
    mean = sums[0].sum((1, 2), keepdim=True) / sums[1].sum((1, 2), keepdim=True).clamp(min=1e-6)
    of_rows = _row_means(sums, mean, reach, MIXED_PX)
    factor = torch.where(of_rows > 0, mean / of_rows.clamp(min=1e-6), 1.0).clamp(1 / MOST_UNEVEN, MOST_UNEVEN)
    nearby = _row_means(sums, mean, reach // NEARER, MIXED_PX // NEARER)
    dim = as_float(torch.minimum(of_rows, nearby) < DIM * mean) * as_float(road > 0.5)
    return remission * factor, valid * (1 - dim)


def quiet_road(remission: Tensor, valid: Tensor, road: Tensor) -> Tensor:
    """Remission (B, H, W) without its noise on the road, once strokes of white paint there.

    A scan's mean deviation from the mean of its road is the measure: up to NOISE of them there is the mean, from MARK
    on what was measured, since lane marks are few and bright, and in between a share of the difference.
    valid  (B, H, W), 0 or 1: where there is any;  road: (B, H, W) probabilities.
    """
    weight = valid * road.float()
    count = weight.sum((1, 2), keepdim=True).clamp(min=1e-6)
    excess = remission - (remission * weight).sum((1, 2), keepdim=True) / count
    deviation = (excess.abs() * weight).sum((1, 2), keepdim=True) / count
    noise = ((MARK - excess.abs() / deviation.clamp(min=1e-6)) / (MARK - NOISE)).clamp(0, 1)
    return remission - weight * noise * excess


def _row_means(sums: Tensor, mean: Tensor, reach: int, mixed: float) -> Tensor:
    """Means (B, H, W) in rows, up to `reach` columns to each side, of sums (2, B, H, W): of values, of their weights.

    mean  (B, 1, 1), which counts as much as `mixed` weights;  columns are circular.
    """
    reach = min(reach, (sums.shape[3] - 1) // 2)
    ends = pad_azimuth(sums.flatten(0, 1)[:, None], reach)[:, 0].cumsum(2)
    total, count = (ends[..., 2 * reach :] - pad(ends, (1, 0))[..., : -2 * reach - 1]).view_as(sums)
    return (total + mixed * mean) / (count + mixed)


def _window_sums(x: Tensor, rows: int, columns: int) -> Tensor:
    """Sums over windows around every pixel of (B, C, H, W); columns are circular, nothing is above and below.

    One way and then the other, by adding shifted images: a tenth of avg_pool2d's time on CPUs.
    """
    height, width = x.shape[2:]
    padded_columns = pad_azimuth(x, columns // 2)
    across = sum(
        (padded_columns[..., shift : shift + width] for shift in range(1, columns)), start=padded_columns[..., :width]
    )
    padded = pad(across, (0, 0, rows // 2, rows // 2))
    return sum((padded[:, :, shift : shift + height] for shift in range(1, rows)), start=padded[:, :, :height])
