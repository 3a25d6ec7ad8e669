# SPDX-License-Identifier: Apache-2.0
"""Off-policy learning from a critic over (simulator state, executed chunk) and a teacher: the settings.

    critic   y = (1 − m)·[Σ_{j<n} γ^j r_j + γ^n (mean Q' − std Q')(s_n, μ(s_n))] + m·R   for each Q_i(s, c)
    teacher  L = E[(std Q − mean Q)(s, μ(s))] / E|Q| + ½·E_successes ‖μ(s) − c‖² / 0.3²
    policy   L = E[imitation loss of π(o) on μ(s)] + ½·E‖h(features(o)) − s‖²

n is 4 decisions and m is ¼. s is the state of the simulator, ``observation.environment_state``; the policy
never reads it, so the checkpoint stays a policy of images (asymmetric actor-critic, arXiv 1710.06542). The
teacher μ is a small network of s, acts in part of the exploring episodes, and labels every observation in
the memory, the policy's own too (DAgger, arXiv 1011.0686). h is a linear map that exists only while training.
Related: TD3+BC (arXiv 2106.06860), RLPD (2302.02948), Q-chunking (2507.07969).
"""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.algorithms.contract import AlgorithmConfig, OffPolicyConfig
from accerl_lerobot.config.ranges import Positive, Share


@AlgorithmConfig.register_subclass("chunk_critic")
@dataclass(frozen=True, kw_only=True)
class ChunkCriticConfig(OffPolicyConfig):
    """Settings of the off-policy chunk critic.

    Every decision is learnt from many times, out of a memory in the trainer; so one success moves the policy
    more than a likelihood ratio could. Needs ``env.environment_state``.
    """

    update = "accerl_lerobot.trainer.chunk_critic:ChunkCriticUpdate"

    gamma: Share = 0.98
    """Discount per decision."""
    critic_steps: Positive = 2.0
    """Gradient steps of the critic for each new decision; the teacher makes half as many."""
    teacher_episodes: Share = 0.5
    """Share of exploring episodes in which the teacher acts, after ``trainer.value_warmup_updates``."""
