# SPDX-License-Identifier: Apache-2.0
"""How much of its actions can be read off what a world model dreams: an inverse-dynamics probe.

A small network learns, from real pairs of frames a chunk apart, what was done between them. Then it reads
real pairs that it has not seen, and dreams. What it reads off a dream is what a policy could learn from it.

Of the frames alone: the robot's state would tell nearly everything, and it is predicted apart from them. Of a
chunk the mean action: what its steps add up to is seen, in which order they were made is not.

    legibility     R² = 1 − Σ|read − given|² / Σ|given − mean|², in units of each action's usual spread

With the true actions even a model that ignores them is read well where the scene tells what anybody would do
there. So it is dreamt from the same places with another episode's actions, too, and the *change* of what is
read is held against the change of what was given: whatever the scene tells is in both, and falls out. A model
that does not listen dreams the same twice, and has exactly 0.

Shapes: B pairs, V cameras, H×W pixels, A action dims, M trials.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.world_model.config import InverseConfig
from accerl_lerobot.world_model.episodes import Episode, Place, cut
from accerl_lerobot.world_model.judge import Estimate, bootstrap

SIDE = 64
"""Height and width, in pixels, that larger frames are shrunk to."""
GRID = 4
"""Side of the map that is flattened: where something is matters."""
STILL = 1e-3
"""Standard deviation below which an action never varied, and nothing is read of it."""
BATCH = 256
"""Pairs read at once."""


class InverseProbe(nn.Module):
    """Reads the mean action of a chunk off the frames before and after it.

    Example:
        >>> probe = learn_probe(episodes, chunk=10, config=InverseConfig(), seed=0)
        >>> probe.read(before, after).shape
        (512, 4)

    Args:
        cameras: V.
        actions: A.
    """

    def __init__(self, cameras: int, actions: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.PixelUnshuffle(2)]
        into = 6 * 4 * cameras
        for width in (32, 64, 96):
            norm = nn.GroupNorm(math.gcd(width, 8), width)
            layers += [nn.Conv2d(into, width, 3, stride=2, padding=1), norm, nn.SiLU()]
            into = width
        self.convolutions = nn.Sequential(*layers)
        self.hidden = nn.Linear(into * GRID * GRID, 128)
        self.out = nn.Linear(128, actions)
        self.register_buffer("mean", torch.zeros(actions))
        self.register_buffer("std", torch.ones(actions))
        self.known: frozenset[int] = frozenset()
        """Tried episodes that it has learnt from: there it is not read."""

    def forward(self, before: Tensor, after: Tensor) -> Tensor:
        """Actions in units of their usual spread, (B, A), from frames uint8 (B, V, H, W, 3)."""
        first, second = (
            frames.float().movedim(-1, 2).flatten(1, 2) / 127.5 - 1 for frames in (before, after)
        )
        seen = torch.cat([first, second - first], 1)
        if max(seen.shape[2:]) > SIDE:
            seen = functional.interpolate(seen, size=(SIDE, SIDE), mode="area")
        seen = functional.adaptive_avg_pool2d(self.convolutions(seen), GRID).flatten(1)
        read: Tensor = self.out(functional.silu(self.hidden(seen)))
        return read

    @torch.no_grad()
    def read(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """float32 (M, A): mean actions in the world's units, of frames uint8 (M, V, H, W, 3)."""
        parts = [
            self(torch.from_numpy(before[i : i + BATCH]), torch.from_numpy(after[i : i + BATCH]))
            for i in range(0, len(before), BATCH)
        ]
        read: np.ndarray = (torch.cat(parts) * self.std + self.mean).numpy()
        return read

    def legibility(
        self, read: np.ndarray, given: np.ndarray, groups: np.ndarray, *, of_changes: bool = False
    ) -> Estimate:
        """R² of what was read, with its interval; NaN where nothing varied.

        Args:
            read: (M, A).
            given: (M, A), what was really done, or dreamt with.
            groups: (M,), the episode of each.
            of_changes: whether both are differences, whose mean is taken to be 0.
        """
        varied = self.std.numpy() > STILL
        scale = self.std.numpy()[varied]
        wrong = np.square((read - given)[:, varied] / scale).sum(1)
        given = given[:, varied] / scale

        def of(rows: np.ndarray) -> float:
            mean = 0.0 if of_changes else given[rows].mean(0)
            spread = float(np.square(given[rows] - mean).sum())
            return 1 - float(wrong[rows].sum()) / spread if spread > 0 else float("nan")

        return bootstrap(groups, of)


def learn_probe(
    episodes: Sequence[Episode],
    *,
    chunk: int,
    config: InverseConfig,
    seed: int,
    known: Collection[int] = (),
) -> InverseProbe | None:
    """Learns from every whole chunk of these episodes; equal arguments give equal probes.

    Args:
        episodes: to learn from.
        chunk: K.
        config: how.
        seed: of the weights and of what is drawn.
        known: see `InverseProbe.known`.

    Returns:
        None if no episode has a whole chunk.
    """
    at = [
        Place(e, f)
        for e, episode in enumerate(episodes)
        for f, time in enumerate(episode.times)
        if time + chunk in episode.times
    ]
    if not at:
        return None
    rng = np.random.default_rng((seed, 6))

    def pairs(chosen: np.ndarray) -> tuple[Tensor, Tensor, np.ndarray]:
        windows = cut(episodes, [at[i] for i in chosen], chunk=chunk, context=1, chunks=1)
        frames = torch.from_numpy(windows.frames)
        return frames[:, 0], frames[:, 1], windows.actions[:, 0].mean(1)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        probe = InverseProbe(episodes[0].frames.shape[1], episodes[0].actions.shape[1])
    starts = [(episodes[e].actions, int(episodes[e].times[f])) for e, f in at]
    done = np.stack([actions[t : t + chunk].mean(0) for actions, t in starts])
    probe.mean.copy_(torch.from_numpy(done.mean(0)))
    probe.std.copy_(torch.from_numpy(done.std(0)))
    probe.known = frozenset(known)
    optimizer = torch.optim.AdamW(probe.parameters(), lr=config.lr, weight_decay=1e-2)
    for step in range(config.steps):
        for group in optimizer.param_groups:
            group["lr"] = config.lr * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        before, after, given = pairs(rng.integers(len(at), size=config.batch))
        wanted = (torch.from_numpy(given) - probe.mean) / probe.std.clamp(min=STILL)
        loss = functional.mse_loss(probe(before, after), wanted)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return probe.eval().requires_grad_(False)
