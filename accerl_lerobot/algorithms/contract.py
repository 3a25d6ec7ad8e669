# SPDX-License-Identifier: Apache-2.0
"""Inputs and shared settings of all objectives.

Shape letters: N decisions of a batch, L log-prob factors of one decision, as its policy stores them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import draccus

from accerl_lerobot.config.ranges import NonNegative, Positive, Range, Section, Share, registered_name

if TYPE_CHECKING:
    from torch import Tensor

Level = Literal["token", "chunk"]


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfig(Section, draccus.ChoiceRegistry, section="algorithm"):
    """Base of every algorithm config; subclasses register under the name given on the command line."""

    update: ClassVar[str]
    """``module:class`` of the trainer's updates, made from adapter, algorithm and `TrainerConfig`: a
    `ratio_update.RatioUpdate` or an `off_policy.OffPolicyUpdate`."""

    discover_packages_path: str | None = field(default=None, metadata={"registers": True})
    """Package to import that registers ``algorithm.type``, where that is not one of ours."""
    gamma: Share = 0.99
    """Discount per decision (not per env step)."""

    type = registered_name


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(AlgorithmConfig):
    """Base of the algorithms that learn from a memory of all episodes and need no likelihood."""

    update = "accerl_lerobot.algorithms.off_policy:OffPolicyUpdate"

    policy_steps: NonNegative = 0.5
    """Gradient steps of the policy for each new decision, after ``trainer.value_warmup_updates``."""
    memory: Annotated[int, Range("[1000, 100000000]")] = 100_000
    """Decisions that the trainer remembers; the oldest leave first. With 64 pixels, 100,000 are 1.2 GB."""


@AlgorithmConfig.register_subclass("self_imitation")
@dataclass(frozen=True, kw_only=True)
class SelfImitationConfig(OffPolicyConfig):
    """Settings of self-imitation: without a critic, of the policy's own successful episodes as they come in.

    Rejection fine-tuning without rounds, or filtered behaviour cloning (related: arXiv 1806.05635).
    """


@AlgorithmConfig.register_subclass("awr")
@dataclass(frozen=True, kw_only=True)
class AWRConfig(OffPolicyConfig):
    """Settings of advantage-weighted regression (Peng et al., arXiv 1910.00177).

        w = min(exp((R − V(o)) / (beta · s)), 20)
        L = E[w · imitation loss]  +  E[(R − V(o))²]

    R is the discounted return of the episode from the decision on, s the standard deviation of R − V(o) of
    late. In place of −log π stands the loss that LeRobot trains the policy with.
    """

    update = "accerl_lerobot.algorithms.off_policy:AWRUpdate"

    beta: Annotated[float, Range("(0, inf]")] = 1.0
    """Temperature in standard deviations of the advantage; ``inf`` weighs all decisions alike."""


@AlgorithmConfig.register_subclass("chunk_critic")
@dataclass(frozen=True, kw_only=True)
class ChunkCriticConfig(OffPolicyConfig):
    """Settings of off-policy learning from a critic over (state, executed chunk) and a teacher.

        critic   y = (1 − m)·[Σ_{j<n} γ^j r_j + γ^n (mean Q' − std Q')(s_n, μ(s_n))] + m·R  for each Q_i(s, c)
        teacher  L = E[(std Q − mean Q)(s, μ(s))] / E|Q| + ½·E_successes ‖μ(s) − c‖² / 0.3²
        policy   L = E[imitation loss of π(o) on μ(s)] + ½·E‖h(features(o)) − s‖²

    n is 4 decisions, m is ¼, s is the state of ``world_model.type``: the simulator's, which the policy never
    reads (asymmetric actor-critic, arXiv 1710.06542), or a latent one that is learned. The teacher μ is a
    small network of s, acts in part of the exploring episodes and labels every observation in memory (DAgger,
    arXiv 1011.0686); h is a linear map that exists only while training. Related: TD3+BC (arXiv 2106.06860),
    RLPD (2302.02948), Q-chunking (2507.07969).
    """

    update = "accerl_lerobot.algorithms.chunk_critic:ChunkCriticUpdate"

    gamma: Share = 0.98
    """Discount per decision."""
    critic_steps: Positive | None = None
    """Gradient steps of the critic for each new decision; the teacher makes half as many. None: 1 on the
    simulator's state, 0.5 on a state that is learned, where more had the critic learn episodes by heart."""
    teacher_episodes: Share = 0.5
    """Share of exploring episodes in which the teacher acts, after ``trainer.value_warmup_updates``."""


@dataclass(frozen=True, kw_only=True)
class LossInputs:
    """One batch of decisions, re-scored by the current policy."""

    log_prob_new: Tensor  # (N, L), log π of the stored latents under the current weights; carries gradient
    log_prob_old: Tensor  # (N, L), log μ as the behaviour policy stored it
    advantage: Tensor  # (N,), normalised over the batch by the caller
    value: Tensor  # (N,), V of the current critic; carries gradient
    returns: Tensor  # (N,), what V is regressed to
    entropy: Tensor  # (N,), entropy of π at each decision; carries gradient if it is to be used
    factors: Tensor | None = None
    """bool (N, L), False for a factor that does not exist, such as a token after the terminator; its content
    is never looked at. None: all exist."""
    ratios_per_decision: float | None = None
    """Mean number of ratios per decision of the batch that this one is a micro-batch of; with it the losses
    of micro-batches, weighted by their decisions, add up to that of the batch. None: this is all of it."""
