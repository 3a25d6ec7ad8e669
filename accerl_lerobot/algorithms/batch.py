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
    lengths: Tensor  # int64 (S,)
    terminated: Tensor  # bool (S,)
    last_observations: Observations  # each (S, ...)
    segment_tasks: list[str]  # S

    def __len__(self) -> int:
        return len(self.tasks)

    def part(self, rows: np.ndarray) -> tuple[Observations, list[str], Latent]:
        """Some of the decisions, as `PolicyAdapter.evaluate` takes them."""
        return *pick(self.observations, self.tasks, rows), {k: v[rows] for k, v in self.latent.items()}


def collate(segments: Sequence[Segment]) -> Batch:
    keys = segments[0].observations.keys()
    names = segments[0].latent.keys()
    return Batch(
        observations={k: np.concatenate([s.observations[k][:-1] for s in segments]) for k in keys},
        tasks=[s.task for s in segments for _ in range(len(s))],
        latent={k: torch.from_numpy(np.concatenate([s.latent[k] for s in segments])) for k in names},
        log_prob=torch.from_numpy(np.concatenate([s.log_prob for s in segments])),
        reward=torch.from_numpy(np.concatenate([s.reward for s in segments])),
        version=np.concatenate([s.version for s in segments]),
        lengths=torch.tensor([len(s) for s in segments]),
        terminated=torch.tensor([s.terminated for s in segments]),
        last_observations={k: np.stack([s.observations[k][-1] for s in segments]) for k in keys},
        segment_tasks=[s.task for s in segments],
    )


def pick(
    observations: Observations, tasks: Sequence[str], rows: np.ndarray
) -> tuple[Observations, list[str]]:
    return {k: v[rows] for k, v in observations.items()}, [tasks[i] for i in rows]
