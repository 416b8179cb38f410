"""Task: TITAN-Next, TITAN-Net's setting with depth: front range view in, the camera's segments and depths out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import nll_loss

from lidar2pano.data.front_view import FrontViewSample, SampleParts
from lidar2pano.geometry.images import one_hot_layers
from lidar2pano.labels import COMMON14
from lidar2pano.losses import lovasz_softmax
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.models.titan_pano import depth_code
from lidar2pano.train.adversarial import wasserstein_updates
from lidar2pano.train.front import FrontTranslation, called, conditions

TINY = 1e-8  # least probability whose logarithm is taken


class FrontDepthTranslation(FrontTranslation):
    """Trains TITAN-Next: WGAN-GP over classes and depth together, guided on both.

    The true depth is the LiDAR's own, projected into the camera, so it is known at some pixels only: guide and critic
    see depths there alone. Options: penalty, segmenter as in FrontTranslation; lovasz, entropy, depth: weights of the
    guides (Lovasz-Softmax and cross-entropy without class 0; absolute distance of depth codes where measured).
    """

    wanted: ClassVar[SampleParts] = SampleParts(labels=True, depth=True)

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition, classes = conditions(batch.segments), len(COMMON14)
        measured = (batch.depth_m > 0)[:, None].float()
        depth = depth_code(batch.depth_m)[:, None]  # zero where none was measured
        weights = {name: float(self.option[name]) for name in ("lovasz", "entropy", "depth")}

        def forward() -> Tensor:
            logits, depth_m = self.networks["translator"](batch.lidar, condition)
            return torch.cat([logits.float().softmax(1), depth_code(depth_m)[:, None] * measured], 1)

        def guide(fake: Tensor) -> Tensor:
            shares = fake[:, :classes]
            parts = {
                "lovasz": lovasz_softmax(shares, batch.camera_labels, ignore=0),
                "entropy": nll_loss(shares.clamp(min=TINY).log(), batch.camera_labels, ignore_index=0),
                "depth": (fake[:, classes:] - depth).abs().sum() / measured.sum().clamp(min=1),
            }
            self.logs |= {name: part.detach() for name, part in parts.items()}
            return torch.stack([weights[name] * part for name, part in parts.items()]).sum()

        updates = wasserstein_updates(
            forward,
            self.networks["critic"],
            torch.cat([one_hot_layers(batch.camera_labels, classes), depth], 1),
            condition,
            penalty_weight=float(self.option["penalty"]),
            guide=guide,
            logs=self.logs,
        )
        yield from called(updates, "translator")

    def both(self, sample: FrontViewSample) -> tuple[Tensor, Tensor]:
        """Class ids (h, w) and depths (h, w), metres, of a sample, from the network as it stands."""
        network = self.networks["translator"]
        device = next(network.parameters()).device
        with torch.inference_mode():
            condition = conditions(sample.segments[None].to(device))
            logits, depth_m = network(sample.lidar[None].to(device), condition)
        return logits[0].argmax(0).cpu(), depth_m[0].cpu()

    def predict(self, sample: FrontViewSample) -> Tensor:
        """Class ids (h, w) of a sample, from the network as it stands."""
        return self.both(sample)[0]

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image; mean relative error of depths that the LiDAR measured."""
        confusion, errors = Confusion(len(COMMON14), unscored=(0,)), []
        for index in range(len(self.validation)):
            sample = self.validation[index]
            ids, depth_m = self.both(sample)
            confusion.update(ids, sample.camera_labels)
            measured = sample.depth_m > 0
            errors.append(((depth_m - sample.depth_m).abs() / sample.depth_m)[measured].mean().item())
        score = confusion.miou()
        relative = float(np.nanmean(errors))
        return {"score": score, "miou": score, "accuracy": confusion.accuracy(), "depth_abs_rel": relative}

    def preview(self) -> dict[str, np.ndarray]:
        """As in FrontTranslation, and "depth": measured above foretold, near is bright."""
        rows: list[Tensor] = []
        for index in range(min(2, len(self.validation))):
            sample = self.validation[index]
            rows += [(1 - depth_code(depth_m)) * (depth_m > 0) for depth_m in (sample.depth_m, self.both(sample)[1])]
        grey = (255 * torch.cat(rows)).round().clamp(0, 255).to(torch.uint8)
        return {**super().preview(), "depth": grey[..., None].expand(-1, -1, 3).contiguous().numpy()}
