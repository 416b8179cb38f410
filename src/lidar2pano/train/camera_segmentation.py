"""Task: the camera's segmenter, on images and the labels that a teacher gave them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.camera_images import CameraImageDataset, CameraImageSample, ImageAugmentation
from lidar2pano.data.frames import IGNORE, evenly_spaced
from lidar2pano.labels import CITYSCAPES
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.supervised import labelled_cross_entropy
from lidar2pano.models.camera_segmenter import CameraSegmenter, ImageNormalisation
from lidar2pano.train.options import CameraSegmentationOptions
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.task import build_networks, segmentation_scores


class CameraSegmentation:
    """Trains SD-Net as its authors do, on the joint and auxiliary outputs and, with a small weight, on each scale's.

    Pixels of which the teacher is unsure are ignored.
    """

    released = ("camera",)

    def __init__(self, recipe: Recipe[CameraSegmentationOptions], root: Path) -> None:
        self.options = options = recipe.options
        augmentation = ImageAugmentation(
            crop=(options.rows, options.columns),
            scale=(options.scale_min, options.scale_max),
            colour_jitter=options.colour_jitter,
        )
        self.dataset = CameraImageDataset(root, recipe.data.train, augmentation)
        self.validation = CameraImageDataset(root, recipe.data.val, augmentation)
        self.networks = build_networks(recipe)
        self.normalise = ImageNormalisation()
        self.logs: dict[str, float | Tensor] = {}

    def updates(self, batch: CameraImageSample) -> Iterator[tuple[str, Tensor]]:
        """One update: cross-entropy of all outputs, and Lovasz-Softmax of the joint one."""
        options = self.options
        images = self.normalise(batch.image).contiguous(memory_format=torch.channels_last)
        outputs = self.networks["camera"](images)
        entropy = labelled_cross_entropy(outputs.joint, batch.labels, IGNORE)
        loss = entropy + options.auxiliary * labelled_cross_entropy(outputs.auxiliary, batch.labels, IGNORE)
        for logits in outputs.each if options.per_scale else ():
            loss = loss + options.per_scale * labelled_cross_entropy(logits, batch.labels, IGNORE)
        self.logs = {"cross_entropy": entropy.detach()}
        if options.lovasz:
            lovasz = lovasz_softmax(outputs.joint.float().softmax(1), batch.labels, ignore=IGNORE)
            self.logs["lovasz"] = lovasz.detach()
            loss = loss + options.lovasz * lovasz
        yield "camera", loss

    def predict(self, image: np.ndarray) -> Tensor:
        """Class ids (h, w) of a whole image (h, w, 3) uint8, at the network's scales."""
        segmenter = CameraSegmenter(network=self.networks["camera"], normalise=self.normalise)
        return segmenter.probabilities(image).argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the classes that occur in labels or predictions of the split, and the share of pixels that agree.

        Whole images; pixels of which the teacher is unsure are not scored.
        """
        pairs = (self.validation.pair(index) for index in evenly_spaced(len(self.validation)))
        return segmentation_scores(((self.predict(image), ids) for image, ids in pairs), CITYSCAPES)

    def preview(self) -> dict[str, np.ndarray]:
        """Image, teacher's classes and the network's, one above the other, for two validation frames; uint8 RGB."""
        previews = {}
        for index in range(min(2, len(self.validation))):
            image, ids = self.validation.pair(index)
            name = self.validation.frames[index].name.replace("/", "-")
            painted = [CITYSCAPES.paint(labels) for labels in (ids, self.predict(image).numpy())]
            previews[f"camera-{name}"] = np.concatenate([image, *painted])
        return previews

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """What a user of the segmenter has to know: label set and normalisation."""
        return {"labels": CITYSCAPES.name, "normalisation": self.normalise.as_dict()}
