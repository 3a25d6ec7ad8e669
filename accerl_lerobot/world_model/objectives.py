# SPDX-License-Identifier: Apache-2.0
"""Three ways of learning to make an image, as pure functions of a network.

    edm      D(x; σ) = c_skip·x + c_out·F(c_in·x; c_noise), the clean image from a noisy one (Karras et al.,
             arXiv 2206.00364); DIAMOND's objective (arXiv 2405.12399)
    flow     the velocity from image to noise on a straight line (rectified flow, arXiv 2209.03003)
    refiner  the image from nothing, then again from itself and a little noise (PDE-Refiner, arXiv
             2308.05732): one step is regression, more are a diffusion of what regression left open

What an image is, a frame or the change since the last one, is the caller's affair. A network is any function
of x (B, C, H, W) and a label (B,): it knows already what it is conditioned on, and the label says how noisy x
is.

Shapes: B batch, C×H×W image.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

Network = Callable[[Tensor, Tensor], Tensor]
"""(x (B, C, H, W), label (B,)) → (B, C, H, W)."""

PREDICT = 1.0
"""Label of the refiner's first step, which starts from nothing; its others are c_noise, below 0.5."""


class Preconditioning(NamedTuple):
    """EDM's factors at a noise level, each (B, 1, 1, 1); `label`, c_noise, is (B,)."""

    skip: Tensor
    out: Tensor
    into: Tensor
    label: Tensor


def precondition(sigma: Tensor, sigma_data: float) -> Preconditioning:
    """EDM, table 1.

    Args:
        sigma: (B,) > 0, standard deviation of the noise.
        sigma_data: of the images.
    """
    wide = sigma[:, None, None, None]
    total = wide.square() + sigma_data**2
    return Preconditioning(
        skip=sigma_data**2 / total,
        out=wide * sigma_data / total.sqrt(),
        into=1 / total.sqrt(),
        label=sigma.log() / 4,
    )


def denoise(network: Network, x: Tensor, sigma: Tensor, sigma_data: float) -> Tensor:
    """D(x; σ), the estimate of the clean image."""
    at = precondition(sigma, sigma_data)
    return at.skip * x + at.out * network(at.into * x, at.label)


def edm_loss(network: Network, clean: Tensor, noise: Tensor, sigma: Tensor, sigma_data: float) -> Tensor:
    """Per image (B,): mean squared error of F, which is EDM's weighting of D's.

    Args:
        network: F.
        clean: (B, C, H, W).
        noise: (B, C, H, W) standard normal.
        sigma: (B,).
        sigma_data: of the images.
    """
    at = precondition(sigma, sigma_data)
    x = clean + sigma[:, None, None, None] * noise
    wanted = (clean - at.skip * x) / at.out
    return (network(at.into * x, at.label) - wanted).square().mean((1, 2, 3))


def edm_levels(steps: int, sigma_min: float, sigma_max: float, rho: float = 7.0) -> list[float]:
    """EDM's grid, falling from `sigma_max`, with the 0 it ends at: steps + 1 levels."""
    if steps == 1:
        return [sigma_max, 0.0]
    low, high = sigma_min ** (1 / rho), sigma_max ** (1 / rho)
    return [(high + i / (steps - 1) * (low - high)) ** rho for i in range(steps)] + [0.0]


def edm_sample(network: Network, noise: Tensor, levels: list[float], sigma_data: float) -> Tensor:
    """Euler's method from noise (B, C, H, W) of std 1 to an image; a network pass per level but the last."""
    x = levels[0] * noise
    for now, then in zip(levels, levels[1:], strict=False):
        clean = denoise(network, x, x.new_full((len(x),), now), sigma_data)
        x = clean if then == 0 else x + (then - now) / now * (x - clean)
    return x


def flow_loss(network: Network, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """Per image (B,): mean squared error of the velocity at x = (1 − t)·clean + t·noise; t in [0, 1]."""
    wide = t[:, None, None, None]
    x = (1 - wide) * clean + wide * noise
    return (network(x, t) - (noise - clean)).square().mean((1, 2, 3))


def flow_sample(network: Network, noise: Tensor, steps: int) -> Tensor:
    """Euler's method from noise at t = 1 to an image at t = 0."""
    x = noise
    for k in range(steps):
        t = 1 - k / steps
        x = x - network(x, x.new_full((len(x),), t)) / steps
    return x


def refiner_loss(
    network: Network, clean: Tensor, noise: Tensor, sigma: Tensor, predict: Tensor, sigma_data: float
) -> Tensor:
    """Per image (B,): where `predict`, bool (B,), the regression's error over `sigma_data`, else EDM's.

    Both parts come from one network pass.
    """
    at = precondition(sigma, sigma_data)
    chosen = predict[:, None, None, None]
    x = clean + sigma[:, None, None, None] * noise
    wanted = torch.where(chosen, clean / sigma_data, (clean - at.skip * x) / at.out)
    given = torch.where(chosen, 0.0, at.into * x)
    label = torch.where(predict, PREDICT, at.label)
    return (network(given, label) - wanted).square().mean((1, 2, 3))


def refiner_sample(network: Network, noise: Tensor, levels: list[float], sigma_data: float) -> Tensor:
    """Predicts from nothing, then refines at each of the falling `levels`; no level: regression alone.

    Args:
        network: F.
        noise: (B, len(levels), C, H, W) standard normal.
        levels: noise added before each refinement.
        sigma_data: of the images.
    """
    nothing = noise.new_zeros(len(noise), *noise.shape[2:])
    x = sigma_data * network(nothing, noise.new_full((len(noise),), PREDICT))
    for i, sigma in enumerate(levels):
        x = denoise(network, x + sigma * noise[:, i], noise.new_full((len(noise),), sigma), sigma_data)
    return x
