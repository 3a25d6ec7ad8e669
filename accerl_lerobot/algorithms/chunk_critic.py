# SPDX-License-Identifier: Apache-2.0
"""Off-policy learning of chunks from a critic over (simulator state, executed chunk): the settings.

    critic   y = (1 − m)·[Σ_{j<n} γ^j r_j + γ^n min_{i∈2} Q'_i(s_n, π(o_n))] + m·R    for each Q_i(s, c)
    policy   L = E[(k·std_i Q_i − mean_i Q_i)(s, π(o)) / scale + a·‖π(o) − c̄‖² / 0.3²] + b·L_imitation

s is what the simulator says of itself, ``observation.environment_state``; only the critic reads it, so the
checkpoint stays a policy of pixels (asymmetric actor-critic, arXiv 1710.06542). π(o) is the chunk without
exploration from a fixed noise, differentiable through all denoising steps, and c̄ the chunk that the policy
proposed for the same observation and noise a while ago: without that term the policy leaves what the critic
knows, and collapses. R is the discounted return that was observed, and *scale* its mean, so that rare success
is not outweighed by the distance. What is imitated are own successes. Related: TD3+BC (arXiv 2106.06860),
RLPD (2302.02948), Q-chunking (2507.07969).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, OffPolicyConfig
from accerl_lerobot.config.ranges import NonNegative, Positive, Range, Share


@AlgorithmConfig.register_subclass("chunk_critic")
@dataclass(frozen=True, kw_only=True)
class ChunkCriticConfig(OffPolicyConfig):
    """Settings of the off-policy chunk critic.

    Every decision is learnt from many times, out of a memory in the trainer; so one success moves the policy
    more than a likelihood ratio could. Needs ``env.environment_state``.
    """

    gamma: Share = 0.98
    """Discount per decision."""
    n_step: Annotated[int, Range("[1, 1000]")] = 4
    """Decisions ahead after which the critic's target bootstraps."""
    monte_carlo: Share = 0.25
    """Share of the observed return in the critic's target."""
    critic_steps: Positive = 1.0
    """Gradient steps of the critic for each new decision."""
    pessimism: NonNegative = 1.0
    """Standard deviations of the ensemble that are taken off Q."""
    anchor: NonNegative = 1.0
    """Weight of the squared distance from the chunk that the policy proposed a while ago."""
    imitation: NonNegative = 0.4
    """Weight of the imitation loss on own successes."""
