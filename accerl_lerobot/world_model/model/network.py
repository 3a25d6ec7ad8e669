# SPDX-License-Identifier: Apache-2.0
"""The network of the pixel world models, and three image objectives as pure functions of a network.

    edm      D(x; σ) = c_skip·x + c_out·F(c_in·x; c_noise), the clean image from a noisy one (Karras et al.,
             arXiv 2206.00364); DIAMOND's objective (arXiv 2405.12399)
    flow     the velocity from image to noise on a straight line (rectified flow, arXiv 2209.03003)
    refiner  the image from nothing, then again from itself and a little noise (PDE-Refiner, arXiv
             2308.05732): one step is regression, more are a diffusion of what regression left open

For the objectives an image may be a frame or a change of it, and a network is any function of x (B, C, H, W)
and a label (B,) that says how noisy x is.

The network is a small U-Net that sees frames, a chunk and the robot's state. Space-to-depth keeps it cheap on
a CPU: pixels move into channels before the first convolution, so no layer works at full resolution. The chunk
enters twice, through adaptive norms and as planes beside the image; with the norms alone, small diffusion
models ignore it. The last layers start at zero, so an untrained model predicts no change.

Shapes: B batch, C×H×W image, S state dims, K actions per chunk, A action dims.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.world_model.config import NetworkConfig

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
    """EDM, table 1, at noise of standard deviation `sigma` (B,) > 0."""
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
    """Per image (B,): mean squared error of F, which is EDM's weighting of D's; standard normal noise."""
    at = precondition(sigma, sigma_data)
    x = clean + sigma[:, None, None, None] * noise
    target = (clean - at.skip * x) / at.out
    return (network(at.into * x, at.label) - target).square().mean((1, 2, 3))


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
    target = torch.where(chosen, clean / sigma_data, (clean - at.skip * x) / at.out)
    given = torch.where(chosen, 0.0, at.into * x)
    label = torch.where(predict, PREDICT, at.label)
    return (network(given, label) - target).square().mean((1, 2, 3))


def refiner_sample(network: Network, noise: Tensor, levels: list[float], sigma_data: float) -> Tensor:
    """Predicts from nothing, then refines at each of the falling `levels`; no level: regression alone.

    Args:
        noise: (B, len(levels), C, H, W) standard normal.
        levels: noise added before each refinement.
    """
    nothing = noise.new_zeros(len(noise), *noise.shape[2:])
    x = sigma_data * network(nothing, noise.new_full((len(noise),), PREDICT))
    for i, sigma in enumerate(levels):
        x = denoise(network, x + sigma * noise[:, i], noise.new_full((len(noise),), sigma), sigma_data)
    return x


class Denoiser(nn.Module):
    """(noisy image, label | frames, chunk, state) → image.

    Args:
        image: channels of the image that is made.
        frames: channels of the frames it is conditioned on.
        action: numbers that describe a chunk.
        state: S; 0: none.
        config: size of the network.
    """

    def __init__(self, image: int, frames: int, action: int, state: int, config: NetworkConfig) -> None:
        super().__init__()
        self.config, width = config, config.condition
        pixels = config.space_to_depth**2
        self.label = Fourier(width)
        self.chunk = nn.Sequential(nn.Linear(action, width), nn.SiLU(), nn.Linear(width, width))
        self.state = nn.Linear(state, width) if state else None
        self.mix = nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.plane = nn.Linear(action, config.planes) if config.planes else None
        first = config.channels[0]
        self.enter = nn.Conv2d((image + frames) * pixels + config.planes, first, 3, padding=1)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        here = first
        for level, there in enumerate(config.channels):
            steps = nn.ModuleList()
            if level:
                steps.append(nn.Conv2d(here, there, 3, stride=2, padding=1))
            steps.extend(Block(there, there, width) for _ in range(config.blocks))
            self.down.append(steps)
            here = there
        self.middle = nn.ModuleList([Block(here, here, width), Attention(here), Block(here, here, width)])
        for level, there in reversed(list(enumerate(config.channels))):
            steps = nn.ModuleList([Block(here + there, there, width)])
            steps.extend(Block(there, there, width) for _ in range(config.blocks - 1))
            if level:
                steps.append(nn.Conv2d(there, config.channels[level - 1], 3, padding=1))
            self.up.append(steps)
            here = config.channels[level - 1] if level else there
        self.leave = nn.Sequential(_norm(first), nn.SiLU(), nn.Conv2d(first, image * pixels, 3, padding=1))
        _zero(self.leave[-1])

    def forward(
        self, x: Tensor, label: Tensor, frames: Tensor, chunk: Tensor, state: Tensor | None
    ) -> Tensor:
        """(B, image, H, W), zero everywhere before training.

        Args:
            x: (B, image, H, W).
            label: (B,), how noisy x is.
            frames: (B, frames, H, W).
            chunk: (B, action).
            state: (B, S), if the network was built for one.
        """
        condition = self.label(label) + self.chunk(chunk)
        if self.state is not None and state is not None:
            condition = condition + self.state(state)
        condition = self.mix(condition)
        h = functional.pixel_unshuffle(torch.cat([x, frames], 1), self.config.space_to_depth)
        if self.plane is not None:
            planes = self.plane(chunk)[:, :, None, None].expand(-1, -1, *h.shape[2:])
            h = torch.cat([h, planes], 1)
        h = self.enter(h)
        kept = []
        for level in self.down:
            for step in level:
                h = step(h, condition) if isinstance(step, Block) else step(h)
            kept.append(h)
        for step in self.middle:
            h = step(h, condition) if isinstance(step, Block) else step(h)
        for level in self.up:
            h = torch.cat([h, kept.pop()], 1)
            for step in level:
                if isinstance(step, Block):
                    h = step(h, condition)
                else:
                    h = step(functional.interpolate(h, scale_factor=2.0, mode="nearest"))
        return functional.pixel_shuffle(self.leave(h), self.config.space_to_depth)


class Block(nn.Module):
    """Two convolutions with adaptive group norms and a skip connection; starts as the identity."""

    def __init__(self, into: int, out: int, condition: int) -> None:
        super().__init__()
        self.skip = nn.Conv2d(into, out, 1) if into != out else nn.Identity()
        self.norms = nn.ModuleList([_norm(into, affine=False), _norm(out, affine=False)])
        self.convs = nn.ModuleList([nn.Conv2d(i, out, 3, padding=1) for i in (into, out)])
        self.adapt = nn.ModuleList([nn.Linear(condition, 2 * i) for i in (into, out)])
        _zero(self.convs[1])

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, into, H, W) to (B, out, H, W)."""
        h = x
        for norm, conv, adapt in zip(self.norms, self.convs, self.adapt, strict=True):
            scale, shift = adapt(condition)[:, :, None, None].chunk(2, 1)
            h = conv(functional.silu(norm(h) * (1 + scale) + shift))
        return self.skip(x) + h


class Attention(nn.Module):
    """Self-attention over positions, in heads of 32 channels or fewer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = max(1, width // 32)
        while width % self.heads:
            self.heads -= 1
        self.norm = _norm(width)
        self.into, self.out = nn.Conv2d(width, 3 * width, 1), nn.Conv2d(width, width, 1)
        _zero(self.out)

    def forward(self, x: Tensor) -> Tensor:
        """(B, width, H, W) to the same."""
        b, c, h, w = x.shape
        parts = self.into(self.norm(x)).view(b, 3, self.heads, c // self.heads, h * w).transpose(3, 4)
        mixed = functional.scaled_dot_product_attention(*parts.unbind(1))
        return x + self.out(mixed.transpose(2, 3).reshape(b, c, h, w))


class Fourier(nn.Module):
    """A number as sines and cosines of fixed random frequencies, and a linear layer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.register_buffer("frequencies", torch.randn(32, generator=generator))
        self.out = nn.Linear(64, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B,) to (B, width)."""
        angles = 2 * math.pi * x[:, None] * self.frequencies
        return self.out(torch.cat([angles.cos(), angles.sin()], 1))


def _norm(channels: int, *, affine: bool = True) -> nn.GroupNorm:
    return nn.GroupNorm(math.gcd(channels, 8), channels, affine=affine)


def _zero(layer: nn.Module) -> None:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
