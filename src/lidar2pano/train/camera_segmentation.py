"""Task: the camera's segmenter, on pictures and the classes that a teacher sees in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from lidar2pano.data.camera_images import CameraImageDataset, CameraImageSample, ImageAugmentation
from lidar2pano.data.frames import IGNORE
from lidar2pano.labels import CITYSCAPES
from lidar2pano.losses import lovasz_softmax
from lidar2pano.metrics.confusion import Confusion
from lidar2pano.models.camera_segmenter import CameraSegmenter, Colours
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks


class CameraSegmentation:
    """Trains SD-Net as its authors do, on the joint and auxiliary answers and, a little, on each scale's own.

    Pixels of which the teacher is unsure teach nothing.
    Options: rows and columns, size of the crops; smallest and largest, factors of the pictures' random size; jitter,
    how far colours vary (ImageAugmentation); lovasz, the weight of Lovasz-Softmax of the joint answer; auxiliary and
    each, weights of the cross-entropy of OCR's first guess and of every scale by itself.
    """

    released = ("camera",)

    def __init__(self, recipe: Recipe, root: Path) -> None:
        option = recipe.options
        looks = ImageAugmentation(
            crop=(int(option["rows"]), int(option["columns"])),
            scale=(float(option["smallest"]), float(option["largest"])),
            colour_jitter=float(option["jitter"]),
        )
        self.dataset = CameraImageDataset(root, recipe.data.train, looks)
        self.validation = CameraImageDataset(root, recipe.data.val, looks)
        self.networks = build_networks(recipe)
        self.colours = Colours()
        self.lovasz, self.auxiliary, self.each = (float(option[name]) for name in ("lovasz", "auxiliary", "each"))
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: CameraImageSample) -> Iterator[tuple[str, Tensor]]:
        """One update: cross-entropy of all that the network says, and Lovasz-Softmax of the joint answer."""
        images = self.colours(batch.image).contiguous(memory_format=torch.channels_last)
        answers = self.networks["camera"](images)
        entropy = labelled_entropy(answers.joint, batch.labels)
        loss = entropy + self.auxiliary * labelled_entropy(answers.auxiliary, batch.labels)
        for logits in answers.each if self.each else ():
            loss = loss + self.each * labelled_entropy(logits, batch.labels)
        self.logs = {"cross_entropy": entropy.detach()}
        if self.lovasz:
            lovasz = lovasz_softmax(answers.joint.float().softmax(1), batch.labels, ignore=IGNORE)
            self.logs["lovasz"] = lovasz.detach()
            loss = loss + self.lovasz * lovasz
        yield "camera", loss

    def segmenter(self) -> CameraSegmenter:
        """The network as it stands, ready for pictures."""
        return CameraSegmenter(network=self.networks["camera"], normalise=self.colours)

    def validate(self) -> dict[str, float]:
        """MIoU over the classes that labels or network name anywhere in the split, and the share of pixels that agree.

        Whole pictures at the network's scales; pixels of which the teacher is unsure are not scored.
        """
        confusion, segmenter = Confusion(CITYSCAPES), self.segmenter()
        for index in range(len(self.validation)):
            image, ids = self.validation.pair(index)
            confusion.update(segmenter.probabilities(image).argmax(0).cpu(), ids)
        score = confusion.miou()
        return {"score": score, "miou": score, "accuracy": confusion.accuracy()}

    def preview(self) -> dict[str, np.ndarray]:
        """Picture, teacher's classes and the network's, one above the other, for two validation frames; uint8 RGB."""
        pictures = {}
        for index in range(min(2, len(self.validation))):
            image, ids = self.validation.pair(index)
            answer = self.segmenter().probabilities(image).argmax(0).cpu().numpy()
            name = self.validation.frames[index].name.replace("/", "-")
            pictures[f"camera-{name}"] = np.concatenate([image, CITYSCAPES.paint(ids), CITYSCAPES.paint(answer)])
        return pictures

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the segmenter has to know: label set and normalisation."""
        return {"labels": CITYSCAPES.name, "normalisation": self.colours.as_dict()}


def labelled_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy of logits (B, K, H, W) over the pixels of labels (B, H, W) that are not IGNORE; 0 without any."""
    total = cross_entropy(logits.float(), labels, ignore_index=IGNORE, reduction="sum")
    return total / (labels != IGNORE).sum().clamp(min=1)
