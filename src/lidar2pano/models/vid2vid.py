"""vid2vid: an image from label maps and the two images before it, coarse to fine; and its first frames.

Papers    Wang, Liu, Zhu, Liu, Tao, Kautz, Catanzaro: Video-to-Video Synthesis, 2018 (arXiv:1808.06601), section 3:
          x_t = (1 - m) W(x_{t-1}) + m h, equation 3, with flow, mask and a hallucinated image from one generator;
          section 3.2 (foreground and background painted apart); appendix A (scales). Its layers are in
          models.vid2vid_layers. Its discriminators: D_I scores an image with its labels, D_V several
          successive ones with the flow.
          Wang, Liu, Zhu, Tao, Kautz, Catanzaro: High-Resolution Image Synthesis and Semantic Manipulation with
          Conditional GANs, 2018 (arXiv:1711.11585), section 3.1: the global generator and the local enhancers,
          for vid2vid's first frames.
Upstream  https://github.com/NVIDIA/vid2vid, commit 2e6d137 (code and weights CC BY-NC-SA 4.0): models/networks.py.
          Reimplemented here; places in a `Sequential`, and with them the parameters' names, are the published ones,
          those of netG<n> behind "<n>.".
Deviates  from the published code in four points:
          all scales are one network (the published one is a list for its training program);
          warping is as the code meant it and as torch ran it in 2018 (align_corners); the setting gives today's;
          every layer with a look past the image's left or right edge can look at the other end instead (`close`), as
          the whole panorama wants it; rows are padded as published;
          norms can use the statistics of their input in evaluation mode, too: the published test program never leaves
          training mode, so its weights have always run with those.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import warp
from lidar2pano.models.blocks import check_size
from lidar2pano.models.vid2vid_layers import (
    Closable,
    Doubling,
    Halving,
    Norm,
    batch_norms,
    entry,
    halved,
    head,
    instance_norms,
    residuals,
    resizings,
    start_as_published,
)

FLOW_PX = 20.0  # pixels of the coarsest scale per unit of the flow head
SINGLE_WIDEST = 1024  # largest number of channels of the first-frame network


class Painted(NamedTuple):
    """Output of the generator for a frame, on the raster of its scale.

    image    (B, 3, H, W) in [-1, 1]: by `weight` the new image, otherwise the previous one, warped.
    flow     (B, 2, H, W) pixels, backward: place of a pixel in the previous image (u to the right, v down).
    weight   (B, 1, H, W) in [0, 1].
    raw      (B, 3, H, W) in [-1, 1]: the new image everywhere.
    """

    image: Tensor
    flow: Tensor
    weight: Tensor
    raw: Tensor


class Features(NamedTuple):
    """Features for the next finer scale, each (B, width, H, W); no foreground without such a branch."""

    image: Tensor
    flow: Tensor
    foreground: Tensor | None


class Vid2Vid(Closable, nn.Module):
    """The generator; defaults are the published street network for images 2048 pixels wide.

    channels          of one label map: 35 ids of Cityscapes one-hot and the edges of instances.
    widths            of each spatial scale's first layer, coarse to fine (published as ngf), each half of the one
                      before: the published ones are (128,), (128, 64) and (128, 64, 32).
    downsamplings     halvings inside the coarsest scale (finer ones halve once).
    blocks            residual blocks of the coarsest scale and of each finer one.
    foreground        label channels for a branch of their own (26 is Cityscapes' car); empty: no such branch.
    frames            label maps it sees, the present one last; it sees one image less.
    batch_statistics  norms use the batch's statistics in evaluation mode, too, as needed by published weights.
    align_corners     how the previous image is warped (see geometry.rasters.warp): True is the code's original way.
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
        previous  (B, frames - 1, 3, H, W) in [-1, 1]: images before it, the latest last.
        H and W must be multiples of `stride` and at least twice as large, otherwise InputError.
        The answer is the finest scale's, so the heads of coarser ones get no gradient (as published: a coarse
        scale is trained as the finest first).
        """
        return self.scales(self.pyramid(labels), self.pyramid(previous))[-1]

    def scales(self, labels: Sequence[Tensor], previous: Sequence[Tensor]) -> list[Painted]:
        """Paint every scale, coarse to fine, from label maps and previous images on the raster of each.

        A stream gives each scale its own earlier images, as published; `forward` those of the finest, made smaller.
        """
        painted, features = [], None
        for scale, maps, images in zip(self._scales(), labels, previous, strict=True):
            label_maps = maps.flatten(1, 2)
            features = scale(label_maps, images.flatten(1, 2), features)
            painted.append(self._composed(scale, features, images[:, -1], label_maps))
        return painted

    def pyramid(self, images: Tensor) -> list[Tensor]:
        """Images (B, T, C, H, W) on the rasters of all scales, coarse to fine; InputError unless they fit."""
        check_size(images, self.stride, "an image", least=2)
        levels = [images]
        for _ in self._scales()[1:]:
            coarser = halved(levels[0].flatten(0, 1), self.closed)
            levels.insert(0, coarser.unflatten(0, images.shape[:2]))
        return levels

    def _scales(self) -> list[Coarsest | Finer]:
        """Coarse to fine."""
        return list(self.children())  # pyright: ignore[reportReturnType]

    def _composed(self, scale: Heads, features: Features, latest: Tensor, label_maps: Tensor) -> Painted:
        """Equations 3 and 4 of the paper, in float32 whatever the layers before ran in: flow is in pixels."""
        with torch.autocast(label_maps.device.type, enabled=False):
            raw, flow, weight, apart = scale.heads(features)
            moved = warp(latest.float(), flow, circular=self.closed, align_corners=self.align_corners)
            image = raw * weight + moved * (1 - weight)
            if apart is not None:
                mask = label_maps[:, self.foreground].float().sum(1, keepdim=True).clamp(0, 1)
                image, raw = apart * mask + image * (1 - mask), apart * mask + raw * (1 - mask)
        return Painted(image=image, flow=flow, weight=weight, raw=raw)


class Heads(nn.Module):
    """Shared heads of all scales: image, flow, mask and foreground.

    width, foreground  channels of the heads' input; foreground 0: no such branch.
    flow_px            pixels per unit of the flow head.
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
        """Image (B, 3, H, W), flow (B, 2, H, W) in pixels, weight (B, 1, H, W), the foreground's image or None."""
        image, flow = features.image.float(), features.flow.float()
        apart = None if features.foreground is None else self.indv_final(features.foreground.float())
        flow_px = self.model_final_flow(flow) * self.flow_px
        return self.model_final_img(image), flow_px, self.model_final_w(flow), apart


class Coarsest(Heads):
    """Scale 0: an encoder-decoder.

    inputs      channels of all label maps and of all previous images.
    width       after the first layer; foreground: likewise in its branch, 0 for none.
    """

    def __init__(
        self, inputs: tuple[int, int], width: int, downsamplings: int, blocks: int, foreground: int, norm: Norm
    ) -> None:
        super().__init__(width, foreground, FLOW_PX)
        down = [width << depth for depth in range(downsamplings + 1)]
        late = blocks // 2  # blocks after the join; the rest is before it, in both branches

        def encoder(channels: int) -> nn.Sequential:
            early = residuals(blocks - late, down[-1], norm)
            return nn.Sequential(*entry(channels, width, norm), *resizings(Halving, down, norm), *early)

        self.model_down_seg, self.model_down_img = encoder(inputs[0]), encoder(inputs[1])
        self.model_res_img = nn.Sequential(*residuals(late, down[-1], norm))
        self.model_up_img = nn.Sequential(*resizings(Doubling, down[::-1], norm))
        self.model_res_flow = nn.Sequential(*residuals(late, down[-1], norm))
        self.model_up_flow = nn.Sequential(*resizings(Doubling, down[::-1], norm))
        self.apart = bool(foreground)
        if self.apart:
            thin = [foreground << depth for depth in range(downsamplings + 1)]
            self.indv_down = nn.Sequential(*entry(inputs[0], foreground, norm), *resizings(Halving, thin, norm))
            self.indv_res = nn.Sequential(*residuals(blocks, thin[-1], norm))
            self.indv_up = nn.Sequential(*resizings(Doubling, thin[::-1], norm))

    def forward(self, labels: Tensor, images: Tensor, coarser: None) -> Features:  # there is none coarser
        """(B, labels, H, W) and (B, images, H, W) -> features (B, width, H, W)."""
        joined = self.model_down_seg(labels) + self.model_down_img(images)
        return Features(
            image=self.model_up_img(self.model_res_img(joined)),
            flow=self.model_up_flow(self.model_res_flow(joined)),
            foreground=self.indv_up(self.indv_res(self.indv_down(labels))) if self.apart else None,
        )


class Finer(Heads):
    """A scale for refining the features of the coarser one at twice its raster; arguments as of the other classes."""

    def __init__(
        self, inputs: tuple[int, int], width: int, blocks: int, foreground: int, flow_px: float, norm: Norm
    ) -> None:
        super().__init__(width, foreground, flow_px)

        def down(channels: int, width: int) -> nn.Sequential:
            return nn.Sequential(*entry(channels, width, norm), *resizings(Halving, [width, 2 * width], norm))

        def up(width: int) -> nn.Sequential:
            return nn.Sequential(*residuals(blocks, 2 * width, norm), *resizings(Doubling, [2 * width, width], norm))

        self.model_down_seg, self.model_down_img = down(inputs[0], width), down(inputs[1], width)
        self.model_up_img, self.model_up_flow = up(width), up(width)
        if foreground:
            self.indv_down, self.indv_up = down(inputs[0], foreground), up(foreground)

    def forward(self, labels: Tensor, images: Tensor, coarser: Features) -> Features:
        """(B, labels, H, W), (B, images, H, W) and features on half the raster -> features (B, width, H, W)."""
        down = self.model_down_seg(labels) + self.model_down_img(images)
        foreground = coarser.foreground
        return Features(
            image=self.model_up_img(down + coarser.image),
            flow=self.model_up_flow(down + coarser.flow),
            foreground=None if foreground is None else self.indv_up(self.indv_down(labels) + foreground),
        )


class Vid2VidSingle(Closable, nn.Module):
    """Defaults are the published network for images 512 pixels wide (2048: width 32, downsamplings 4, enhancers 1).

    classes           of the label map, one-hot (no edges of instances).
    width             of the finest scale's first layer (published as ngf).
    downsamplings     halvings inside the coarsest scale.
    blocks            residual blocks of the coarsest scale; local_blocks: of each enhancer.
    enhancers         finer scales, each on twice the raster.
    batch_statistics  norms use the statistics of the image itself in evaluation mode, too, as needed by
                      published weights. (They are instance norms; the setting is named as in `vid2vid`.)
    """

    def __init__(
        self,
        classes: int = 35,
        width: int = 64,
        downsamplings: int = 3,
        blocks: int = 9,
        enhancers: int = 0,
        local_blocks: int = 3,
        batch_statistics: bool = False,
    ) -> None:
        super().__init__()
        norm = instance_norms(batch_statistics)
        down = [min(SINGLE_WIDEST, width << depth) for depth in range(enhancers, enhancers + downsamplings + 1)]
        layers = [*entry(classes, down[0], norm), *resizings(Halving, down, norm), *residuals(blocks, down[-1], norm)]
        layers += resizings(Doubling, down[::-1], norm)
        self.model = nn.Sequential(*layers, *([] if enhancers else head(width, 3, nn.Tanh())))
        for number in range(1, enhancers + 1):
            own = width << (enhancers - number)
            self.add_module(
                f"model{number}_1", nn.Sequential(*entry(classes, own, norm), *resizings(Halving, [own, 2 * own], norm))
            )
            layers = [*residuals(local_blocks, 2 * own, norm), *resizings(Doubling, [2 * own, own], norm)]
            layers += head(width, 3, nn.Tanh()) if number == enhancers else []
            self.add_module(f"model{number}_2", nn.Sequential(*layers))
        self.classes, self.enhancers, self.stride = classes, enhancers, 2 ** (downsamplings + enhancers)
        start_as_published(self)

    def forward(self, labels: Tensor) -> Tensor:
        """(B, classes, H, W) float, one-hot -> (B, 3, H, W) in [-1, 1].

        H and W must be multiples of `stride` and at least twice as large, otherwise InputError.
        """
        check_size(labels, self.stride, "an image", least=2)
        levels = [labels]
        for _ in range(self.enhancers):
            levels.append(halved(levels[-1], self.closed))
        x = self.model(levels[-1])
        for number in range(1, self.enhancers + 1):
            down, up = self.get_submodule(f"model{number}_1"), self.get_submodule(f"model{number}_2")
            x = up(down(levels[self.enhancers - number]) + x)
        return x


WIDEST, FIRST = 512, 64  # largest numbers of channels: of any layer, of the first one of any scale


class ImageCritic(nn.Module):
    """Scores of patches, and features for feature matching.

    channels  of its input: label maps (published: 35 ids and the edges of instances) and an image.
    width     of the first layer on the whole image; twice as wide on the halved one and so on, up to 64, as published.
    layers    layers of stride 2.
    scales    images of the pyramid, each half the size of the one before.
    """

    def __init__(self, channels: int = 39, width: int = 64, layers: int = 3, scales: int = 2) -> None:
        super().__init__()
        self.levels = [
            [f"scale{scale}_layer{place}" for place in range(layers + 2)] for scale in reversed(range(scales))
        ]
        for level, names in enumerate(self.levels):
            patches = _patches(channels, min(FIRST, width << level), layers)
            for name, layer in zip(names, patches, strict=True):
                self.add_module(name, layer)
        start_as_published(self)

    def forward(self, image: Tensor) -> list[list[Tensor]]:
        """(B, channels, H, W) -> per scale, the features of every layer, the last being the scores (B, 1, h, w)."""
        answers = []
        for level, names in enumerate(self.levels):
            image = halved(image) if level else image
            features, x = [], image
            for name in names:
                x = self.get_submodule(name)(x)
                features.append(x)
            answers.append(features)
        return answers


class TemporalCritic(ImageCritic):
    """The same for clips; channels: of the images, three each, and of the flows between them, two each."""

    def __init__(self, channels: int = 13, width: int = 64, layers: int = 3, scales: int = 2) -> None:
        super().__init__(channels, width, layers, scales)


def _patches(channels: int, width: int, layers: int) -> list[nn.Sequential]:
    widths = [min(WIDEST, width << depth) for depth in range(layers + 1)]
    blocks = [nn.Sequential(_conv(channels, width, 2), nn.LeakyReLU(0.2, inplace=True))]
    for depth, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False), 1):
        conv = _conv(inputs, outputs, 2 if depth < layers else 1)
        blocks.append(nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.LeakyReLU(0.2, inplace=True)))
    return [*blocks, nn.Sequential(_conv(widths[-1], 1, 1))]


def _conv(inputs: int, outputs: int, stride: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 4, stride=stride, padding=2)
