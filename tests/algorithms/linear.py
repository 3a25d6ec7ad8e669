# SPDX-License-Identifier: Apache-2.0
"""A policy of a few numbers, and segments it could have made."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import Decision, Request, Segment
from accerl_lerobot.policies.adapter import Evaluation, PolicyAdapter
from tests.replay.segments import make_segment

STATE = "observation.state"
STD = 0.5


class LinearAdapter(PolicyAdapter):
    """Latent ~ N(W·state, STD²), two factors, one per latent entry; V = v·state + b.

    A latent with a ``count`` has only that many factors.
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.weight = nn.Parameter(0.3 * torch.randn(2, 3, generator=generator))
        self.value_head = nn.Linear(3, 1)
        with torch.no_grad():
            self.value_head.weight.copy_(torch.randn(1, 3, generator=generator))
            self.value_head.bias.fill_(0.3)
        self.device = torch.device("cpu")

    def factors(self, latent: dict[str, Tensor]) -> Tensor | None:
        return torch.arange(2) < latent["count"][:, None] if "count" in latent else None

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        raise NotImplementedError

    def evaluate(self, observations: Any, tasks: Sequence[str], latent: dict[str, Tensor]) -> Evaluation:
        assert len(tasks) == len(observations[STATE]) == len(latent["x"])
        state = torch.from_numpy(observations[STATE])
        z = (latent["x"] - state @ self.weight.T) / STD
        value = self.value_head(state)[:, 0]
        return Evaluation(log_prob=-0.5 * z * z, entropy=torch.zeros(len(state)), value=value)

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        assert len(tasks) == len(observations[STATE])
        return self.value_head(torch.from_numpy(observations[STATE]))[:, 0]

    def trainable(self) -> dict[str, nn.Parameter]:
        critic = {f"value_head.{k}": p for k, p in self.value_head.named_parameters()}
        return {"policy.weight": self.weight, **critic}

    def copy_weights(self) -> dict[str, Tensor]:
        return {k: p.detach().clone() for k, p in self.trainable().items()}

    def save(self, directory: Path, weights: dict[str, Tensor]) -> None:
        snapshot.save(directory / "linear", weights)


def decided_by(adapter: LinearAdapter, segments: Sequence[Segment], version: int) -> list[Segment]:
    """Stamps segments as decisions of these weights, log-probs included."""
    for segment in segments:
        observations = {k: v[:-1] for k, v in segment.observations.items()}
        latent = {k: torch.from_numpy(v) for k, v in segment.latent.items()}
        with torch.no_grad():
            scored = adapter.evaluate(observations, [segment.task] * len(segment), latent)
        segment.log_prob, segment.version = scored.log_prob.numpy(), np.full(len(segment), version)
    return list(segments)


def make_segments(lengths: Sequence[int], version: int = 0, seed: int = 0, **replace: Any) -> list[Segment]:
    """Segments with random content; log-probs are those of a policy a little off from the current one."""
    rng, made = np.random.default_rng(seed), []
    for i, n in enumerate(lengths):
        fields: dict[str, Any] = {
            "observations": {STATE: rng.standard_normal((n + 1, 3), dtype=np.float32)},
            "task": f"task {seed}.{i}",
            "latent": {"x": rng.standard_normal((n, 2), dtype=np.float32)},
            "log_prob": rng.standard_normal((n, 2), dtype=np.float32) - 2.0,
            "reward": rng.standard_normal(n, dtype=np.float32),
        }
        made.append(make_segment(f"{seed}.{i}", n, version, **fields | replace))
    return made
