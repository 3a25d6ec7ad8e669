# SPDX-License-Identifier: Apache-2.0
"""The network, its loss, and the interface of a LeRobot reward model.

Cameras share their convolutions, and their features are averaged, so a model serves any number of them.

Shapes: B batch, V cameras, C×H×W image.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.world_model.success_plugin.configuration_success_pairs import SuccessPairsConfig

IMAGES, REWARD, PAD = "observation.image", "next.reward", "_is_pad"
GRID, HIDDEN = 4, 128
"""Side of the feature map that is flattened, and width of the layer behind it."""
BATCH = 64
"""Pairs that are classified at once."""
SUCCESS_REWARD = 0.5
"""A ``next.reward`` above it is a success; datasets of ``accerl demos`` give 1."""
ALONE = 0.25
"""Share of pairs whose first frame is replaced by the second in training, so that the second frame is judged
and not their distance."""
NOISE, SHIFT = 0.03, 3
"""Largest standard deviation of the noise on frames in training, where 1 is white, and their largest shift in
pixels."""


class SuccessPairsRewardModel(PreTrainedRewardModel):
    """P(the second of two frames shows the task achieved), and the episode's progress by then."""

    config_class = SuccessPairsConfig
    name = "success_pairs"

    def __init__(self, config: SuccessPairsConfig, **unused: Any) -> None:
        super().__init__(config)
        layers: list[nn.Module] = [nn.PixelUnshuffle(2)]
        into = 6 * 4
        for width in config.channels:
            norm = nn.GroupNorm(math.gcd(width, 8), width)
            layers += [nn.Conv2d(into, width, 3, stride=2, padding=1), norm, nn.SiLU()]
            into = width
        self.convolutions = nn.Sequential(*layers)
        self.hidden = nn.Linear(into * GRID * GRID, HIDDEN)
        self.out = nn.Linear(HIDDEN, 2)

    def logits(self, before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
        """Success and progress, each (B,), from frames (B, V, 3, H, W) in [0, 1]."""
        pairs = 2 * torch.cat([before, after - before + 0.5], 2) - 1
        seen = self.convolutions(pairs.flatten(0, 1))
        seen = functional.adaptive_avg_pool2d(seen, GRID).flatten(1)
        features = functional.silu(self.hidden(seen)).unflatten(0, before.shape[:2]).mean(1)
        success, progress = self.out(features).unbind(1)
        return success, progress

    @torch.no_grad()
    def probabilities(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """float32 (M,): P that the second frames show a success; frames uint8 (M, V, H, W, 3)."""
        parts = [
            torch.sigmoid(self.logits(*(self.as_floats(x[i : i + BATCH]) for x in (before, after)))[0])
            for i in range(0, len(before), BATCH)
        ]
        return torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)

    def as_floats(self, frames: np.ndarray) -> Tensor:
        """uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1]."""
        return torch.from_numpy(frames).movedim(-1, 2).to(self.out.weight.device).float() / 255

    def loss(
        self,
        before: Tensor,
        after: Tensor,
        success: Tensor,
        progress: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy in which successes and failures of the batch weigh the same, on augmented frames.

        Frames are (B, V, 3, H, W) in [0, 1], success (B,) 0 or 1, progress (B,) in [0, 1] or NaN. The
        generator is that of the augmentation, on the CPU.
        """
        if self.training:
            before, after = self._augmented(before, after, generator)
        logits, along = self.logits(before, after)
        each = functional.binary_cross_entropy_with_logits(logits, success, reduction="none")
        total = each.new_zeros(())
        kinds = [kind for kind in (success > 0.5, success <= 0.5) if kind.any()]
        for kind in kinds:
            total = total + each[kind].mean() / len(kinds)
        metrics = {"accuracy": float(((logits > 0) == (success > 0.5)).float().mean())}
        if progress is not None and bool((known := ~progress.isnan()).any()):
            error = (torch.sigmoid(along[known]) - progress[known]).square().mean()
            total, metrics = total + error, metrics | {"progress": error.item()}
        return total, {"loss": total.item()} | metrics

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """LeRobot's training step; its batch holds pairs of frames and a chunk's rewards."""
        before, after = self._frames(batch)
        reward = batch[REWARD]
        pad = batch.get(REWARD + PAD)
        achieved = reward > SUCCESS_REWARD
        if pad is not None:
            achieved = achieved & ~pad
        return self.loss(before, after, achieved.reshape(len(reward), -1).any(1).float())

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """P(success), (B,), of the same batches, or of single frames, which stand for both."""
        success, _ = self.logits(*self._frames(batch))
        return torch.sigmoid(success)

    def _frames(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        keys = sorted(k for k in batch if k.startswith(IMAGES) and not k.endswith(PAD))
        images = torch.stack([batch[k] for k in keys], 1)
        images = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        if images.ndim == 5:  # one frame each
            return images, images
        return images[:, :, 0], images[:, :, -1]

    def _augmented(
        self, before: Tensor, after: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Shifts, lights and noises both frames of a pair alike."""
        b, (height, width) = len(before), before.shape[3:]
        both = torch.cat([before, after], 1).flatten(1, 2)
        # One shift for a batch is enough: there are many batches.
        y, x = torch.randint(2 * SHIFT + 1, (2,), generator=generator).tolist()
        padded = functional.pad(both, (SHIFT,) * 4, mode="replicate")
        both = padded[:, :, y : y + height, x : x + width]
        light = 1 + 0.1 * torch.randn(b, 1, 1, 1, generator=generator)
        level = NOISE * torch.rand(b, 1, 1, 1, generator=generator)
        noise = level * torch.randn(both.shape, generator=generator)
        both = both * light.to(both) + noise.to(both)
        first, second = both.clamp(0, 1).unflatten(1, (-1, 3)).chunk(2, 1)
        alone = torch.rand(b, 1, 1, 1, 1, generator=generator) < ALONE
        return torch.where(alone.to(both.device), second, first), second
