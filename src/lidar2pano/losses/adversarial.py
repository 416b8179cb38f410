"""Adversarial training: losses, alternating updates of networks, changes of images before a discriminator.

Updates: the paper's Wasserstein critic with gradient penalty, and Pix2Pix's discriminator.
DiffAugment: Zhao et al. 2020 (arXiv:2006.10738, section 3.3): colour, translation and cutout, each differentiable. A
real and a generated image of one sample share their parameters, since feature matching compares them pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.functional import pad

# of scores against "real" (1) or "generated" (0): Goodfellow et al. 2014, with logits; Mao et al. 2017
GAN_MODES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "vanilla": F.binary_cross_entropy_with_logits,
    "lsgan": F.mse_loss,
}


def gradient_penalty(
    critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, *, epsilon: Tensor | float | None = None
) -> Tensor:
    """E[(|grad D(x)| - 1)^2] with x = epsilon real + (1 - epsilon) fake; the usual weight of 10 is the caller's.

    Gulrajani et al. 2017 (arXiv:1704.00028), equation 3; epsilon is drawn per sample, Algorithm 1 line 4.
    Autocast is off inside: a gradient of a gradient in half precision is mostly rounding.

    critic      image -> scores of any shape (summed: every patch counts); the caller binds its condition.
    real, fake  (B, ...) float; no gradient reaches their makers.
    epsilon     (B,) or a number to use in place of the draw.
    """
    real, fake = real.detach(), fake.detach()
    if epsilon is None:
        epsilon = torch.rand(len(real), device=real.device, dtype=real.dtype)
    if isinstance(epsilon, Tensor):
        epsilon = epsilon.view(-1, *[1] * (real.ndim - 1))
    blend = (epsilon * real + (1 - epsilon) * fake).requires_grad_()
    with torch.autocast(real.device.type, enabled=False):
        (slope,) = torch.autograd.grad(critic(blend).sum(), blend, create_graph=True)
    while slope.ndim > 1:  # norm of norms: float32 sums of a million squares at once were off by 0.06 % on a CPU
        slope = torch.linalg.vector_norm(slope.float(), dim=-1)
    return (slope - 1).square().mean()


def critic_wasserstein(real_scores: Tensor, fake_scores: Tensor) -> Tensor:
    """E[D(fake)] - E[D(real)]: Gulrajani et al. 2017, equation 3 without its penalty."""
    return fake_scores.mean() - real_scores.mean()


def generator_wasserstein(fake_scores: Tensor) -> Tensor:
    """-E[D(fake)]: Gulrajani et al. 2017, Algorithm 1 line 12; it goes with `hinge_critic`, too."""
    return -fake_scores.mean()


def hinge_critic(real_scores: Tensor, fake_scores: Tensor) -> Tensor:
    """E[max(0, 1 - D(real))] + E[max(0, 1 + D(fake))]: Lim and Ye 2017 (arXiv:1705.02894), section 3."""
    return F.relu(1 - real_scores).mean() + F.relu(1 + fake_scores).mean()


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
    The critic's loss leaves no gradient in the generator, nor the generator's in the critic, frozen while
    the generator learns.

    generator_forward  () -> fake, of real's shape. Called before each yield: without a graph for the critic, and once
                       more for the generator (as published), to drop the generator's graph while the
                       critic learns; a function with the same tensor twice saves time at the cost of memory.
    critic             (image, condition) -> scores of any shape.
    real               (B, ...) float; one-hot classes, or an image.
    penalty_weight     lambda of the gradient penalty (the published code multiplies by 1 but logs 10).
    auxiliary          fake -> a loss added to the generator's (Lovasz-Softmax; squared error for images).
    epsilon            as in `gradient_penalty`; drawn when None.
    logs               filled with the parts of the losses, detached: wasserstein (E[D(real)] - E[D(fake)], the critic's
                       estimate of the distance), penalty, adversarial, auxiliary.
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
    gan_mode: str,
    auxiliary: Callable[[Tensor], Tensor],
    logs: MutableMapping[str, float | Tensor] | None = None,
) -> Iterator[tuple[str, Tensor]]:
    """Yield ("critic", loss), then ("generator", loss); step the named optimiser before resuming.

    Isola et al. 2017, section 3.1 and equation 4, in the order of the published code: one image is generated, the
    discriminator learns from it (its loss halved, section 3.3), and its new weights score the generator.

    generator_forward  () -> fake, of real's shape; called once.
    discriminator      (condition, image) -> scores of any shape.
    condition          (B, C, H, W), the generator's input; resized to the image, as Pix2Pix does.
    gan_mode           name in GAN_MODES;  auxiliary: fake -> a loss added to the generator's.
    logs               filled with the parts of the losses, detached: real, fake (means of the discriminator's scores),
                       adversarial, auxiliary.
    """
    logs = {} if logs is None else logs
    condition = F.interpolate(condition, size=real.shape[-2:], mode="area")
    rule = GAN_MODES[gan_mode]
    fake = generator_forward()
    on_real, on_fake = (discriminator(condition, image).float() for image in (real, fake.detach()))
    logs["real"], logs["fake"] = on_real.detach().mean(), on_fake.detach().mean()
    yield "critic", (rule(on_real, torch.ones_like(on_real)) + rule(on_fake, torch.zeros_like(on_fake))) / 2
    with frozen(discriminator):
        scores = discriminator(condition, fake).float()
        adversarial, further = rule(scores, torch.ones_like(scores)), auxiliary(fake)
        logs["adversarial"], logs["auxiliary"] = adversarial.detach(), further.detach()
        yield "generator", adversarial + further


def renamed(updates: Iterator[tuple[str, Tensor]], generator: str) -> Iterator[tuple[str, Tensor]]:
    """The updates with the generator under the recipe's name for it."""
    for name, loss in updates:
        yield generator if name == "generator" else name, loss


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Keep losses from leaving gradients in the weights of `network`; afterwards they are trainable again."""
    learning = [weight for weight in network.parameters() if weight.requires_grad]
    try:
        for weight in learning:
            weight.requires_grad_(False)
        yield
    finally:
        for weight in learning:
            weight.requires_grad_(True)


BRIGHTNESS, CONTRAST = 0.5, 0.5  # of colours in [-1, 1]: largest offset, either way; factor 1 +- this
TRANSLATION = 1 / 8  # largest, as a share of an image's rows and columns
CUTOUT = 1 / 2  # zeroed share of its rows and columns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiffAugment:
    """Parameters of the augmentation of B images, (B,) each.

    brightness            added to colours;  saturation, contrast: factors about the pixel's mean and the image's.
    down, right           translation as a share of the image, in [-1/8, 1/8]; new pixels are zero.
    cut_row, cut_column   middle of the cutout as a share of the image; NaN for none.
    """

    brightness: Tensor
    saturation: Tensor
    contrast: Tensor
    down: Tensor
    right: Tensor
    cut_row: Tensor
    cut_column: Tensor

    @classmethod
    def drawn(cls, images: int, probability: float) -> Self:
        """Draw; each of the three kinds (colour, translation, cutout) applies with `probability` per image."""

        def applies() -> Tensor:
            return torch.rand(images) < probability

        def symmetric(applies: Tensor, largest: float) -> Tensor:
            return (torch.rand(images) * 2 - 1) * largest * applies

        colour, translation, cutout = applies(), applies(), applies()
        none = torch.full((images,), torch.nan)
        return cls(
            brightness=symmetric(colour, BRIGHTNESS),
            saturation=1 + symmetric(colour, 1.0),
            contrast=1 + symmetric(colour, CONTRAST),
            down=symmetric(translation, TRANSLATION),
            right=symmetric(translation, TRANSLATION),
            cut_row=torch.where(cutout, torch.rand(images), none),
            cut_column=torch.where(cutout, torch.rand(images), none),
        )

    def apply(self, colour: Tensor, condition: Tensor) -> Tensor:
        """The discriminator's input (B, 3 + C, H, W): augmented colours and their condition.

        colour     (B, 3, H, W) in [-1, 1].
        condition  (B, C, H, W), the source of the colours: translated and cut out alike.
        """
        brightness, saturation, contrast = (
            factor.to(colour)[:, None, None, None] for factor in (self.brightness, self.saturation, self.contrast)
        )
        colour = colour + brightness
        grey = colour.mean(1, keepdim=True)
        colour = grey + (colour - grey) * saturation
        mean = grey.mean((1, 2, 3), keepdim=True)
        images = torch.cat([mean + (colour - mean) * contrast, condition], 1)
        rows, columns = images.shape[-2:]
        translated = []
        for image, down, right in zip(images, self.down.tolist(), self.right.tolist(), strict=True):
            row_shift, column_shift = round(down * rows), round(right * columns)
            translated.append(pad(image, (column_shift, -column_shift, row_shift, -row_shift)))
        in_row, in_column = (
            (torch.linspace(0, 1, pixels)[None] - middle[:, None]).abs() <= CUTOUT / 2  # NaN is never inside
            for pixels, middle in ((rows, self.cut_row), (columns, self.cut_column))
        )
        return torch.stack(translated) * (~(in_row[:, None, :, None] & in_column[:, None, None, :])).to(images)
