"""Recipes of TITAN-Net, of its ablations (section 4.5 and the supplement), and of its follow-up TITAN-Next.

Rows of the paper's tables: "TITAN-Net (w/o L_ls)" is titan-no-lovasz, "TITAN-Net - w/o SegMap" is titan-no-segments,
"TITAN-Net - w/o Rangeview -> Vid2Vid" is titan-no-range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

from lidar2pano.train.options import FrontColourOptions, FrontDepthOptions, FrontOptions, Pix2PixSegmentsOptions
from lidar2pano.train.recipe import Network, Optimizer, Recipe, Training, on_two_cores, vary

HALF = (188, 620)  # rows, columns: half of KITTI's images
EPOCHS = 118  # of the paper's training
NO_LIMIT = 100_000_000  # steps; epochs or minutes end the run
AUXILIARY = 1000.0  # factor of the auxiliary losses in recipes for minutes on a CPU


PAPERS_ADAM = Optimizer(algorithm="adam", rate=1e-4, betas=(0.5, 0.999), schedule="constant")


def titan() -> Recipe[FrontOptions]:
    """TITAN-Net as in the paper: WGAN-GP (lambda 10), Lovasz-Softmax, Adam 1e-4, batch 10, dropout 0.2, 118 epochs.

    Its condition is a segmenter's labels, not the data's (section 3.1). The batch of 10 needs some 70 GB at once, so
    it is taken in 10 micro-batches, and Lovasz-Softmax is then a mean over single images; `training.accumulate=1`
    makes it one over the whole batch where the GPU holds it. Everything else is the same either way.
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
        recipe = make()
        networks = {role: replace(network, optimizer=PAPERS_ADAM) for role, network in recipe.networks.items()}
        accumulate = max(recipe.training.accumulate, 2)
        training = replace(recipe.training, steps=NO_LIMIT, epochs=EPOCHS, batch=10, accumulate=accumulate)
        options = recipe.options
        if isinstance(options, Pix2PixSegmentsOptions):
            options = replace(options, segments="predicted")
        return replace(recipe, networks=networks, training=training, options=options)

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
    translator = recipe.networks["translator"]
    faster = replace(translator, optimizer=replace(translator.optimizer, rate=2e-3, schedule="cosine"))
    recipe = replace(recipe, view="titan-front-512", networks={**recipe.networks, "translator": faster})
    recipe = on_two_cores(recipe, minutes=24.0, batch=1, ema=0.0)
    return replace(recipe, training=replace(recipe.training, precision="bf16-mixed"))


def titan_next() -> Recipe[FrontDepthOptions]:
    """TITAN-Next (Cortinhal and Aksoy 2023) with TITAN-Net's numbers: feature pyramid, depth head, 512 columns.

    Auxiliary losses weigh 0.1 each, as in what its authors made public; the depth target is the LiDAR's own (theirs is
    not described), and their further losses (similarity and smoothness of depth, entropy of the prediction) are left
    out.
    """
    recipe = vary(titan(), translator={"width": 64}, critic={"image_channels": 16})
    translator = replace(recipe.networks["translator"], model="titan-next")
    networks = {**recipe.networks, "translator": translator}
    return replace(recipe, view="titan-front-512", networks=networks, options=FrontDepthOptions(segments="predicted"))


def titan_next_mini() -> Recipe[FrontDepthOptions]:
    """TITAN-Next as `titan-mini`, with half the channels; its auxiliary losses weigh as much as there."""
    recipe = vary(titan_mini(), translator={"width": 32}, critic={"image_channels": 16})
    translator = replace(recipe.networks["translator"], model="titan-next")
    networks = {**recipe.networks, "translator": translator}
    options = FrontDepthOptions(lovasz=AUXILIARY, cross_entropy=AUXILIARY / 10, depth=AUXILIARY)
    return replace(recipe, networks=networks, options=options)


def without_lovasz(recipe: Recipe[FrontOptions]) -> Recipe:
    """TITAN-Net against its critic alone."""
    return vary(recipe, options={"lovasz": 0.0})


def without_range(recipe: Recipe[FrontOptions]) -> Recipe:
    """TITAN-Net whose only input are the segments."""
    return vary(recipe, translator={"channels": 0})


def without_segments(recipe: Recipe[FrontOptions], mse: float = 1.0) -> Recipe:
    """TITAN-Net from the range view straight to colours, with the squared error as its auxiliary loss.

    The critic is conditioned on the range view, since there are no segments to condition it on. In few steps the
    squared error teaches ten times less than Lovasz-Softmax, so the mini form gives it ten times the weight.
    """
    recipe = vary(
        recipe,
        translator={"classes": 3, "conditions": 0, "picture": True},
        critic={"image_channels": 3, "conditions": 5},
    )
    networks = {"renderer": recipe.networks["translator"], "critic": recipe.networks["critic"]}
    options = FrontColourOptions(mse=mse, gradient_penalty=recipe.options.gradient_penalty)
    return replace(recipe, networks=networks, options=options)
