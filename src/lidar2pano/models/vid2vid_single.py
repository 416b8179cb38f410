"""vid2vid's first-frame network: a picture from one label map.

Paper     Wang, Liu, Zhu, Tao, Kautz, Catanzaro: High-Resolution Image Synthesis and Semantic Manipulation with
          Conditional GANs, 2018 (arXiv:1711.11585), section 3.1: a global generator and local enhancers.
Upstream  https://github.com/NVIDIA/vid2vid, commit 2e6d137, GlobalGenerator and LocalEnhancer (code and weights
          CC BY-NC-SA 4.0). Written anew here; parameter names are the published ones.
Deviates  as vid2vid_parts says.
"""

from __future__ import annotations

from torch import Tensor, nn

from lidar2pano.models.vid2vid_parts import (
    Closable,
    check_size,
    doublings,
    entry,
    halved,
    halvings,
    head,
    instance_norms,
    residuals,
    start_as_published,
)

WIDEST = 1024  # channels that no layer exceeds


class Vid2VidSingle(Closable, nn.Module):
    """Defaults are the published network for pictures 512 pixels wide (2048: width 32, downsamplings 4, enhancers 1).

    classes           of the label map, one-hot (no edges of instances).
    width             of the finest scale's first layer (published as ngf).
    downsamplings     halvings inside the coarsest scale.
    blocks            residual blocks of the coarsest scale; local_blocks: of each enhancer.
    enhancers         finer scales, each on twice the raster.
    batch_statistics  norms use the statistics of the picture itself in evaluation mode, too: what published weights
                      need. (They are instance norms; the setting has the name that it has in `vid2vid`.)
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
        down = [min(WIDEST, width << depth) for depth in range(enhancers, enhancers + downsamplings + 1)]
        layers = [*entry(classes, down[0], norm), *halvings(down, norm), *residuals(blocks, down[-1], norm)]
        layers += doublings(down[::-1], norm)
        self.model = nn.Sequential(*layers, *([] if enhancers else head(width, 3, nn.Tanh())))
        for number in range(1, enhancers + 1):
            own = width << (enhancers - number)
            self.add_module(
                f"model{number}_1", nn.Sequential(*entry(classes, own, norm), *halvings([own, 2 * own], norm))
            )
            layers = [*residuals(local_blocks, 2 * own, norm), *doublings([2 * own, own], norm)]
            layers += head(width, 3, nn.Tanh()) if number == enhancers else []
            self.add_module(f"model{number}_2", nn.Sequential(*layers))
        self.classes, self.enhancers, self.stride = classes, enhancers, 2 ** (downsamplings + enhancers)
        start_as_published(self)

    def forward(self, labels: Tensor) -> Tensor:
        """(B, classes, H, W) float, one-hot -> (B, 3, H, W) in [-1, 1].

        H and W must be multiples of `stride` and at least twice that, otherwise InputError.
        """
        check_size(labels.shape[-2], labels.shape[-1], self.stride)
        levels = [labels]
        for _ in range(self.enhancers):
            levels.append(halved(levels[-1], self.closed))
        x = self.model(levels[-1])
        for number in range(1, self.enhancers + 1):
            down, up = self.get_submodule(f"model{number}_1"), self.get_submodule(f"model{number}_2")
            x = up(down(levels[self.enhancers - number]) + x)
        return x
