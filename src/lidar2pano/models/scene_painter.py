"""Scene painter: a colour panorama from segments and depth, with texture that hangs on the scene.

An encoder-decoder, circular in azimuth, that sees the shape of things (normals, height above the road) and solid noise
at each pixel's own point, coarse at the translator's raster and fine at the picture's own, on which its last layers
work. Several looks in one network: a learned code per look scales and shifts features (FiLM, Perez et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypedDict, Unpack, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate, pad

from lidar2pano.errors import InputError
from lidar2pano.geometry.car_body import Boxes
from lidar2pano.geometry.columns import world_columns
from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.outlines import against_the_sky
from lidar2pano.geometry.solid_noise import smooth_noise, solid_noise
from lidar2pano.geometry.surface import cylinder_points, normals, viewpoint_height
from lidar2pano.geometry.wall_openings import facades
from lidar2pano.geometry.whole_cars import Classes, WholeCars, whole_cars
from lidar2pano.hardware import inference_dtype
from lidar2pano.labels import COMMON15
from lidar2pano.models.blocks import CircularConv, CircularResidual, SummedSequential, closed, conv_norm_act
from lidar2pano.models.invented_tones import invented_tones
from lidar2pano.models.remission import BEAM_RAD, evened_beams, quiet_road, spread_out
from lidar2pano.models.titan_pano import FAR_M, depth_code
from lidar2pano.views import View

NAMES = ("sky", "road", "building", "car", "person", "traffic-sign", "vegetation")
SKY, ROAD, BUILDING, CAR, PERSON, SIGN, VEGETATION = map(COMMON15.id_of, NAMES)
COARSE_M = (0.25, 1.0, 4.0)  # wavelengths of the noise on the translator's raster
FINE_M = (0.0625, 0.125, 0.5)  # and on the picture's
SHAPE = 8  # channels beside segments and noise: depth, remission, validity, row, height, normals
OBJECT_M = 16.0  # wavelength at which things differ in brightness
# What is of sheet metal, glass or cloth is given no noise, which blotched it; most of it moves through the noise, too.
VEHICLES = ("car", "bicycle", "motorcycle", "truck", "other-vehicle")
SMOOTH = tuple(map(COMMON15.id_of, (*VEHICLES, "person", "pole", "traffic-sign")))
PLASTER = 0.5  # share of the fine noise that walls are not given: their plaster was speckled
# Below this row, of 1 to -1, painters painted another asphalt, from a line on.
LOWEST_ROW = -0.5
# What these classes look like hardly hangs on their remission, which ends at the highest beam: a painter that reads it
# paints walls in two colours, and in speckles, other ones in each scan of a drive.
UNREAD = ("building", "vegetation", "fence")
GROUND = tuple(map(COMMON15.id_of, ("road", "sidewalk", "terrain")))
CARS = Classes(
    CAR,
    others=tuple(map(COMMON15.id_of, ("truck", "other-vehicle", "bicycle", "motorcycle"))),
    ground=GROUND,
)
FOOT = 16  # rows like the last one that are painted below it and cut off: beside zero padding a network paints flecks
LEAST_FOOT = 2  # of them that the layers on the picture's raster reach
ENDS = 2  # columns beyond the seam at either side that the network is given, so that it need not copy images
INPUTS_FRAME, NOISE_FRAME = (FOOT, ENDS), (2 * LEAST_FOOT, ENDS)  # rows and columns
STRIDE = 4  # input pixels per pixel of the coarsest level
BLOCKS = 4  # residual blocks there
FEW, JOINED_ROWS = 4, 6  # channels, and rows, of inputs that are joined at a time
MOMENTUM = 0.02  # of norm statistics: batches are two small crops
TONE = 3  # red, green, blue: how much brighter a picture, or a part of it, is than the mean of its look
DEPTH, TONES, OPENINGS = len(COMMON15), slice(-TONE - 1, -1), -1  # of the painter's inputs
# Inside of a pane no pixel nearby is wall: up to so many rows and columns away, of which nearly all have to be glass.
# Panes farther away than these metres are painted as well as all else; up to the first one none is.
EDGE_PX, NEARLY, PANES_M = 2, 0.75, (5.0, 10.0)
NEAR_CODE, FAR_CODE = depth_code(torch.tensor(PANES_M)).tolist()
GLASS = TONE + 1  # of the last inputs: the colour of panes is a linear function of tones, and of openings, which are 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What a painter paints, on the translator's raster H x W.

    segments  (1, classes, H, W) probabilities;  depth_m: (1, H, W) metres;  channels: (1, 5, H, W) of a RangeImage.
    view      the raster;  T_world_sensor: (4, 4) float64, the sensor's pose in a frame that stands still, if known.
    look      "A", or "A+B" for the mean of two; "": the painter's own.
    tones     (1, 3, H, W) as of `with_cars`, where it was called.
    """

    segments: Tensor
    depth_m: Tensor
    channels: Tensor
    view: View
    T_world_sensor: np.ndarray | None = None
    look: str = ""
    tones: Tensor | None = None


class Known(NamedTuple):
    """What is known of how things look; where it is NaN, and None, it is invented.

    tones     (B, 3, H, W): how much brighter each pixel is than the mean of its class in its look, in [-1, 1]; invented
              as `invented_tones` has them.
    openings  (B, H, W) in [0, 1]: where walls have windows and doors; invented as `facades` has them.
    sun       whether trees are invented that stand in a sun.
    """

    tones: Tensor | None = None
    openings: Tensor | None = None
    sun: bool = False


NOTHING_KNOWN = Known()


class StreamPainter(Protocol):
    """What the pipeline asks of a painter."""

    def paint(self, past: Any, scene: Scene) -> tuple[Any, Tensor]:  # noqa: ANN401
        """Paint the panorama of a scan that follows others.

        past  what it returned with the scan before; None at the beginning of a stream.
        Returns what it wants back with the next scan, None if nothing, and (1, 3, 2H, 2W) in [-1, 1].
        """
        ...


class Switches(TypedDict, total=False):
    """What a ScenePainter may have.

    class_colours  a table of what each look adds to the colours of each class, at first nothing.
    glass          near panes have no texture, but a colour: they were painted with slats. It brings class_colours.
    bilinear       coarse features are enlarged bilinearly; their pixels repeated make a painter paint stairs.
    sun            trees are lit by a sun that is invented, as in photographs; steady pictures flicker more.
    """

    class_colours: bool
    glass: bool
    bilinear: bool
    sun: bool


class ScenePainter(nn.Module):
    """RGB from segments and geometry.

    looks    names of the looks it knows;  look: the one that is painted where none is given (default: the first).
    widths   channels at 1/1, 1/2, 1/4 of the input raster, and at the picture's raster.
    code     numbers per look.
    sharp    power that class probabilities are raised to before they sum to 1 again.
    unread   classes whose remission is not read.
    colour_kernel  rows and columns of the last convolution, on the picture's raster.
    switches  see there; all are off by default.
    """

    def __init__(
        self,
        looks: Sequence[str] = ("day",),
        look: str = "",
        widths: Sequence[int] = (32, 80, 144, 16),
        code: int = 16,
        sharp: float = 2.0,
        unread: Sequence[str] = UNREAD,
        colour_kernel: int = 3,
        **switches: Unpack[Switches],
    ) -> None:
        super().__init__()
        fine, middle, coarse, last = widths
        self.looks, self.look, self.sharp = tuple(looks), look or looks[0], sharp
        if unknown := sorted(switches.keys() - Switches.__annotations__.keys()):
            raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}")
        self.bilinear, self.sun = switches.get("bilinear", False), switches.get("sun", False)
        self.unread = tuple(map(COMMON15.id_of, unread))
        self.look_shares(self.look)
        inputs = len(COMMON15) + SHAPE + len(COARSE_M) + TONE + 1
        self.codes = nn.Embedding(len(self.looks), code)
        self.stem = conv_norm_act(inputs, fine)
        self.down1 = SummedSequential(conv_norm_act(fine, middle, stride=2), CircularResidual(middle))
        self.down2 = conv_norm_act(middle, coarse, stride=2)
        self.trunk = nn.ModuleList([CircularResidual(coarse, dilation=(1, 2, 4)[i % 3]) for i in range(BLOCKS)])
        self.up1 = conv_norm_act(coarse + inputs, middle, 1)
        self.mix1 = SummedSequential(conv_norm_act(2 * middle + inputs, middle), CircularResidual(middle))
        self.up0 = conv_norm_act(middle, fine, 1)
        self.mix0 = conv_norm_act(2 * fine + inputs, fine)
        self.narrow = conv_norm_act(fine, last)
        self.texture = nn.Sequential(conv_norm_act(last + len(FINE_M), last), conv_norm_act(last, last))
        self.colour = CircularConv(last, 3, colour_kernel)
        self.tuned = nn.ModuleList([nn.Linear(code + TONE, 2 * width) for width in (coarse, middle, fine)])
        colours = TONE * len(COMMON15)
        has_colours = switches.get("class_colours") or switches.get("glass")
        self.class_colours = nn.Embedding(len(self.looks), colours) if has_colours else None
        self.glass = nn.Embedding(len(self.looks), TONE * GLASS) if switches.get("glass") else None
        for part in self.modules():
            if isinstance(part, nn.BatchNorm2d):
                part.momentum = MOMENTUM
        for layer in self.tuned:
            nn.init.normal_(cast(Tensor, layer.weight), std=0.05)
            nn.init.zeros_(cast(Tensor, layer.bias))
        for table in (self.class_colours, self.glass):
            if table is not None:
                nn.init.zeros_(table.weight)

    def look_shares(self, look: str) -> list[float]:
        """Shares of each look in what a name stands for, "A" or "A+B" (their mean); InputError for an unknown name."""
        names = [name.strip() for name in (look or self.look).split("+")]
        for name in names:
            if name not in self.looks:
                known = ", ".join(self.looks)
                raise InputError(f"the painter knows no look {name!r}; it knows {known}")
        return [names.count(look) / len(names) for look in self.looks]

    def forward(self, inputs: Tensor, fine_noise: Tensor, shares: Tensor, tone: Tensor) -> Tensor:
        """Paint.

        inputs, fine_noise  (B, classes + SHAPE + 7, H, W) and (B, 3, 2H, 2W) of `painter_inputs`, both `framed`.
        shares  (B, looks): shares of each look;  tone: (B, 3), how much brighter than the mean of its look, in [-1, 1].
        Returns (B, 3, 2H, 2W) in [-1, 1]. Raises InputError unless H and W are multiples of 4.
        """
        rows, columns = inputs.shape[2] - FOOT, inputs.shape[3] - 2 * ENDS
        if rows % STRIDE or columns % STRIDE:
            given = f"inputs of {tuple(inputs.shape[2:])} pixels, of which ({rows}, {columns}) are no frame"
            raise InputError(f"{given}: these rows, columns must divide by {STRIDE}")
        code = torch.cat([shares @ self.codes.weight, tone], 1)
        fine = self.stem(inputs, has_ends=True)
        inputs, fine_noise = inputs.to(fine.dtype), fine_noise.to(fine.dtype)  # one float32 part would make all float32
        inputs2 = _halved(inputs)
        inputs4 = _halved(inputs2[..., 1:-1])
        middle = self.down1(fine, has_ends=True)
        x = self._tuned(0, self.down2(middle), code)
        for block in self.trunk:
            x = block(x)
        # enlarged, not shuffled: pixel shuffles leave a weave of lines two and four pixels apart (Odena et al. 2016)
        x = self.mix1(self._grown(self.up1(x, inputs4), 1), closed(middle, 1), inputs2, has_ends=True)
        x = self._grown(self.up0(self._tuned(1, x, code)), ENDS)
        x = self._tuned(2, self.mix0(x, closed(fine, 1, before=1), inputs, has_ends=True), code)
        x = _enlarged(closed(self.narrow(x, has_ends=True)[:, :, : rows + LEAST_FOOT], 1))
        first, second = self.texture
        x = self.colour(second(first(x, fine_noise, has_ends=True), has_ends=True))
        if self.class_colours is not None:
            added, share = self._flat_colours(self.class_colours.weight, inputs, shares)
            if share is not None:
                x = x * _enlarged(1 - share[:, :, : rows + LEAST_FOOT])
            x = x + _enlarged(added[:, :, : rows + LEAST_FOOT])
        return torch.tanh(x[:, :, : 2 * rows])

    def paint(self, past: object, scene: Scene) -> tuple[None, Tensor]:  # noqa: ARG002
        """Paint every scan for itself; arguments and answer as of StreamPainter."""
        segments = outlined(scene.segments, self.sharp, scene.depth_m, scene.view, scene.T_world_sensor)
        inputs, fine_noise = painter_inputs(
            segments,
            scene.depth_m,
            scene.channels,
            scene.view,
            scene.T_world_sensor,
            known=Known(scene.tones, sun=self.sun),
            unread=self.unread,
            frame=True,
        )
        shares = torch.tensor([self.look_shares(scene.look)], device=inputs.device)
        return None, self(inputs, fine_noise, shares, shares.new_zeros(1, TONE))

    def _grown(self, x: Tensor, ends: int) -> Tensor:
        """Features (B, C, H, W) on the next finer raster, `closed` by so many columns: (B, C, 2H, 2W + 2 ends)."""
        if not self.bilinear:
            return closed(_enlarged(x), ends)
        grown = interpolate(closed(x, ends), scale_factor=2.0, mode="bilinear", align_corners=False)
        return grown[..., ends:-ends]

    def _flat_colours(self, table: Tensor, inputs: Tensor, shares: Tensor) -> tuple[Tensor, Tensor | None]:
        """What is added to the network's colours (B, 3, H, W), without ENDS, and by how much these count less before.

        By convolutions, beside which engines reorder nothing; of colours of classes and of near panes' glass.
        """
        channels = inputs.shape[1]
        tables = [_padded(table, 0, channels)]
        if self.glass is None:
            return _mixed(inputs[..., ENDS:-ENDS], tables, [], shares), None
        tables.append(_padded(self.glass.weight, channels - GLASS, channels))
        parts = _mixed(inputs, tables, [channels + OPENINGS, DEPTH], shares)
        size = 2 * EDGE_PX + 1
        around = conv2d(parts[:, -2:-1], parts.new_full((1, 1, size, size), size**-2.0), padding=(EDGE_PX, 0))
        known, glass, _, depth = parts[..., ENDS:-ENDS].split((TONE, TONE, 1, 1), 1)
        near = ((FAR_CODE - depth) / (FAR_CODE - NEAR_CODE)).clamp(0, 1)
        share = ((around - NEARLY) / (1 - NEARLY)).clamp(0, 1) * near
        return known + share * (glass - known), share

    def _tuned(self, number: int, x: Tensor, code: Tensor) -> Tensor:
        factor, shift = self.tuned[number](code)[..., None, None].to(x.dtype).chunk(2, 1)
        return torch.addcmul(shift, x, 1 + factor)


def _padded(table: Tensor, first: int, channels: int) -> Tensor:
    """A table (looks, 3 n) of colours that hang on n of the inputs, from the first on: (3 looks, channels)."""
    rows = table.view(len(table) * TONE, -1)
    return pad(rows, (first, channels - first - rows.shape[1]))


def _mixed(inputs: Tensor, tables: Sequence[Tensor], picked: Sequence[int], shares: Tensor) -> Tensor:
    """Of each table (3 looks, C) three channels, by the shares (B, looks) of looks; and those of the inputs picked."""
    looks, alone = shares.shape[1], torch.eye(inputs.shape[1])[list(picked)].to(inputs)
    each = conv2d(inputs, torch.cat([*(table.to(inputs.dtype) for table in tables), alone])[..., None, None])
    by = [
        shares.repeat_interleave(TONE, 1).repeat(1, len(tables)),
        shares.new_ones(1, len(picked)).expand(shares.shape[0], -1),
    ]
    sums = torch.block_diag(*[torch.eye(TONE).repeat(1, looks)] * len(tables), torch.eye(len(picked)))
    return conv2d(each * torch.cat(by, 1)[..., None, None].to(each.dtype), sums.to(each)[..., None, None])


def sharpened(segments: Tensor, power: Tensor | float) -> Tensor:
    """Probabilities (B, classes, H, W) raised to a power, so that they sum to 1 again."""
    raised = segments.float()
    if not isinstance(power, Tensor) and power in (2, 4):  # a quarter of the time of other powers
        for _ in range(int(power) // 2):
            raised = raised.square()
    else:
        raised = raised.pow(power)
    return raised / raised.sum(1, keepdim=True)


def outlined(
    segments: Tensor, power: float, depth_m: Tensor, view: View, T_world_sensor: np.ndarray | None = None
) -> Tensor:
    """What is painted of a translator's probabilities (B, classes, H, W): sharpened, and cut out against the sky."""
    raised = sharpened(segments, power)
    return against_the_sky(raised, segments, depth_m, view, T_world_sensor, SKY, VEGETATION)


def painter_inputs(  # noqa: PLR0913, PLR0917 the record Scene has one look and one sample
    segments: Tensor,
    depth_m: Tensor,
    image: Tensor,
    view: View,
    T_world_sensor: np.ndarray | None = None,
    known: Known = NOTHING_KNOWN,
    unread: Sequence[int] = (),
    frame: bool = False,
) -> tuple[Tensor, Tensor]:
    """What the network sees: (B, classes + SHAPE + 7, H, W) and fine noise (B, 3, 2H, 2W), channels last.

    They are float32; in inference what convolutions compute in (`hardware.inference_dtype`).

    segments  (B, classes, H, W): probabilities.
    depth_m   (B, H, W): metres, everywhere.
    image     (B, 5, H, W): a RangeImage's channels, of which remission and validity are used.
    view      the raster H x W;  T_world_sensor: (4, 4), where the noise hangs (None: on the sensor's frame).
    known     tones and openings that need not be invented.
    unread    ids of classes whose remission and validity are not used.
    frame     whether they are to be `framed`, which in here costs nothing.
    """
    depth_m = depth_m.float()
    highest = segments.amax(1)
    sky = segments[:, SKY] == highest
    radius_m, z_m, above_m = _points(segments[:, ROAD] == highest, depth_m, view)
    height_m = z_m + above_m[:, None, None]
    shape = torch.cat([(height_m / 4).clamp(-1, 4)[:, None], normals(radius_m, z_m, view)], 1)
    shape.mul_(as_float(~sky[:, None]))
    shape[:, 1:].mul_(1 - segments[:, PERSON, None].float())  # of two beams each, they became scribbles on people
    read = 1 - _together(segments, unread)
    measured = image[:, 4].float(), as_float(image[:, 0] > 0)
    remission, valid = spread_out(*evened_beams(*measured, segments[:, ROAD], round(BEAM_RAD * view.focal_px)))
    remission, valid = quiet_road(remission, valid, segments[:, ROAD]) * read, valid * read
    row = torch.linspace(1, -1, segments.shape[2], device=segments.device).clamp(min=LOWEST_ROW)
    row = row[None, :, None].expand_as(valid)
    flat = torch.stack([depth_code(depth_m.clamp(max=FAR_M)), remission, valid, row], 1)
    coarse = _noise(depth_m, sky, view, COARSE_M, T_world_sensor)
    fine = _noise(twice(depth_m), twice(sky), view.scaled(2), FINE_M, T_world_sensor)
    rough = 1 - _together(segments, SMOOTH)
    coarse.mul_(rough[:, None])
    fine.mul_(twice(rough - PLASTER * segments[:, BUILDING].float())[:, None])
    invented, house = facades(segments[:, BUILDING].float(), radius_m, above_m, view, T_world_sensor)
    openings = invented if known.openings is None else torch.where(known.openings.isnan(), invented, known.openings)
    noise = smooth_noise(radius_m, z_m, view, OBJECT_M, T_world_sensor).clamp(-1, 1)
    left = world_columns(view, T_world_sensor, radius_m.device)[0][1].float() if known.sun else None
    tones = invented_tones(segments, height_m, radius_m, noise, house, openings, left)
    if known.tones is not None:
        tones = tones * as_float(known.tones.isnan()) + known.tones.nan_to_num()
    parts = [segments.float(), flat, shape, coarse, tones, openings[:, None]]
    dtype = inference_dtype(depth_m.device)
    frames = (INPUTS_FRAME, NOISE_FRAME) if frame else ((0, 0), (0, 0))
    return _joined(parts, dtype, *frames[0]), _joined([fine], dtype, *frames[1])


def with_cars(
    segments: Tensor,
    depth_m: Tensor,
    view: View,
    T_world_sensor: np.ndarray | None = None,
    earlier: Boxes | None = None,
) -> WholeCars:
    """A scene with whole cars: see `whole_cars`; arguments as of `painter_inputs`."""
    radius_m, _, above_m = _points(segments[:, ROAD] == segments.amax(1), depth_m, view)
    return whole_cars(segments.float(), depth_m.float(), radius_m, above_m, view, T_world_sensor, CARS, earlier)


def _points(road: Tensor, depth_m: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor]:
    """`cylinder_points`, and how high the view's origin is above the road (B, H, W) bool: (B,) metres."""
    radius_m, z_m = cylinder_points(depth_m, view)
    return radius_m, z_m, viewpoint_height(radius_m, z_m, road, view)


def _together(segments: Tensor, ids: Sequence[int]) -> Tensor:
    """The probability (B, H, W) of several classes of (B, classes, H, W); a fraction of the time of indexing them."""
    return sum((segments[:, each].float() for each in ids), start=torch.zeros_like(segments[:, 0], dtype=torch.float32))


def twice(x: Tensor) -> Tensor:
    """(..., H, W) on the raster twice as fine: (..., 2H, 2W)."""
    return torch.stack([x, x], -1).flatten(-2).repeat_interleave(2, -2)


def _noise(depths: Tensor, skies: Tensor, view: View, waves: Sequence[float], pose: np.ndarray | None) -> Tensor:
    noises = [solid_noise(*scene, view, waves, pose) for scene in zip(depths, skies, strict=True)]
    return torch.stack(noises) if len(noises) > 1 else noises[0][None]  # without another copy


def framed(inputs: Tensor, fine_noise: Tensor) -> tuple[Tensor, Tensor]:
    """What `painter_inputs` made, with ENDS columns beyond the seam at either side, and rows below like the last one.

    Those are FOOT of the inputs, and of the noise as many as the last layers reach.
    """
    return _framed(inputs, *INPUTS_FRAME), _framed(fine_noise, *NOISE_FRAME)


def _framed(x: Tensor, rows: int, columns: int) -> Tensor:
    return closed(torch.cat([x, x[:, :, -1:].expand(-1, -1, rows, -1)], 2), columns)


def _halved(x: Tensor) -> Tensor:
    """Means of 2 x 2 pixels: `avg_pool2d` as a convolution, in a seventh of its time in OpenVINO."""
    channels = x.shape[1]
    return conv2d(x, x.new_full((channels, 1, 2, 2), 0.25), stride=2, groups=channels)


def _enlarged(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2)


def _joined(parts: Sequence[Tensor], dtype: torch.dtype, below: int = 0, ends: int = 0) -> Tensor:
    """Parts (B, C, H, W) float32 one after the other, channels last in memory, in a frame as of `_framed`.

    On a CPU a few channels are copied one by one and many some rows at a time, in less than half the time of `cat` and
    `contiguous`.
    """
    if parts[0].device.type != "cpu":
        joined = torch.cat([part.to(dtype) for part in parts], 1)
        return _framed(joined, below, ends).contiguous(memory_format=torch.channels_last)
    batch, _, rows, columns = parts[0].shape
    channels = sum(part.shape[1] for part in parts)
    made = parts[0].new_empty(batch, rows + below, columns + 2 * ends, channels, dtype=dtype)
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
