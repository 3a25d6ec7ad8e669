# SPDX-License-Identifier: Apache-2.0
"""Segments laid end to end, as one update sees them.

Shapes: S segments, N decisions in all, L log-prob factors of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.experience import Observations, Segment
from accerl_lerobot.policies.family import Latent


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Segments laid end to end: N rows of decisions, plus one bootstrap observation per segment."""

    observations: Observations  # each (N, ...)
    tasks: list[str]  # N
    latent: Latent  # each (N, ...)
    log_prob: Tensor  # (N, L) of the behaviour policy
    reward: Tensor  # (N,)
    version: np.ndarray  # int64 (N,)
    lengths: list[int]  # S
    terminated: Tensor  # bool (S,)
    last_observations: Observations  # each (S, ...)
    segment_tasks: list[str]  # S

    def __len__(self) -> int:
        return len(self.tasks)

    def part(self, rows: np.ndarray) -> tuple[Observations, list[str], Latent]:
        """Some of the decisions, as `PolicyAdapter.evaluate` takes them."""
        observations, tasks = pick(self.observations, self.tasks, rows)
        latent = {name: values[rows] for name, values in self.latent.items()}
        return observations, tasks, latent


def collate(segments: Sequence[Segment]) -> Batch:
    observations: Observations = {}
    last_observations: Observations = {}
    for name in segments[0].observations:
        observations[name] = np.concatenate([s.observations[name][:-1] for s in segments])
        last_observations[name] = np.stack([s.observations[name][-1] for s in segments])
    latent: Latent = {}
    for name in segments[0].latent:
        values = np.concatenate([s.latent[name] for s in segments])
        latent[name] = torch.from_numpy(values)
    tasks: list[str] = []
    for segment in segments:
        tasks += [segment.task] * len(segment)
    log_prob = np.concatenate([s.log_prob for s in segments])
    reward = np.concatenate([s.reward for s in segments])
    return Batch(
        observations=observations,
        tasks=tasks,
        latent=latent,
        log_prob=torch.from_numpy(log_prob),
        reward=torch.from_numpy(reward),
        version=np.concatenate([s.version for s in segments]),
        lengths=[len(s) for s in segments],
        terminated=torch.tensor([s.terminated for s in segments]),
        last_observations=last_observations,
        segment_tasks=[s.task for s in segments],
    )


def pick(
    observations: Observations, tasks: Sequence[str], rows: np.ndarray
) -> tuple[Observations, list[str]]:
    """Some rows of a batch of observations, and their tasks."""
    picked = {name: values[rows] for name, values in observations.items()}
    return picked, [tasks[row] for row in rows]
