# SPDX-License-Identifier: Apache-2.0
"""The success model, a LeRobot reward model: did a chunk achieve the task, and how far along is it?

A convolutional network of 0.3 million weights looks at the frames before and after a chunk and knows the
task, so that one serves several tasks of a scene. Cameras share their convolutions, and their features are
averaged, so it serves any number of them.

Shapes: B batch, V cameras, C×H×W image; tasks are (B, 16), see `experience.task_codes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, TASK_BITS, task_codes

IMAGES = "observation.image"
GRID, HIDDEN = 4, 128  # side of the feature map that is flattened, and width of the layer behind it
BATCH = 64  # pairs that are classified at once
ALONE = 0.25
"""Share of pairs whose first frame is replaced by the second in training, so that the second frame is judged
and not their distance."""
NOISE, SHIFT = 0.03, 3
"""Noise on frames in training, its largest std where 1 is white, and their largest shift in pixels."""


@RewardModelConfig.register_subclass("success_pairs")
@dataclass
class SuccessPairsConfig(RewardModelConfig):
    """Inputs and sizes of the success model."""

    chunk: int = 10
    """Env steps between the two frames."""
    channels: tuple[int, ...] = (32, 64, 96)
    """Channels of the convolutions, each of which halves the image; the first one does so twice."""
    threshold: float = 0.5
    """P above which a frame counts as a success, in [0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chunk < 1:
            raise InputError("reward_model.chunk", self.chunk, "use at least 1")
        if not 0 <= self.threshold <= 1:
            raise InputError("reward_model.threshold", self.threshold, "use a value in [0, 1]")
        if not self.channels or min(self.channels) < 1:
            raise InputError("reward_model.channels", self.channels, "name at least one width")


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
        self.hidden = nn.Linear(into * GRID * GRID + TASK_BITS, HIDDEN)
        self.out = nn.Linear(HIDDEN, 2)

    def logits(self, before: Tensor, after: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Success and progress, each (B,), from frames (B, V, 3, H, W) in [0, 1]."""
        pairs = 2 * torch.cat([before, after - before + 0.5], 2) - 1
        seen = self.convolutions(pairs.flatten(0, 1))
        seen = functional.adaptive_avg_pool2d(seen, GRID).flatten(1).unflatten(0, before.shape[:2])
        seen = torch.cat([seen, task[:, None].expand(-1, seen.shape[1], -1)], -1)
        features = functional.silu(self.hidden(seen)).mean(1)
        success, progress = self.out(features).unbind(1)
        return success, progress

    @torch.no_grad()
    def probabilities(self, before: np.ndarray, after: np.ndarray, task: np.ndarray) -> np.ndarray:
        """float32 (M,): P that the second frames show a success; frames uint8 (M, V, H, W, 3)."""
        parts = [
            torch.sigmoid(self.logits(*self.inputs(*(x[i : i + BATCH] for x in (before, after, task))))[0])
            for i in range(0, len(before), BATCH)
        ]
        return torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)

    def inputs(self, before: np.ndarray, after: np.ndarray, task: np.ndarray) -> tuple[Tensor, ...]:
        """Frames uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1], and tasks, on its device."""
        x, y, code = (torch.from_numpy(each).to(self.out.weight.device) for each in (before, after, task))
        return x.movedim(-1, 2).float() / 255, y.movedim(-1, 2).float() / 255, code

    def loss(
        self,
        before: Tensor,
        after: Tensor,
        task: Tensor,
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
        logits, along = self.logits(before, after, task)
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

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """P(success), (B,), of LeRobot's batches: ``task``, B instructions, and pairs of frames, or single
        frames, which stand for both.
        """
        images = torch.stack([batch[key] for key in sorted(batch) if key.startswith(IMAGES)], 1)
        images = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        before, after = (images, images) if images.ndim == 5 else (images[:, :, 0], images[:, :, -1])
        task = torch.from_numpy(task_codes(batch[TASK])).to(images.device)
        return torch.sigmoid(self.logits(before, after, task)[0])

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
