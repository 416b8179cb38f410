"""The paper's setting, front range view in and the camera's perspective segments out: options, tasks and recipes.

TITAN-Net, its ablations (section 4.5 and the supplement), its follow-up TITAN-Next, and Pix2Pix, the baseline.
Rows of the paper's tables: "TITAN-Net (w/o L_ls)" is titan-no-lovasz, "TITAN-Net - w/o Rangeview -> Vid2Vid" is
titan-no-range, "Pix2Pix" and "Pix2Pix -> Vid2Vid" are pix2pix-segments; rows without segments are in `colour`. How the
authors fed the baselines is unpublished; ours get TITAN-Net's inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import l1_loss, mse_loss, nll_loss

from lidar2pano.data.cache import stored_labels
from lidar2pano.data.camera_pairs import FrontViewDataset, FrontViewSample, SampleParts
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.geometry.projection import one_hot_layers
from lidar2pano.labels import COMMON14, SEMANTIC_KITTI
from lidar2pano.losses import lovasz_softmax
from lidar2pano.losses.adversarial import pix2pix_updates, renamed, wasserstein_updates
from lidar2pano.scene.depth import depth_code
from lidar2pano.train.recipe import (
    NO_LIMIT,
    Network,
    Optimizer,
    Recipe,
    TaskOptions,
    Training,
    on_two_cores,
    vary,
    with_optimizers,
)
from lidar2pano.train.task import (
    build_networks,
    device_of,
    image_size,
    label_preview,
    load_segmenter,
    range_view_card,
    segmentation_scores,
)
from lidar2pano.views import VIEWS

TINY = 1e-8  # least probability whose logarithm is taken
HALF = (188, 620)  # rows, columns: half of KITTI's images
EPOCHS = 118  # of the paper's training
AUXILIARY = 1000.0  # factor of the auxiliary losses in recipes for minutes on a CPU
PAPERS_ADAM = Optimizer(algorithm="adam", rate=1e-4, betas=(0.5, 0.999), schedule="constant")


@dataclass(frozen=True, kw_only=True)
class FrontOptions(TaskOptions):
    """TITAN-Net.

    gradient_penalty  weight (lambda) of the WGAN's gradient penalty;  lovasz: weight of Lovasz-Softmax; 0: none.
    segments          the condition: "predicted" by a segmenter, or the "data"'s own (in validation the segmenter's).
    segmenter         weight file of the segmenter; "": predicted_labels/ of the data, written by `prepare`.
    """

    task = "front"
    gradient_penalty: float = 10.0
    lovasz: float = 1.0
    segments: Literal["predicted", "data"] = "data"
    segmenter: str = ""


@dataclass(frozen=True, kw_only=True)
class FrontDepthOptions(FrontOptions):
    """TITAN-Next: beside TITAN-Net's options the weights of cross-entropy and of the distance of depth codes."""

    task = "front-depth"
    lovasz: float = 0.1
    cross_entropy: float = 0.1
    depth: float = 0.1


@dataclass(frozen=True, kw_only=True)
class Pix2PixOptions(TaskOptions):
    """Pix2Pix: the discriminator's loss, the auxiliary loss of the generator and its weight."""

    gan_mode: Literal["vanilla", "lsgan"] = "vanilla"
    auxiliary: Literal["l1", "mse"] = "l1"
    auxiliary_weight: float = 100.0


@dataclass(frozen=True, kw_only=True)
class Pix2PixSegmentsOptions(Pix2PixOptions):
    """Pix2Pix in TITAN-Net's place; segments, segmenter: as for TITAN-Net."""

    task = "pix2pix-segments"
    segments: Literal["predicted", "data"] = "data"
    segmenter: str = ""


class FrontTask:
    """Shared networks, data, scores and previews; subclasses have `updates`.

    The translator's `size` is that of its predicted image.
    """

    released = ("translator",)
    options: Any
    parts: ClassVar[SampleParts] = SampleParts(labels=True)

    def __init__(self, recipe: Recipe[FrontOptions] | Recipe[Pix2PixSegmentsOptions], root: Path) -> None:
        self.view, self.options = VIEWS[recipe.view], recipe.options
        self.networks = build_networks(recipe)
        size = image_size(self.networks["translator"])
        self.dataset, self.validation = (
            FrontViewDataset(root, splits, self.view, size, self.parts)
            for splits in (recipe.data.train, recipe.data.val)
        )
        self.logs: dict[str, float | Tensor] = {}
        use_predictions(recipe.options, self.dataset, self.validation)

    def output(self, sample: FrontViewSample) -> Any:  # noqa: ANN401 logits, or logits and depths
        """Apply the current translator to one sample, as a batch of one.

        In float32, since instance norms amplify the rounding of bfloat16.
        """
        network = self.networks["translator"]
        device = device_of(network)
        condition = one_hot_layers(sample.segments[None].to(device), len(SEMANTIC_KITTI))
        with torch.inference_mode():
            return network(sample.lidar[None].to(device), condition)

    def predict(self, sample: FrontViewSample) -> Tensor:
        """Predict class ids (h, w) of a sample."""
        return self.output(sample)[0].argmax(0).cpu()

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image, over up to 500 frames."""
        samples = (self.validation[index] for index in evenly_spaced(len(self.validation)))
        pairs = ((self.predict(sample), sample.camera_labels) for sample in samples)
        return segmentation_scores(pairs, len(COMMON14), unscored=(0,))

    def preview(self) -> dict[str, np.ndarray]:
        """Camera's labels above the network's, for two validation frames, (H, W, 3) uint8."""
        samples = (self.validation[index] for index in range(min(2, len(self.validation))))
        return label_preview(COMMON14, ((sample.camera_labels, self.predict(sample)) for sample in samples))

    def card(self, network: str) -> dict[str, Any]:  # noqa: ARG002 one network is released
        """Label set, view, normalisation."""
        return {"labels": COMMON14.name, **range_view_card(self.view)}


def use_predictions(
    options: FrontOptions | Pix2PixSegmentsOptions, training: FrontViewDataset, validation: FrontViewDataset
) -> None:
    """Condition data sets on a segmenter's labels, by the options; InputError when there are none."""
    chosen = (training, validation) if options.segments == "predicted" else (validation,)
    label_points = load_segmenter(options.segmenter) if options.segmenter else None
    for samples in chosen:
        if label_points:
            samples.predict(label_points, options.segmenter)
        elif options.segments == "predicted":
            samples.use(stored_labels)


def pix2pix_losses(options: Pix2PixOptions, real: Tensor) -> tuple[str, Callable[[Tensor], Tensor]]:
    """The mode of the adversarial loss, and the weighted distance of a generated image from `real`."""
    distance = {"l1": l1_loss, "mse": mse_loss}[options.auxiliary]
    return options.gan_mode, lambda fake: options.auxiliary_weight * distance(fake, real)


class FrontTranslation(FrontTask):
    """Trains TITAN-Net by WGAN-GP and Lovasz-Softmax; class 0 is neither trained nor scored, as in the paper.

    Ablations without one of the inputs are settings of the network.
    """

    options: FrontOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition = one_hot_layers(batch.segments, len(SEMANTIC_KITTI))

        def auxiliary(fake: Tensor) -> Tensor:
            return self.options.lovasz * lovasz_softmax(fake, batch.camera_labels, ignore=0)

        updates = wasserstein_updates(
            lambda: self.networks["translator"](batch.lidar, condition).float().softmax(1),
            self.networks["critic"],
            one_hot_layers(batch.camera_labels, len(COMMON14)),
            condition,
            penalty_weight=self.options.gradient_penalty,
            auxiliary=auxiliary if self.options.lovasz else None,
            logs=self.logs,
        )
        return renamed(updates, "translator")


class FrontDepthTranslation(FrontTask):
    """Trains TITAN-Next: WGAN-GP over classes and depth together, with auxiliary losses on both.

    The depth target is the LiDAR's own, projected into the camera, so it is known at some pixels only: auxiliary loss
    and critic use depths there alone. Auxiliary losses are Lovasz-Softmax and cross-entropy without class 0, and the
    absolute distance of measured depth codes.
    """

    parts: ClassVar[SampleParts] = SampleParts(labels=True, depth=True)

    options: FrontDepthOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The critic, then the translator."""
        condition, classes = one_hot_layers(batch.segments, len(SEMANTIC_KITTI)), len(COMMON14)
        measured = (batch.depth_m > 0)[:, None].float()
        depth = depth_code(batch.depth_m)[:, None]  # zero where unmeasured
        options = self.options

        def forward() -> Tensor:
            logits, depth_m = self.networks["translator"](batch.lidar, condition)
            return torch.cat([logits.float().softmax(1), depth_code(depth_m)[:, None] * measured], 1)

        def auxiliary(fake: Tensor) -> Tensor:
            probabilities = fake[:, :classes]
            lovasz = lovasz_softmax(probabilities, batch.camera_labels, ignore=0)
            entropy = nll_loss(probabilities.clamp(min=TINY).log(), batch.camera_labels, ignore_index=0)
            gap = (fake[:, classes:] - depth).abs().sum() / measured.sum().clamp(min=1)
            self.logs |= {"lovasz": lovasz.detach(), "cross_entropy": entropy.detach(), "depth": gap.detach()}
            parts = [options.lovasz * lovasz, options.cross_entropy * entropy, options.depth * gap]
            return torch.stack(parts).sum()

        updates = wasserstein_updates(
            forward,
            self.networks["critic"],
            torch.cat([one_hot_layers(batch.camera_labels, classes), depth], 1),
            condition,
            penalty_weight=options.gradient_penalty,
            auxiliary=auxiliary,
            logs=self.logs,
        )
        return renamed(updates, "translator")

    def predict_both(self, sample: FrontViewSample) -> tuple[Tensor, Tensor]:
        """Predict class ids (h, w) and depths (h, w), metres, of a sample."""
        logits, depth_m = self.output(sample)
        return logits[0].argmax(0).cpu(), depth_m[0].cpu()

    def predict(self, sample: FrontViewSample) -> Tensor:
        """Predict class ids (h, w) of a sample."""
        return self.predict_both(sample)[0]

    def validate(self) -> dict[str, float]:
        """MIoU over the 14 classes on the network's image; mean relative error of measured depths."""
        errors: list[float] = []

        def pairs() -> Iterator[tuple[Tensor, Tensor]]:
            for index in evenly_spaced(len(self.validation)):
                sample = self.validation[index]
                ids, depth_m = self.predict_both(sample)
                measured = sample.depth_m > 0
                errors.append(((depth_m - sample.depth_m).abs() / sample.depth_m)[measured].mean().item())
                yield ids, sample.camera_labels

        scores = segmentation_scores(pairs(), len(COMMON14), unscored=(0,))
        return {**scores, "depth_abs_rel": float(np.nanmean(errors))}

    def preview(self) -> dict[str, np.ndarray]:
        """As in FrontTask, and "depth": measured above predicted, near is bright."""
        rows: list[Tensor] = []
        for index in range(min(2, len(self.validation))):
            sample = self.validation[index]
            depths = (sample.depth_m, self.predict_both(sample)[1])
            rows += [(1 - depth_code(depth_m)) * (depth_m > 0) for depth_m in depths]
        grey = (255 * torch.cat(rows)).round().clamp(0, 255).to(torch.uint8)
        return {**super().preview(), "depth": grey[..., None].expand(-1, -1, 3).contiguous().numpy()}


class Pix2PixSegments(FrontTask):
    """Trains Pix2Pix from range view and segments to the camera's segments, one-hot in [-1, 1].

    Every pixel counts, those of class 0 too: Pix2Pix ignores no class.
    """

    options: Pix2PixSegmentsOptions

    def updates(self, batch: FrontViewSample) -> Iterator[tuple[str, Tensor]]:
        """The discriminator, then the translator."""
        condition = one_hot_layers(batch.segments, len(SEMANTIC_KITTI))
        real = 2 * one_hot_layers(batch.camera_labels, len(COMMON14)) - 1
        updates = pix2pix_updates(
            lambda: self.networks["translator"](batch.lidar, condition).float(),
            self.networks["critic"],
            real,
            torch.cat([batch.lidar, condition], 1),
            *pix2pix_losses(self.options, real),
            logs=self.logs,
        )
        return renamed(updates, "translator")


def titan() -> Recipe[FrontOptions]:
    """TITAN-Net as in the paper: WGAN-GP (lambda 10), Lovasz-Softmax, Adam 1e-4, batch 10, dropout 0.2, 118 epochs.

    Its condition is a segmenter's labels, not the data's (section 3.1). The batch of 10 needs some 70 GB at once, so
    it is taken in 10 micro-batches, and Lovasz-Softmax is then a mean over single images; `training.accumulate=1`
    makes it one over the whole batch, if the GPU holds it. Everything else is the same either way.
    """
    return Recipe(
        view="titan-front",
        networks={
            "translator": Network(model="titan", settings={"classes": 15, "conditions": 20}, optimizer=PAPERS_ADAM),
            "critic": Network(
                model="titan-critic", settings={"image_channels": 15, "conditions": 20}, optimizer=PAPERS_ADAM
            ),
        },
        options=FrontOptions(segments="predicted"),
        training=Training(steps=NO_LIMIT, epochs=EPOCHS, batch=10, accumulate=10, ema=0.0, precision="32-true"),
    )


def papers_protocol(make: Callable[[], Recipe]) -> Callable[[], Recipe]:
    """A baseline trained as TITAN-Net is ("using the same training protocol", section 4.4): Adam, batch, epochs."""

    @wraps(make)
    def made() -> Recipe:
        recipe = with_optimizers(make(), **asdict(PAPERS_ADAM))
        accumulate = max(recipe.training.accumulate, 2)
        training = replace(recipe.training, steps=NO_LIMIT, epochs=EPOCHS, batch=10, accumulate=accumulate)
        options = recipe.options
        if isinstance(options, Pix2PixSegmentsOptions):
            options = replace(options, segments="predicted")
        return replace(recipe, training=training, options=options)

    return made


def titan_mini() -> Recipe[FrontOptions]:
    """TITAN-Net the paper's way on `kitti-mini`, for as long as `titan-pano-mini`; one pair a step, 512 columns.

    With the paper's batch, columns and image a step takes minutes on a CPU, and more steps teach more: the image is
    half as large here and the critic a quarter as wide. Lovasz-Softmax weighs AUXILIARY times as much and the
    translator's rate is twenty times as high: after 150 steps on a street world mIoU is 0.18, with the paper's sum and
    that rate 0.07.
    """
    options = {"lovasz": AUXILIARY, "segments": "data"}
    recipe = vary(titan(), options=options, translator={"size": HALF}, critic={"width": 16})
    recipe = replace(with_optimizers(recipe, "translator", rate=2e-3, schedule="cosine"), view="titan-front-512")
    return on_two_cores(recipe, minutes=24.0, batch=1, ema=0.0, precision="bf16-mixed")


def _next(recipe: Recipe, width: int, options: FrontDepthOptions) -> Recipe[FrontDepthOptions]:
    """TITAN-Next in TITAN-Net's place."""
    recipe = vary(recipe, translator={"width": width}, critic={"image_channels": 16})
    networks = {**recipe.networks, "translator": replace(recipe.networks["translator"], model="titan-next")}
    return replace(recipe, view="titan-front-512", networks=networks, options=options)


def titan_next() -> Recipe[FrontDepthOptions]:
    """TITAN-Next (Cortinhal and Aksoy 2023) with TITAN-Net's numbers: feature pyramid, depth head, 512 columns.

    Auxiliary losses weigh 0.1 each, as in its authors' public code; the depth target is the LiDAR's own
    (theirs is not described), and their further losses (similarity and smoothness of depth, entropy of the prediction)
    are left out.
    """
    return _next(titan(), 64, FrontDepthOptions(segments="predicted"))


def titan_next_mini() -> Recipe[FrontDepthOptions]:
    """TITAN-Next as `titan-mini`, with half the channels; its auxiliary losses weigh as much as there."""
    options = FrontDepthOptions(lovasz=AUXILIARY, cross_entropy=AUXILIARY / 10, depth=AUXILIARY)
    return _next(titan_mini(), 32, options)


def pix2pix_segments() -> Recipe[Pix2PixSegmentsOptions]:
    """Pix2Pix from range view and segments to the camera's segments; at full length with TITAN-Net's protocol.

    Cross-entropy discriminator and 100 times the absolute distance, Adam 2e-4, one pair a step (Isola et al. 2017,
    section 3.3); statistics of the batch at hand in evaluation too, as its test command runs. These are the numbers of
    the -mini form; at full length the baselines have TITAN-Net's protocol (`papers_protocol`).
    """
    adam = Optimizer(algorithm="adam", rate=2e-4, betas=(0.5, 0.999), schedule="constant")
    settings = {"inputs": 25, "outputs": 15, "width": 64, "batch_statistics": True, "size": (376, 1241)}
    return Recipe(
        view="titan-front",
        networks={
            "translator": Network(model="pix2pix", settings=settings, optimizer=adam),
            "critic": Network(model="pix2pix-critic", settings={"channels": 40, "width": 64}, optimizer=adam),
        },
        options=Pix2PixSegmentsOptions(),
        training=Training(steps=100_000, batch=1, ema=0.0),
    )


def pix2pix_mini(recipe: Recipe) -> Recipe:
    """Pix2Pix on images half as large, with half the channels and 512 columns of the range view."""
    (role,) = recipe.networks.keys() - {"critic"}
    small = vary(recipe, critic={"width": 32}, **{role: {"width": 32, "size": HALF}})
    return replace(on_two_cores(small, minutes=8.0, batch=1, ema=0.0), view="titan-front-512")


RECIPES: dict[str, Callable[[], Recipe]] = {
    "titan": titan,
    "titan-mini": titan_mini,
    "titan-no-lovasz": lambda: vary(titan(), options={"lovasz": 0.0}),
    "titan-no-lovasz-mini": lambda: vary(titan_mini(), options={"lovasz": 0.0}),
    "titan-no-range": lambda: vary(titan(), translator={"channels": 0}),
    "titan-no-range-mini": lambda: vary(titan_mini(), translator={"channels": 0}),
    "titan-next": titan_next,
    "titan-next-mini": titan_next_mini,
    "pix2pix-segments": papers_protocol(pix2pix_segments),
    "pix2pix-segments-mini": lambda: pix2pix_mini(pix2pix_segments()),
}
