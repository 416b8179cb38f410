"""Pix2Pix's adversarial step: a patch critic told true pairs from made ones, then the generator with its guide."""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss

from lidar2pano.errors import InputError, closest
from lidar2pano.train.adversarial import frozen

# how scores are held against "true" (1) or "made" (0): Goodfellow et al. 2014, with logits; Mao et al. 2017
RULES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"vanilla": binary_cross_entropy_with_logits, "lsgan": mse_loss}


def pix2pix_updates(
    generator_forward: Callable[[], Tensor],
    critic: nn.Module,
    real: Tensor,
    condition: Tensor,
    guide: Callable[[Tensor], Tensor],
    rule: str = "vanilla",
    logs: MutableMapping[str, float | Tensor] | None = None,
) -> Iterator[tuple[str, Tensor]]:
    """Yield ("critic", loss), then ("generator", loss); whoever is named is to be moved before the next is asked for.

    Isola et al. 2017, section 3.1 and equation 4, in the order of the published code: one picture is made, the critic
    learns from it (its loss halved, section 3.3), and the generator is told by the critic that has moved.

    generator_forward  () -> fake, of real's shape; called once.
    critic             (condition, image) -> scores of any shape.
    guide              fake -> a loss that is added to the generator's (100 times the absolute distance, as published).
    rule               of RULES; an unknown one raises InputError.
    logs               filled with the parts of the losses, detached: real, fake (means of the critic's scores),
                       adversarial, guide.
    """
    if rule not in RULES:
        raise InputError(f"no rule {rule!r} for the critic{closest(rule, RULES)}")
    logs = {} if logs is None else logs
    fake = generator_forward()
    on_real, on_fake = (critic(condition, image).float() for image in (real, fake.detach()))
    logs["real"], logs["fake"] = on_real.detach().mean(), on_fake.detach().mean()
    yield (
        "critic",
        (RULES[rule](on_real, torch.ones_like(on_real)) + RULES[rule](on_fake, torch.zeros_like(on_fake))) / 2,
    )
    with frozen(critic):
        scores = critic(condition, fake).float()
        adversarial, guiding = RULES[rule](scores, torch.ones_like(scores)), guide(fake)
        logs["adversarial"], logs["guide"] = adversarial.detach(), guiding.detach()
        yield "generator", adversarial + guiding
