"""Adversarial training steps: the paper's Wasserstein critic with gradient penalty, and Pix2Pix's discriminator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate, l1_loss, mse_loss

from lidar2pano.losses import critic_wasserstein, generator_wasserstein, gradient_penalty
from lidar2pano.train.options import Pix2PixOptions

Loss = Callable[[Tensor, Tensor], Tensor]
# of scores against "real" (1) or "generated" (0): Goodfellow et al. 2014, with logits; Mao et al. 2017
GAN_MODES: dict[str, Loss] = {"vanilla": binary_cross_entropy_with_logits, "lsgan": mse_loss}
AUXILIARY: dict[str, Loss] = {"l1": l1_loss, "mse": mse_loss}


def wasserstein_updates(
    generator_forward: Callable[[], Tensor],
    critic: nn.Module,
    real: Tensor,
    condition: Tensor | None,
    penalty_weight: float = 10.0,
    auxiliary: Callable[[Tensor], Tensor] | None = None,
    epsilon: Tensor | float | None = None,
    logs: MutableMapping[str, float | Tensor] | None = None,
) -> Iterator[tuple[str, Tensor]]:
    """Yield ("critic", loss), then ("generator", loss); step the named optimiser before resuming.

    Paper section 3.2 ("Loss Function") with Gulrajani et al. 2017, Algorithm 1 and one critic step per generator step.
    The critic's loss leaves no gradient in the generator, nor the generator's in the critic, which is frozen while
    the generator learns.

    generator_forward  () -> fake, of real's shape. Called before each yield: without a graph for the critic, and once
                       more for the generator (as published), so that the generator's graph is not kept while the
                       critic learns; give one that returns the same tensor twice to save time at the cost of memory.
    critic             (image, condition) -> scores of any shape.
    real               (B, ...) float; one-hot classes, or an image.
    penalty_weight     lambda of the gradient penalty (the published code multiplies by 1 but logs 10).
    auxiliary          fake -> a loss that is added to the generator's (Lovasz-Softmax; squared error for images).
    epsilon            as in `gradient_penalty`; drawn when None.
    logs               filled with the parts of the losses, detached: wasserstein (E[D(real)] - E[D(fake)], the distance
                       that the critic estimates), penalty, adversarial, auxiliary.
    """
    logs = {} if logs is None else logs
    with torch.no_grad():
        fake = generator_forward().detach()
    separation = critic_wasserstein(critic(real, condition), critic(fake, condition))
    bare = getattr(critic, "module", critic)  # Fabric's wrapper forbids gradients other than by its own backward
    penalty = gradient_penalty(lambda image: bare(image, condition), real, fake, epsilon=epsilon)
    logs["wasserstein"], logs["penalty"] = -separation.detach(), penalty.detach()
    yield "critic", separation + penalty_weight * penalty
    del separation, penalty
    with frozen(critic):
        fake = generator_forward()
        loss = generator_wasserstein(critic(fake, condition))
        logs["adversarial"] = loss.detach()
        if auxiliary is not None:
            further = auxiliary(fake)
            logs["auxiliary"] = further.detach()
            loss = loss + further
        yield "generator", loss


def pix2pix_updates(
    generator_forward: Callable[[], Tensor],
    discriminator: nn.Module,
    real: Tensor,
    condition: Tensor,
    options: Pix2PixOptions,
    logs: MutableMapping[str, float | Tensor] | None = None,
) -> Iterator[tuple[str, Tensor]]:
    """Yield ("critic", loss), then ("generator", loss); step the named optimiser before resuming.

    Isola et al. 2017, section 3.1 and equation 4, in the order of the published code: one image is generated, the
    discriminator learns from it (its loss halved, section 3.3), and its new weights score the generator.

    generator_forward  () -> fake, of real's shape; called once.
    discriminator      (condition, image) -> scores of any shape.
    condition          (B, C, H, W), the generator's input; resized to the image, as Pix2Pix does.
    logs               filled with the parts of the losses, detached: real, fake (means of the discriminator's scores),
                       adversarial, auxiliary.
    """
    logs = {} if logs is None else logs
    condition = interpolate(condition, size=real.shape[-2:], mode="area")
    rule = GAN_MODES[options.gan_mode]
    fake = generator_forward()
    on_real, on_fake = (discriminator(condition, image).float() for image in (real, fake.detach()))
    logs["real"], logs["fake"] = on_real.detach().mean(), on_fake.detach().mean()
    yield "critic", (rule(on_real, torch.ones_like(on_real)) + rule(on_fake, torch.zeros_like(on_fake))) / 2
    with frozen(discriminator):
        scores = discriminator(condition, fake).float()
        adversarial = rule(scores, torch.ones_like(scores))
        auxiliary = options.auxiliary_weight * AUXILIARY[options.auxiliary](fake, real)
        logs["adversarial"], logs["auxiliary"] = adversarial.detach(), auxiliary.detach()
        yield "generator", adversarial + auxiliary


def renamed(updates: Iterator[tuple[str, Tensor]], generator: str) -> Iterator[tuple[str, Tensor]]:
    """The updates with the generator under the recipe's name for it."""
    for name, loss in updates:
        yield generator if name == "generator" else name, loss


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Inside, losses leave no gradient in the weights of `network`; afterwards those that were trainable are again."""
    learning = [weight for weight in network.parameters() if weight.requires_grad]
    try:
        for weight in learning:
            weight.requires_grad_(False)
        yield
    finally:
        for weight in learning:
            weight.requires_grad_(True)
