# SPDX-License-Identifier: Apache-2.0
"""A policy made of nothing but time: it takes as long as it is told to, and its weights are two numbers.

What a service in front of an accelerator costs is slept, t(B) = a + bB for a batch of B, so that the
machinery around it is measured and not the processor that runs it. Densities, gradients and versions are
real.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.config.ranges import NonNegative, Range, Section
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.adapter import Evaluation, PolicyAdapter
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.family import normal_entropy, normal_log_prob
from accerl_lerobot.policies.features import STATE

STD = 0.3


@dataclass(frozen=True, kw_only=True)
class SimulatedPolicyConfig(Section, section="policy"):
    """How long it takes."""

    decide_ms: NonNegative = 8.0
    """a: milliseconds of a forward pass, whatever the batch."""
    decide_each_ms: NonNegative = 0.1
    """b: milliseconds more for each observation in it."""
    update_ms: NonNegative = 0.0
    """Milliseconds of an update."""
    chunk: Annotated[int, Range("[1, 100000]")] = 4
    """Actions of a decision."""
    action_dim: Annotated[int, Range("[1, 10000]")] = 2
    """At least 1."""


class SimulatedAdapter(PolicyAdapter):
    """u ~ N(g · target, 0.3²) around the target that a `SimulatedEnvironment` shows in its state; V is a
    number."""

    def __init__(self, config: SimulatedPolicyConfig) -> None:
        super().__init__()
        self.config = config
        self.device = torch.device("cpu")
        self.gain = nn.Parameter(torch.zeros(1))
        self.value_head = nn.Linear(1, 1)

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        c = self.config
        time.sleep((c.decide_ms + c.decide_each_ms * len(requests)) / 1000)
        gain = float(self.gain)
        decisions = []
        for request in requests:
            target = np.asarray(request.observation[STATE])[: c.action_dim]
            noise = np.random.default_rng(request.noise_seed).standard_normal((c.chunk, c.action_dim))
            u = (gain * target + STD * noise * request.explore).astype(np.float32)
            log_prob = -0.5 * np.square(noise).sum(1) - c.action_dim * np.log(STD * np.sqrt(2 * np.pi))
            decisions.append(
                Decision(chunk=u, latent={"u": u}, log_prob=log_prob.astype(np.float32), version=version)
            )
        return decisions

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        time.sleep(self.config.update_ms / 1000)
        target = torch.from_numpy(observations[STATE][:, : self.config.action_dim])
        mean = (self.gain * target)[:, None, :].expand_as(latent["u"])
        std = torch.full_like(mean, STD)
        return Evaluation(
            log_prob=normal_log_prob(latent["u"], mean, std).sum(-1),
            entropy=normal_entropy(std).sum((1, 2)),
            value=self._value(len(tasks)),
        )

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        return self._value(len(tasks))

    def trainable(self) -> dict[str, nn.Parameter]:
        return dict(self.named_parameters())

    def copy_weights(self) -> dict[str, np.ndarray]:
        return self.export_trainable()

    def save(self, directory: Path, weights: dict[str, np.ndarray]) -> None:
        snapshot.save(directory / "simulated", weights)

    def _value(self, rows: int) -> Tensor:
        return self.value_head(torch.zeros(rows, 1))[:, 0]


def load_simulated(simulated: SimulatedPolicyConfig, policy: PolicyConfig) -> SimulatedAdapter:
    """For `functools.partial`: an engine's `load`."""
    return SimulatedAdapter(simulated)
