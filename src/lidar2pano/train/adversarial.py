"""The paper's adversarial step: a Wasserstein critic with gradient penalty, then the generator with its guide."""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from lidar2pano.losses import critic_wasserstein, generator_wasserstein, gradient_penalty


def wasserstein_updates(
    generator_forward: Callable[[], Tensor],
    critic: nn.Module,
    real: Tensor,
    condition: Tensor | None,
    penalty_weight: float = 10.0,
    guide: Callable[[Tensor], Tensor] | None = None,
    epsilon: Tensor | float | None = None,
    logs: MutableMapping[str, float | Tensor] | None = None,
) -> Iterator[tuple[str, Tensor]]:
    """Yield ("critic", loss), then ("generator", loss); whoever is named is to be moved before the next is asked for.

    Paper section 3.2 ("Loss Function") with Gulrajani et al. 2017, Algorithm 1 and one critic step per generator step.
    The critic's loss leaves no gradient in the generator, nor the generator's in the critic, which is frozen while
    the generator learns.

    generator_forward  () -> fake, of real's shape. Called before each yield: without a graph for the critic, anew for
                       the generator (as published), so that the generator's graph is not kept while the critic
                       learns; give one that returns the same tensor twice to save time for memory.
    critic             (image, condition) -> scores of any shape.
    real               (B, ...) float; one-hot classes, or a picture.
    penalty_weight     lambda of the gradient penalty (the published code multiplies by 1 but logs 10).
    guide              fake -> a loss that is added to the generator's (Lovasz-Softmax; squared error for pictures).
    epsilon            where between real and fake the penalty looks, as in `gradient_penalty`; drawn when None.
    logs               filled with the parts of the losses, detached: wasserstein (E[D(real)] - E[D(fake)], the distance
                       that the critic estimates), penalty, adversarial, guide.
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
        if guide is not None:
            guiding = guide(fake)
            logs["guide"] = guiding.detach()
            loss = loss + guiding
        yield "generator", loss


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Inside, losses leave no gradient in the weights of `network`; which of them learn is as before afterwards."""
    learning = [weight for weight in network.parameters() if weight.requires_grad]
    try:
        for weight in learning:
            weight.requires_grad_(False)
        yield
    finally:
        for weight in learning:
            weight.requires_grad_(True)
