"""Latent painter: the picture of a scene by conditional flow matching on the latents of an autoencoder.

A mean network regresses the latents from the scene; a flow network leads noise to latents along
straight lines (Lipman et al. 2023; Liu et al. 2023), given the same conditions and the mean. Conditions are dropped in
some training samples, so that guidance can be used (Ho and Salimans 2022), and the flow also learns long steps, each
from two of half its length, until one or two of them suffice (shortcut models, Frans et al. 2024). What a camera sees
may be given: as latents in its place, and as a style for all directions, means and deviations (after AdaIN, Huang and
Belongie 2017). Every convolution is circular in azimuth, and features are normalised over each pixel's channels alone:
a sector is painted as it is within a panorama.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, layer_norm, linear, max_pool2d, pixel_unshuffle, silu

from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import pad_azimuth
from lidar2pano.labels import COMMON15
from lidar2pano.models.autoencoder import FACTOR, Autoencoder, encode_columns
from lidar2pano.models.blocks import CircularConv, check_size
from lidar2pano.models.stream_painter import QUALITIES, check_variant
from lidar2pano.models.world_noise import Particles, world_noise
from lidar2pano.scene.depth import FAR_M, depth_code
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import normals, slopes

FOLD = 4  # pixels of the scene's raster per pixel of the latents, in rows and in columns
HEIGHT_M = 4.0  # of a surface above the road, per unit of its condition
HEIGHTS = (-1.0, 4.0)  # bounds of this condition
SLOPE = 0.3  # tangent of elevation per unit of the last condition
CLASSES, GEOMETRY, MEASUREMENT = slice(0, 16), slice(16, 22), slice(22, 25)  # groups of conditions, each may be absent
REMISSION = 23  # of a measured pixel, in MEASUREMENT
SIDEWAYS = 19  # a mirror changes the sign of this condition
CONDITIONS = 26
SKY = COMMON15.id_of("sky")
STRIDE = 4 * FOLD  # pixels of the scene's raster per pixel of the coarsest level
WAVES = 32  # of the embedding of times, as many sines as cosines
FASTEST = 1e3  # angular frequency of the last of them, for times in [0, 1]; the first one's is 1
GUIDANCE = 1.4  # of learned steps: the conditioned velocity's weight against the unconditional one
FAINT = 1e-3  # deviation of the first weights of a layer whose output is next to nothing at first
CODE_DEVIATION = 0.1  # of the looks' codes at first
LEARNED_STEPS = (1, 2, 4)  # numbers of a picture's steps, whose lengths the flow learns


def conditions_of(scene: Scene) -> Tensor:
    """Return the conditions (B, CONDITIONS, H, W) float32 of scenes, on their raster.

    CLASSES      probabilities of COMMON15.
    GEOMETRY     of surfaces, 0 in the sky: depth code, height above the road, normals in the column's own axes; 1.
    MEASUREMENT  whether a point lies in the pixel, its remission; 1.
    The last one is the elevation. An absent group is 0 in all its channels.
    """
    depth_m, view, device = scene.depth_m.float(), scene.view, scene.depth_m.device
    surface = (scene.ids != SKY).float()
    radius_m, z_m = scene.cylinder
    height = ((z_m + scene.viewpoint_m[:, None, None]) / HEIGHT_M).clamp(*HEIGHTS)
    measured, present = scene.measured.float(), torch.ones_like(surface)
    elevation = slopes(view, device=device)[:, None].expand_as(depth_m) / SLOPE
    remission = scene.channels[:, 4].float() * measured
    shape = torch.stack([depth_code(depth_m.clamp(max=FAR_M)), height, *normals(radius_m, z_m, view).unbind(1)], 1)
    others = torch.stack([present, measured, remission, present, elevation], 1)
    return torch.cat([scene.probabilities.float(), shape * surface[:, None], others], 1)


def mirrored(conditions: Tensor) -> Tensor:
    """Return conditions (..., CONDITIONS, H, W) of the mirrored scene."""
    flipped = conditions.flip(-1)
    flipped[..., SIDEWAYS, :, :] *= -1
    return flipped


class ModulatedResidual(nn.Module):
    """Two convolutions behind pixel-wise layer norms and SiLU; the second norm is scaled and shifted by a code.

    At first it is nearly an identity: (B, C, H, W), scale and shift (B, C, 1, 1) -> (B, C, H, W). A ConditionedUNet
    computes the modulations (B, K) -> (B, 2C) of all of its blocks at once.
    """

    def __init__(self, width: int, code: int) -> None:
        super().__init__()
        self.norm = nn.Parameter(torch.ones(width))
        self.first, self.second = CircularConv(width, width), CircularConv(width, width)
        self.modulation = nn.Linear(code, 2 * width)
        nn.init.normal_(self.second.weight, std=FAINT)

    def forward(self, x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
        """Add the residual. Columns of the other end are put to it once, for both convolutions."""
        ends = self.first.reach + self.second.reach
        hidden = self.first(silu(pixel_norm(pad_azimuth(x, ends), self.norm)), has_ends=True)
        hidden = torch.addcmul(shift.to(hidden.dtype), pixel_norm(hidden), 1 + scale.to(hidden.dtype))
        return x + self.second(silu(hidden), has_ends=True)


def pixel_norm(x: Tensor, weight: Tensor | None = None) -> Tensor:
    """Normalise each pixel of (B, C, H, W) over its channels; channels last in memory stays so."""
    weight = None if weight is None else weight.to(x.dtype)
    return layer_norm(x.movedim(1, 3), (x.shape[1],), weight).movedim(3, 1)


class ConditionedUNet(nn.Module):
    """A U-Net of three levels on the raster of latents: (B, inputs, h, w), folded conditions -> (B, outputs, h, w).

    conditions  channels of the scene, on a raster FOLD times finer;  inputs: channels beside them, possibly 0.
    widths      channels at 1/1, 1/2 and 1/4 of the raster;  blocks: residual blocks there, on the way down and up.
    """

    def __init__(
        self, conditions: int, inputs: int, outputs: int, widths: Sequence[int], blocks: Sequence[int], code: int
    ) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.fold = nn.Sequential(CircularConv(conditions * FOLD**2, fine, 1), nn.SiLU(), CircularConv(fine, fine))
        self.input = CircularConv(inputs, fine) if inputs else None
        self.down = nn.ModuleList([CircularConv(fine, middle, stride=2), CircularConv(middle, coarse, stride=2)])
        self.up = nn.ModuleList([CircularConv(middle, fine), CircularConv(coarse, middle)])
        levels = list(zip(widths, blocks, strict=True))
        self.before, self.after = (
            nn.ModuleList(
                [nn.ModuleList([ModulatedResidual(width, code) for _ in range(count)]) for width, count in part]
            )
            for part in (levels, levels[:2])
        )
        self.last = CircularConv(fine, outputs)
        nn.init.normal_(self.last.weight, std=FAINT)

    def forward(self, conditions: Tensor, code: Tensor, inputs: Tensor | None = None) -> Tensor:
        """Return (B, outputs, h, w).

        conditions  (B, conditions, FOLD h, FOLD w);  code: (B, K);  inputs: (B, inputs, h, w), None if there are none.
        """
        x = self.fold(pixel_unshuffle(conditions, FOLD))
        if self.input is not None:
            x = x + self.input(inputs)
        levels, modulations = [], self._modulations(code)
        for level, blocks in enumerate(self.before):
            x = self.down[level - 1](x) if level else x
            for block in cast(nn.ModuleList, blocks):
                x = block(x, next(modulations), next(modulations))
            levels.append(x)
        for level in (1, 0):
            x = self.up[level](interpolate(x, scale_factor=2.0)) + levels[level]
            for block in cast(nn.ModuleList, self.after[level]):
                x = block(x, next(modulations), next(modulations))
        return self.last(silu(pixel_norm(x)))

    def _modulations(self, code: Tensor) -> Iterator[Tensor]:
        """Yield scale and shift (B, C, 1, 1) of each block, in the order of their use."""
        parts = (*self.before, *reversed(self.after))
        layers = [
            cast(ModulatedResidual, block).modulation for blocks in parts for block in cast(nn.ModuleList, blocks)
        ]
        widths = [layer.out_features // 2 for layer in layers for _ in range(2)]
        weight, bias = torch.cat([layer.weight for layer in layers]), torch.cat([layer.bias for layer in layers])
        yield from linear(code, weight, bias).unflatten(1, (-1, 1, 1)).split(widths, 1)


class MeanNetwork(nn.Module):
    """The mean of the latents, given the scene.

    looks  their number;  latents: channels;  widths, blocks, code: of a ConditionedUNet.
    """

    def __init__(self, looks: int, latents: int, widths: Sequence[int], blocks: Sequence[int], code: int) -> None:
        super().__init__()
        self.look_codes = nn.Parameter(torch.randn(looks, code) * CODE_DEVIATION)
        self.unet = ConditionedUNet(CONDITIONS, 0, latents, widths, blocks, code)

    def forward(self, conditions: Tensor, shares: Tensor) -> Tensor:
        """Return the mean (B, latents, h, w) of normalised latents.

        conditions  (B, CONDITIONS, FOLD h, FOLD w);  shares: (B, looks) of the looks, which sum to 1.
        Raises InputError unless the conditions' rows and columns are multiples of STRIDE.
        """
        check_size(conditions, STRIDE, "a scene")
        return self.unet(conditions, shares @ self.look_codes)


class FlowNetwork(nn.Module):
    """The velocity at which noise moves to latents; arguments as of MeanNetwork.

    Its U-Net learns what the mean leaves: the mean is taken out of what it reads, and added to its answer. Without
    that it first ignores the scene for thousands of steps (cf. Ohayon et al. 2025, posterior-mean rectified flow).
    """

    def __init__(self, looks: int, latents: int, widths: Sequence[int], blocks: Sequence[int], code: int) -> None:
        super().__init__()
        self.look_codes = nn.Parameter(torch.randn(looks, code) * CODE_DEVIATION)
        self.time = nn.Sequential(nn.Linear(4 * WAVES, code), nn.SiLU(), nn.Linear(code, code))
        self.style = nn.Linear(2 * latents + 1, code)
        self.unet = ConditionedUNet(CONDITIONS, 3 * latents + 1, latents, widths, blocks, code)

    def forward(  # noqa: PLR0913, PLR0917 the inputs of a network
        self,
        conditions: Tensor,
        shares: Tensor,
        mean: Tensor,
        noisy: Tensor,
        time: Tensor,
        moment: Tensor,
        photograph: Tensor,
        style: Tensor,
    ) -> Tensor:
        """Return the velocity (B, latents, h, w).

        conditions, shares  as of MeanNetwork;  mean: its output, (B, latents, h, w).
        noisy       (B, latents, h, w) = (1 - time) noise + time latents.
        time        (B,) in [0, 1];  moment: (B, 4 WAVES), `moment_of` time and step. Engines compute in half precision,
                    in which sines of large angles are lost.
        photograph  (B, latents + 1, h, w): latents of a photograph, then 1; in all other places the mean latents
                    of the place's classes in the photograph, then 0. All is 0 without one.
        style       (B, 2 latents + 1): `style_of` a photograph in all directions, 0 without one.
        """
        code = shares @ self.look_codes + self.time(moment) + self.style(style)
        mean = mean.to(noisy.dtype)
        remainder = noisy - time.view(-1, 1, 1, 1).to(noisy.dtype) * mean
        return mean + self.unet(conditions, code, torch.cat([remainder, mean, photograph.to(noisy.dtype)], 1))


class Clues(NamedTuple):
    """Latents that a camera gives, those of their classes elsewhere, and their style: inputs of FlowNetwork."""

    photograph: Tensor
    style: Tensor

    @classmethod
    def of(cls, latents: Tensor, mask: Tensor, shares: Tensor) -> Self:
        """Return normalised latents (B, L, h, w) where a mask (B, h, w) bool has them, elsewhere those of the classes.

        shares  (B, 16, h, w): class probabilities.
        """
        mask = mask[:, None].to(latents.dtype)
        palette = expected_latents(class_sums(latents, shares * mask))
        return cls(photograph_of(latents, mask, palette, shares), style_of(latents, mask))

    @classmethod
    def empty(cls, latents: Tensor) -> Self:
        """Return that none of the latents (B, L, h, w) is given."""
        return cls(
            torch.cat([0 * latents, 0 * latents[:, :1]], 1), latents.new_zeros(len(latents), 2 * latents.shape[1] + 1)
        )


def class_shares(conditions: Tensor) -> Tensor:
    """Return class probabilities (B, 16, h, w) on the raster of latents, of conditions (B, CONDITIONS, H, W)."""
    return avg_pool2d(conditions[:, CLASSES], FOLD)


def class_sums(latents: Tensor, shares: Tensor) -> Tensor:
    """Return the sums (B, 16, L + 1) of latents (B, L, h, w), then of 1, times the cells' shares (B, 16, h, w)."""
    ones = torch.ones_like(latents[:, :1])
    return torch.einsum("bchw,blhw->bcl", shares.to(latents.dtype), torch.cat([latents, ones], 1))


def expected_latents(sums: Tensor) -> Tensor:
    """Return the mean (B, 16, L) of normalised latents of each class by `class_sums` of them: (B, 16, L + 1).

    One cell more has the mean of all pictures, 0: a class that is hardly seen says little.
    """
    return sums[..., :-1] / (sums[..., -1:] + 1)


def photograph_of(latents: Tensor, mask: Tensor, palette: Tensor, shares: Tensor) -> Tensor:
    """Return the input `photograph` (B, L + 1, h, w) of a FlowNetwork.

    latents  (B, L, h, w) normalised, given where the mask (B, 1, h, w) is 1; elsewhere the mean of the pixel's classes.
    palette  (B, 16, L): the classes' means;  shares: (B, 16, h, w) their probabilities.
    """
    expected = torch.einsum("bchw,bcl->blhw", shares.to(palette.dtype), palette)
    return torch.cat([torch.where(mask > 0, latents, expected), mask], 1)


def style_of(latents: Tensor, mask: Tensor) -> Tensor:
    """Return the mean and the deviation of each of the latents (B, L, h, w) in a mask (B, 1, h, w), and 1: (B, 2L + 1).

    All are 0 if the mask has nothing.
    """
    count = mask.sum((2, 3))
    mean = (latents * mask).sum((2, 3)) / count.clamp(min=1)
    variance = ((latents - mean[..., None, None]).square() * mask).sum((2, 3)) / count.clamp(min=1)
    return torch.cat([mean, variance.sqrt(), (count > 0).to(mean.dtype)], 1)


class LatentDecoder(nn.Module):
    """The decoder of an Autoencoder, which learns nothing until its texture does, behind the scale of its latents.

    latents, decoder  as of Autoencoder.
    """

    def __init__(self, latents: int, decoder: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("scale", torch.stack([torch.zeros(latents), torch.ones(latents)]))
        self.decoder = Autoencoder(latents, (8, 8, 8), decoder).decoder.requires_grad_(False)

    def forward(self, latents: Tensor) -> Tensor:
        """Return the picture (B, 3, FACTOR h, FACTOR w), about in [-1, 1], of normalised latents (B, latents, h, w)."""
        mean, deviation = cast(Tensor, self.scale)[..., None, None]
        return Autoencoder.decoded(self.decoder, latents * deviation + mean)

    def normalised(self, latents: Tensor) -> Tensor:
        """Return an encoder's latents (B, latents, h, w) with the mean and the deviation of `scale` taken out."""
        mean, deviation = cast(Tensor, self.scale)[..., None, None]
        return (latents - mean) / deviation


class LatentPainter(nn.Module):
    """Mean network, flow network, and the decoder of an Autoencoder; a StreamPainter.

    looks             their names, the default first.
    steps             of a picture, of LEARNED_STEPS.
    latents, autoencoder  as of Autoencoder: latents; encoder and decoder.
    mean, flow        widths and blocks of their ConditionedUNets.
    code              length of the code of look, time and length of the step, which modulates them.
    palette           whether the flow has learned to be given the classes' latents where a photograph has none.
    """

    def __init__(  # noqa: PLR0913, PLR0917 settings of a network
        self,
        looks: Sequence[str] = ("photograph",),
        steps: int = 2,
        latents: int = 32,
        autoencoder: Sequence[Sequence[int]] = ((32, 64, 128), (16, 32, 64, 128)),
        mean: Sequence[Sequence[int]] = ((48, 96, 144), (1, 1, 2)),
        flow: Sequence[Sequence[int]] = ((64, 112, 160), (1, 2, 4)),
        code: int = 128,
        palette: bool = False,
    ) -> None:
        super().__init__()
        if steps not in LEARNED_STEPS:
            raise InputError(f"a picture takes 1, 2 or 4 steps, not {steps}")
        self.looks, self.look = tuple(looks), looks[0]
        self.latents, self.steps, self.guidance, self.seed = latents, steps, GUIDANCE, 0
        self.palette = palette
        self.mean = MeanNetwork(len(self.looks), latents, mean[0], mean[1], code)
        self.flow = FlowNetwork(len(self.looks), latents, flow[0], flow[1], code)
        self.encoder = Autoencoder(latents, *autoencoder).encoder.requires_grad_(False)
        self.decoder = LatentDecoder(latents, autoencoder[1])

    def variant(self, quality: str, seed: int) -> Self:
        """Return the painter, with the same networks, of a quality of QUALITIES and of another plausible picture.

        Raises InputError as `check_variant`.
        """
        check_variant(quality, seed)
        painter = copy.copy(self)
        painter.steps, painter.seed = QUALITIES[quality] or self.steps, seed
        return painter

    def look_shares(self, look: str) -> list[float]:
        """Return the share of each look in a name, "A" or "A+B" (their mean); InputError for an unknown name."""
        names = [name.strip() for name in (look or self.look).split("+")]
        for name in names:
            if name not in self.looks:
                choices = ", ".join(self.looks)
                raise InputError(f"the painter knows no look {name!r}; it knows {choices}")
        return [names.count(look) / len(names) for look in self.looks]

    def parts(self) -> dict[str, nn.Module]:
        """Return the networks that paint, by name."""
        return {"latent-mean": self.mean, "latent-flow": self.flow, "latent-decoder": self.decoder}

    def forward(  # noqa: PLR0913, PLR0917 the parts of a training step
        self,
        conditions: Tensor,
        shares: Tensor,
        noisy: Tensor,
        time: Tensor,
        step: Tensor,
        kept: Tensor,
        photograph: Tensor,
        style: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the mean and the velocity, (B, latents, h, w) each, of normalised latents.

        conditions, shares, noisy, time, photograph, style  as of FlowNetwork.
        step        (B,) in [0, 1]: of 0 it asks for the instant velocity, else for the mean velocity over it.
        kept        (B,) 1, or 0: the flow is given neither conditions nor mean. No gradient passes from it to the mean.
        """
        mean = self.mean(conditions, shares)
        kept, moment = kept[:, None, None, None], moment_of(time, step)
        return mean, self.flow(conditions * kept, shares, mean.detach() * kept, noisy, time, moment, photograph, style)

    def encode(self, picture: Tensor) -> Tensor:
        """Return the normalised latents (B, latents, H/8, W/8) of pictures (B, 3, H, W) in [-1, 1]."""
        return self.decoder.normalised(self.encoder(picture).float())

    def latents_of(self, conditions: Tensor, shares: Tensor, noise: Tensor, clues: Clues | None = None) -> Tensor:
        """Return normalised latents (B, latents, h, w) float32 from noise of that shape; arguments of MeanNetwork."""
        mean, x = self.mean(conditions, shares).float(), noise
        clues = clues or Clues.empty(noise)
        step = x.new_full((len(x),), 1 / self.steps)
        for number in range(self.steps):
            time = step * number
            velocity = self.flow(conditions, shares, mean, x, time, moment_of(time, step), *clues)
            x = x + velocity.float() / self.steps
        return x

    def paint(self, past: Particles | None, scene: Scene, look: str = "") -> tuple[Particles | None, Tensor]:
        """Paint a scan; arguments and answer as of StreamPainter. The noise hangs on the world."""
        conditions = conditions_of(scene).contiguous(memory_format=torch.channels_last)
        shares = torch.tensor([self.look_shares(look)], device=conditions.device)
        particles, noise = world_noise(past, scene, self.latents, FOLD, self.seed)
        clues = self.clues(*scene.photographed, class_shares(conditions)) if scene.photographed else None
        return particles, self.decoder(self.latents_of(conditions, shares, noise, clues)).clamp(-1, 1)

    def clues(self, picture: Tensor, shown: Tensor, shares: Tensor) -> Clues:
        """Return the latents of a picture (1, 3, FACTOR h, FACTOR w) for its pixels in view, (1, FACTOR h, FACTOR w).

        Those of cells at its edge are left out: the encoder read beyond it.
        shares  (1, 16, h, w): class probabilities.
        """
        whole = shown.view(torch.uint8).unflatten(1, (-1, FACTOR)).amin(2).unflatten(2, (-1, FACTOR)).amin(3)
        mask = max_pool2d(pad_azimuth(1.0 - whole[:, None], 1), 3, 1, (1, 0))[:, 0] == 0
        latents = encode_columns(self.encoder, picture * shown[:, None], mask.flatten(0, 1).any(0))
        return Clues.of(self.decoder.normalised(latents.float()), mask, shares if self.palette else 0 * shares)


def moment_of(time: Tensor, step: Tensor) -> Tensor:
    """Return the embedding (B, 4 WAVES) of times and lengths of steps (B,)."""
    frequency = torch.linspace(0, math.log(FASTEST), WAVES, device=time.device).exp()
    angle = torch.stack([time, step], 1).float()[..., None] * frequency
    return torch.cat([angle.sin(), angle.cos()], 2).flatten(1)
