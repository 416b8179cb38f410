"""Scene painter: a colour panorama from segments and depth, with texture that hangs on the scene.

An encoder-decoder, circular in azimuth, that sees the shape of things (normals, height above the road) and solid noise
at each pixel's own point, coarse at the translator's raster and fine at the picture's own, on which its last layers
work. Several looks in one network: a learned code per look scales and shifts features (FiLM, Perez et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypedDict, Unpack, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate, pad

from lidar2pano.appearance.cars import Boxes
from lidar2pano.appearance.painter_inputs import DEPTH, ENDS, FINE_M, FOOT, LAYERS, LEAST_FOOT, OPENINGS, TONE, appear
from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.rasters import pad_azimuth
from lidar2pano.labels import COMMON15
from lidar2pano.models.blocks import CircularConv, CircularResidual, SummedSequential, conv_norm_act
from lidar2pano.scene.depth import depth_code
from lidar2pano.scene.record import Scene

QUALITIES = {"fast": 0, "best": 4}  # steps of a latent painter's picture; 0: as many as its settings say
# The look of these classes hardly hangs on their remission, which ends at the highest beam: a painter that reads it
# paints walls in two colours, and in speckles, other ones in each scan of a drive.
UNREAD = ("building", "vegetation", "fence")
STRIDE = 4  # input pixels per pixel of the coarsest level
BLOCKS = 4  # residual blocks there
MOMENTUM = 0.02  # of norm statistics: batches are two small crops
# Inside of a pane no pixel nearby is wall: up to so many rows and columns away, of which nearly all have to be glass.
# Panes farther away than these metres are painted as well as all else; up to the first one none is.
EDGE_PX, NEARLY, PANES_M = 2, 0.75, (5.0, 10.0)
NEAR_CODE, FAR_CODE = depth_code(torch.tensor(PANES_M)).tolist()
GLASS = TONE + 1  # of the last inputs: the colour of panes is a linear function of tones, and of openings, which are 1


class StreamPainter(Protocol):
    """A painter of a stream of scenes."""

    def paint(self, past: Any, scene: Scene, look: str = "") -> tuple[Any, Tensor]:  # noqa: ANN401
        """Paint the panorama of a scan in a stream.

        past  the painter's own record of the previous scan; None at the beginning of a stream.
        look  "A", or "A+B" for the mean of two; "": the painter's own.
        Returns its record for the next scan, None if it needs none, and (1, 3, 2H, 2W) in [-1, 1].
        """
        ...


class LookPainter(nn.Module):
    """A painter of several looks.

    looks  their names;  look: the one painted by default (the first).
    """

    def __init__(self, looks: Sequence[str], look: str = "") -> None:
        super().__init__()
        self.looks, self.look = tuple(looks), look or looks[0]
        self.look_shares(self.look)

    def look_shares(self, look: str) -> list[float]:
        """Return the share of each look in a name, "A" or "A+B" (their mean); InputError for an unknown name."""
        names = [name.strip() for name in (look or self.look).split("+")]
        for name in names:
            if name not in self.looks:
                choices = ", ".join(self.looks)
                raise InputError(f"the painter knows no look {name!r}; it knows {choices}")
        return [names.count(look) / len(names) for look in self.looks]


def check_quality(quality: str) -> None:
    """Raise InputError unless a quality is known."""
    if quality not in QUALITIES:
        raise InputError(f"no quality {quality!r}{closest(quality, QUALITIES)}")


class Switches(TypedDict, total=False):
    """Optional layers of a ScenePainter.

    class_colours  a table of what each look adds to the colours of each class, at first nothing.
    glass          near panes have no texture, but a colour: they were painted with slats. It brings class_colours.
    bilinear       coarse features are enlarged bilinearly; their pixels repeated make a painter paint stairs.
    sun            trees are lit by a sun that is invented, as in photographs; steady pictures flicker more.
    """

    class_colours: bool
    glass: bool
    bilinear: bool
    sun: bool


class ScenePainter(LookPainter):
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
        super().__init__(looks, look)
        fine, middle, coarse, last = widths
        self.sharp = sharp
        if unknown := sorted(switches.keys() - Switches.__annotations__.keys()):
            raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}")
        self.bilinear, self.sun = switches.get("bilinear", False), switches.get("sun", False)
        self.unread = tuple(map(COMMON15.id_of, unread))
        inputs = LAYERS
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

    def forward(self, inputs: Tensor, fine_noise: Tensor, shares: Tensor, tone: Tensor) -> Tensor:
        """Paint.

        inputs, fine_noise  (B, LAYERS, H, W) and (B, 3, 2H, 2W) of an Appearance, in its frame.
        shares  (B, looks): shares of each look;  tone: (B, 3), how much brighter than the mean of its look, in [-1, 1].
        Returns (B, 3, 2H, 2W) in [-1, 1]. Raises InputError unless H and W are multiples of 4.
        """
        rows, columns = inputs.shape[2] - FOOT, inputs.shape[3] - 2 * ENDS
        if rows % STRIDE or columns % STRIDE:
            message = f"inputs of {tuple(inputs.shape[2:])} pixels, of which ({rows}, {columns}) are no frame"
            raise InputError(f"{message}: these rows, columns must divide by {STRIDE}")
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
        x = self.mix1(self._grown(self.up1(x, inputs4), 1), pad_azimuth(middle, 1), inputs2, has_ends=True)
        x = self._grown(self.up0(self._tuned(1, x, code)), ENDS)
        x = self._tuned(2, self.mix0(x, pad_azimuth(fine, 1, margin=1), inputs, has_ends=True), code)
        x = _enlarged(pad_azimuth(self.narrow(x, has_ends=True)[:, :, : rows + LEAST_FOOT], 1))
        first, second = self.texture
        x = self.colour(second(first(x, fine_noise, has_ends=True), has_ends=True))
        if self.class_colours is not None:
            added, share = self._flat_colours(self.class_colours.weight, inputs, shares)
            if share is not None:
                x = x * _enlarged(1 - share[:, :, : rows + LEAST_FOOT])
            x = x + _enlarged(added[:, :, : rows + LEAST_FOOT])
        return torch.tanh(x[:, :, : 2 * rows])

    def paint(self, past: Boxes | None, scene: Scene, look: str = "") -> tuple[Boxes | None, Tensor]:
        """Paint a scan; arguments and answer as of StreamPainter.

        past  boxes of the cars in the previous scan: where the sensor's pose is known, a car keeps its box.
        """
        appearance = appear(scene, self.sharp, self.unread, self.sun, past)
        shares = torch.tensor([self.look_shares(look)], device=scene.depth_m.device)
        image = self(appearance.inputs, appearance.fine_noise, shares, shares.new_zeros(1, TONE))
        return appearance.boxes, image

    def _grown(self, x: Tensor, ends: int) -> Tensor:
        """Features (B, C, H, W) on the next finer raster, padded by so many columns: (B, C, 2H, 2W + 2 ends)."""
        if not self.bilinear:
            return pad_azimuth(_enlarged(x), ends)
        grown = interpolate(pad_azimuth(x, ends), scale_factor=2.0, mode="bilinear", align_corners=False)
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
        pane_share = conv2d(parts[:, -2:-1], parts.new_full((1, 1, size, size), size**-2.0), padding=(EDGE_PX, 0))
        colours, glass, _, depth = parts[..., ENDS:-ENDS].split((TONE, TONE, 1, 1), 1)
        near = ((FAR_CODE - depth) / (FAR_CODE - NEAR_CODE)).clamp(0, 1)
        share = ((pane_share - NEARLY) / (1 - NEARLY)).clamp(0, 1) * near
        return colours + share * (glass - colours), share

    def _tuned(self, number: int, x: Tensor, code: Tensor) -> Tensor:
        factor, shift = self.tuned[number](code)[..., None, None].to(x.dtype).chunk(2, 1)
        return torch.addcmul(shift, x, 1 + factor)


def _padded(table: Tensor, first: int, channels: int) -> Tensor:
    """Return a table (looks, 3 n) of colours of n inputs, from the first on, for all inputs: (3 looks, channels)."""
    rows = table.view(len(table) * TONE, -1)
    return pad(rows, (first, channels - first - rows.shape[1]))


def _mixed(inputs: Tensor, tables: Sequence[Tensor], picked: Sequence[int], shares: Tensor) -> Tensor:
    """Mix three channels of each table (3 looks, C) by the shares (B, looks) of looks, and add the inputs picked."""
    looks, copies = shares.shape[1], torch.eye(inputs.shape[1])[list(picked)].to(inputs)
    weights = torch.cat([*(table.to(inputs.dtype) for table in tables), copies])
    colours = conv2d(inputs, weights[..., None, None])
    look_weights = [
        shares.repeat_interleave(TONE, 1).repeat(1, len(tables)),
        shares.new_ones(1, len(picked)).expand(shares.shape[0], -1),
    ]
    weighted = colours * torch.cat(look_weights, 1)[..., None, None].to(colours.dtype)
    sums = torch.block_diag(*[torch.eye(TONE).repeat(1, looks)] * len(tables), torch.eye(len(picked)))
    return conv2d(weighted, sums.to(weighted)[..., None, None])


def _halved(x: Tensor) -> Tensor:
    """Means of 2 x 2 pixels: `avg_pool2d` as a convolution, in a seventh of its time in OpenVINO."""
    channels = x.shape[1]
    return conv2d(x, x.new_full((channels, 1, 2, 2), 0.25), stride=2, groups=channels)


def _enlarged(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2)
