# SPDX-License-Identifier: Apache-2.0
"""The network of the pixel world models: a small U-Net that sees frames, a chunk and the robot's state.

What keeps it cheap on a CPU is space-to-depth: pixels move into channels before the first convolution, so no
layer works at full resolution. The chunk enters twice, through adaptive norms and as planes beside the image;
with the norms alone, small diffusion models ignore it. The last layers start at zero, and so the model does
at "nothing changes".

Shapes: B batch, C×H×W image, S state dims, K actions per chunk, A action dims.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.world_model.config import NetworkConfig


class Denoiser(nn.Module):
    """(noisy image, label | frames, chunk, state) → image, and what to make of the scene.

    Args:
        image: channels of the image that is made.
        frames: channels of the frames it is conditioned on.
        action: numbers in a chunk, K·A and whatever else is said of it.
        state: S; 0: none.
        config: its size.
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
        self.width = config.channels[-1] + width
        """Width of the summary."""

    def forward(
        self, x: Tensor, label: Tensor, frames: Tensor, chunk: Tensor, state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """One pass.

        Args:
            x: (B, image, H, W).
            label: (B,), how noisy x is.
            frames: (B, frames, H, W).
            chunk: (B, action).
            state: (B, S), if the network was built for one.

        Returns:
            (B, image, H, W), zero everywhere before training, and a summary (B, width) of scene and chunk.
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
        summary = torch.cat([h.mean((2, 3)), condition], 1)
        for level in self.up:
            h = torch.cat([h, kept.pop()], 1)
            for step in level:
                if isinstance(step, Block):
                    h = step(h, condition)
                else:
                    h = step(functional.interpolate(h, scale_factor=2.0, mode="nearest"))
        return functional.pixel_shuffle(self.leave(h), self.config.space_to_depth), summary


class Block(nn.Module):
    """Two convolutions with adaptive group norms, added to what came in; starts as the identity."""

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
    """Every place looks at every other; heads of 32 channels or fewer."""

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
