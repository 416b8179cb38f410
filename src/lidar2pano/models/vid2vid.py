"""vid2vid: a picture from label maps and the two pictures before it, coarse to fine.

Paper     Wang, Liu, Zhu, Liu, Tao, Kautz, Catanzaro: Video-to-Video Synthesis, 2018 (arXiv:1808.06601), section 3:
          x_t = (1 - m) W(x_{t-1}) + m h, equation 3, with flow, mask and a hallucinated picture from one generator, and
          section 3.2 (foreground and background painted apart); appendix A (scales).
Upstream  https://github.com/NVIDIA/vid2vid, commit 2e6d137 (code and weights CC BY-NC-SA 4.0). Written anew here;
          parameter names are the published ones, those of netG<n> behind "<n>.".
Deviates  from the published code in three points:
          all scales are one network (the published one is a list that its training program walks through);
          warping is as the code meant it and as torch ran it in 2018 (align_corners); the setting gives today's;
          pictures may close in azimuth (vid2vid_parts).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.geometry.warp import warp
from lidar2pano.models.vid2vid_parts import (
    Closable,
    Norm,
    batch_norms,
    check_size,
    doublings,
    entry,
    halved,
    halvings,
    head,
    residuals,
    start_as_published,
)

FLOW_PX = 20.0  # pixels of the coarsest scale that the flow head's one stands for


class Painted(NamedTuple):
    """What the generator says of a frame, on the raster of its scale.

    picture  (B, 3, H, W) in [-1, 1]: where `weight` is one, what is painted anew; else what was there before, warped.
    flow     (B, 2, H, W) pixels, backward: where in the previous picture a pixel was (u to the right, v down).
    weight   (B, 1, H, W) in [0, 1].
    raw      (B, 3, H, W) in [-1, 1]: the picture painted anew everywhere.
    """

    picture: Tensor
    flow: Tensor
    weight: Tensor
    raw: Tensor


class Features(NamedTuple):
    """What a scale hands to the next finer one, each (B, width, H, W); no foreground where there is no such branch."""

    picture: Tensor
    flow: Tensor
    foreground: Tensor | None


class Vid2Vid(Closable, nn.Module):
    """The generator; defaults are the published street network for pictures 2048 pixels wide.

    channels          of one label map: 35 ids of Cityscapes one-hot and the edges of instances.
    widths            of each spatial scale's first layer, coarse to fine (published as ngf), each half of the one
                      before: the published ones are (128,), (128, 64) and (128, 64, 32).
    downsamplings     halvings inside the coarsest scale (finer ones halve once).
    blocks            residual blocks of the coarsest scale and of each finer one.
    foreground        label channels that a branch of its own paints (26 is Cityscapes' car); empty: no such branch.
    frames            label maps it sees, the present one last; it sees one picture less.
    batch_statistics  norms use the batch's statistics in evaluation mode, too: what published weights need.
    align_corners     how the previous picture is warped (see geometry.warp): True is what the code was written for.
    """

    def __init__(
        self,
        channels: int = 36,
        widths: Sequence[int] = (128, 64, 32),
        downsamplings: int = 3,
        blocks: Sequence[int] = (9, 3),
        foreground: Sequence[int] = (26,),
        frames: int = 3,
        batch_statistics: bool = False,
        align_corners: bool = True,
    ) -> None:
        super().__init__()
        if any(2 * fine != coarse for coarse, fine in zip(widths, widths[1:], strict=False)):
            raise InputError(f"widths {list(widths)}: each must be half of the one before it")
        if not all(0 <= channel < channels for channel in foreground):
            raise InputError(f"foreground {list(foreground)}: label channels are 0 to {channels - 1}")
        self.channels, self.frames, self.align_corners = channels, frames, align_corners
        self.foreground = [(frames - 1) * channels + channel for channel in foreground]  # in the present label map
        inputs, norm = (frames * channels, 3 * (frames - 1)), batch_norms(batch_statistics)
        apart = bool(self.foreground)
        thinner = 2 if downsamplings > 2 else 1  # the foreground's branch is published at half the width, if so deep
        self.add_module("0", Coarsest(inputs, widths[0], downsamplings, blocks[0], widths[0] // thinner * apart, norm))
        for scale, width in enumerate(widths[1:], 1):
            finer = Finer(inputs, width, blocks[1], width // thinner * apart, FLOW_PX * 2**scale, norm)
            self.add_module(str(scale), finer)
        self.stride = 2 ** (downsamplings + len(widths) - 1)
        start_as_published(self)

    def forward(self, labels: Tensor, previous: Tensor) -> Painted:
        """Paint a frame.

        labels    (B, frames, channels, H, W) float: one-hot label maps, the present one last.
        previous  (B, frames - 1, 3, H, W) in [-1, 1]: pictures before it, the latest last.
        H and W must be multiples of `stride` and at least twice that, otherwise InputError.
        The answer is the finest scale's, so the heads of coarser ones get no gradient (as published, where a coarse
        scale is trained as the finest first).
        """
        return self.scales(self.pyramid(labels), self.pyramid(previous))[-1]

    def scales(self, labels: Sequence[Tensor], previous: Sequence[Tensor]) -> list[Painted]:
        """What every scale paints, coarse to fine, from label maps and previous pictures on the raster of each.

        A stream gives each scale its own earlier pictures, as published; `forward` those of the finest, made smaller.
        """
        painted, features = [], None
        for scale, maps, pictures in zip(self._scales(), labels, previous, strict=True):
            seen = maps.flatten(1, 2)
            features = scale(seen, pictures.flatten(1, 2), features)
            painted.append(self._composed(scale, features, pictures[:, -1], seen))
        return painted

    def pyramid(self, pictures: Tensor) -> list[Tensor]:
        """Pictures (B, T, C, H, W) on the rasters of all scales, coarse to fine; InputError where they do not fit."""
        check_size(pictures.shape[-2], pictures.shape[-1], self.stride)
        levels = [pictures]
        for _ in self._scales()[1:]:
            coarser = halved(levels[0].flatten(0, 1), self.closed)
            levels.insert(0, coarser.unflatten(0, pictures.shape[:2]))
        return levels

    def _scales(self) -> list[Coarsest | Finer]:
        """Coarse to fine."""
        return list(self.children())  # pyright: ignore[reportReturnType]

    def _composed(self, scale: Heads, features: Features, latest: Tensor, seen: Tensor) -> Painted:
        """Equations 3 and 4 of the paper, in float32 whatever the layers before ran in: flow is in pixels."""
        with torch.autocast(seen.device.type, enabled=False):
            raw, flow, weight, apart = scale.heads(features)
            moved = warp(latest.float(), flow, closed=self.closed, align_corners=self.align_corners)
            picture = raw * weight + moved * (1 - weight)
            if apart is not None:
                mask = seen[:, self.foreground].float().sum(1, keepdim=True).clamp(0, 1)
                picture, raw = apart * mask + picture * (1 - mask), apart * mask + raw * (1 - mask)
        return Painted(picture=picture, flow=flow, weight=weight, raw=raw)


class Heads(nn.Module):
    """What all scales have: the heads of picture, flow and mask, and the foreground's.

    width, foreground  channels of the features that the heads read; foreground 0: there is no such branch.
    flow_px            pixels that the flow head's one stands for.
    """

    def __init__(self, width: int, foreground: int, flow_px: float) -> None:
        super().__init__()
        self.flow_px = flow_px
        self.model_final_img = head(width, 3, nn.Tanh())
        self.model_final_flow = head(width, 2)
        self.model_final_w = head(width, 1, nn.Sigmoid())
        if foreground:
            self.indv_final = head(foreground, 3, nn.Tanh())

    def heads(self, features: Features) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Picture (B, 3, H, W), flow (B, 2, H, W) in pixels, weight (B, 1, H, W), the foreground's picture or None."""
        picture, flow = features.picture.float(), features.flow.float()
        apart = None if features.foreground is None else self.indv_final(features.foreground.float())
        flow_px = self.model_final_flow(flow) * self.flow_px
        return self.model_final_img(picture), flow_px, self.model_final_w(flow), apart


class Coarsest(Heads):
    """Scale 0: an encoder-decoder.

    inputs      channels of all label maps and of all previous pictures.
    width       after the first layer; foreground: likewise in that branch, 0 for none.
    """

    def __init__(
        self, inputs: tuple[int, int], width: int, downsamplings: int, blocks: int, foreground: int, norm: Norm
    ) -> None:
        super().__init__(width, foreground, FLOW_PX)
        down = [width << depth for depth in range(downsamplings + 1)]
        late = blocks // 2  # blocks after the join; the rest is before it, in both branches

        def encoder(channels: int) -> nn.Sequential:
            before = residuals(blocks - late, down[-1], norm)
            return nn.Sequential(*entry(channels, width, norm), *halvings(down, norm), *before)

        self.model_down_seg, self.model_down_img = encoder(inputs[0]), encoder(inputs[1])
        self.model_res_img = nn.Sequential(*residuals(late, down[-1], norm))
        self.model_up_img = nn.Sequential(*doublings(down[::-1], norm))
        self.model_res_flow = nn.Sequential(*residuals(late, down[-1], norm))
        self.model_up_flow = nn.Sequential(*doublings(down[::-1], norm))
        self.apart = bool(foreground)
        if self.apart:
            thin = [foreground << depth for depth in range(downsamplings + 1)]
            self.indv_down = nn.Sequential(*entry(inputs[0], foreground, norm), *halvings(thin, norm))
            self.indv_res = nn.Sequential(*residuals(blocks, thin[-1], norm))
            self.indv_up = nn.Sequential(*doublings(thin[::-1], norm))

    def forward(self, labels: Tensor, pictures: Tensor, coarser: None) -> Features:  # there is none coarser
        """(B, labels, H, W) and (B, pictures, H, W) -> features (B, width, H, W)."""
        joined = self.model_down_seg(labels) + self.model_down_img(pictures)
        return Features(
            picture=self.model_up_img(self.model_res_img(joined)),
            flow=self.model_up_flow(self.model_res_flow(joined)),
            foreground=self.indv_up(self.indv_res(self.indv_down(labels))) if self.apart else None,
        )


class Finer(Heads):
    """A scale that refines the features of the coarser one at twice its raster; arguments as of the other classes."""

    def __init__(
        self, inputs: tuple[int, int], width: int, blocks: int, foreground: int, flow_px: float, norm: Norm
    ) -> None:
        super().__init__(width, foreground, flow_px)

        def down(channels: int, width: int) -> nn.Sequential:
            return nn.Sequential(*entry(channels, width, norm), *halvings([width, 2 * width], norm))

        def up(width: int) -> nn.Sequential:
            return nn.Sequential(*residuals(blocks, 2 * width, norm), *doublings([2 * width, width], norm))

        self.model_down_seg, self.model_down_img = down(inputs[0], width), down(inputs[1], width)
        self.model_up_img, self.model_up_flow = up(width), up(width)
        if foreground:
            self.indv_down, self.indv_up = down(inputs[0], foreground), up(foreground)

    def forward(self, labels: Tensor, pictures: Tensor, coarser: Features) -> Features:
        """(B, labels, H, W), (B, pictures, H, W) and features on half the raster -> features (B, width, H, W)."""
        down = self.model_down_seg(labels) + self.model_down_img(pictures)
        foreground = coarser.foreground
        return Features(
            picture=self.model_up_img(down + coarser.picture),
            flow=self.model_up_flow(down + coarser.flow),
            foreground=None if foreground is None else self.indv_up(self.indv_down(labels) + foreground),
        )
