# SPDX-License-Identifier: Apache-2.0
"""Tests that all flow policies share: the samplers, and the slow oracle on a policy's own velocity."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.flow import FlowFamily
from accerl_lerobot.policies.samplers import FlowSamplerConfig
from tests.policies import oracle


def samplers(euler: float) -> list[FlowSamplerConfig]:
    """All that flow policies share; `euler` is the noise level of that law, rounding is over it."""
    kinds = itertools.product(("last", "all", "one"), ("euler", "flow_sde"), ("joint", "analytic"))
    return [
        FlowSamplerConfig(
            stochastic=stochastic,
            noise=noise,
            noise_level=0.5 if noise == "flow_sde" else euler,
            padded=padded,
        )
        for stochastic, noise, padded in kinds
        if (stochastic, padded) != ("last", "analytic")  # the same sampler as joint
    ]


def name(config: FlowSamplerConfig) -> str:
    return f"{config.stochastic}-{config.noise}-{config.padded}"


def exploring(adapter: LeRobotAdapter, config: FlowSamplerConfig) -> LeRobotAdapter:
    """The same policy, exploring in another way."""
    family = FlowFamily(adapter.model, config)
    return LeRobotAdapter(
        adapter.policy, adapter.processing, adapter.model, family, adapter.value_head, adapter.precision
    )


def slow_log_prob(
    adapter: LeRobotAdapter,
    asked: Sequence[Request],
    latent: dict[str, Tensor],
    velocity: oracle.SlowVelocity | None = None,
) -> np.ndarray:
    """The oracle's log-prob (B, L) of stored latents; without `velocity`, each observation is read alone."""
    observations, tasks = stack_observations(asked)
    fields = [
        adapter.encode({k: v[i : i + 1] for k, v in observations.items()}, [tasks[i]]).context.velocity
        for i in range(len(asked))
    ]

    def slow(x: np.ndarray, t: float, sample: int) -> np.ndarray:
        with torch.no_grad():
            v = fields[sample](torch.from_numpy(x).float()[None], torch.tensor([t], dtype=torch.float32))
        return v[0].numpy().astype(np.float64)

    shape, config = adapter.family.shape, adapter.family.sampler
    index = np.asarray(latent["index"]) if "index" in latent else np.zeros(len(asked), int)
    path = np.full((len(asked), shape.num_steps + 1, shape.chunk_size, shape.padded_dim), np.nan)
    if config.stochastic == "all":
        path[:] = latent["path"]
    for b in range(len(asked)):
        if config.stochastic == "last":
            path[b, 0], path[b, -1] = latent["path"][b]
        if config.stochastic == "one":
            path[b, index[b]], path[b, index[b] + 1] = latent["path"][b]
    rows = shape.executed if config.stochastic == "last" else shape.chunk_size
    return oracle.log_prob(velocity or slow, path, index, shape, config)[:, :rows]
