# SPDX-License-Identifier: Apache-2.0
"""Settings of algorithms and of the trainer, and the inputs of objectives; free of torch.

So a run is parsed before torch is loaded. Shape letters: N decisions of a batch, L log-prob factors of one
decision, as its policy stores them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import draccus

from accerl_lerobot.config.ranges import (
    NonNegative,
    Positive,
    Range,
    Section,
    Share,
    Steps,
    Threads,
    registered_name,
)
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

Level = Literal["token", "chunk"]


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfig(Section, draccus.ChoiceRegistry, section="algorithm"):
    """Base of every algorithm config; subclasses register under the name given on the command line."""

    update: ClassVar[str]
    """``module:class`` of the trainer's updates, made from adapter, algorithm and `TrainerConfig`: a
    `ratio_update.RatioUpdate` or an `off_policy.OffPolicyUpdate`."""

    discover_packages_path: str | None = None
    """Package to import that registers ``algorithm.type``, where that is not one of ours."""
    gamma: Share = 0.99
    """Discount per decision (not per env step)."""

    type = registered_name


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(AlgorithmConfig):
    """Base of the algorithms that learn from a memory of all episodes and need no likelihood.

    `engines.config` and `run.preflight` refuse what does not go with it: segments that are not whole
    episodes, a decision that replay hands out twice, several ranks, imagined environments.
    """

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
    """Temperature in standard deviations of the advantage; ``inf`` weighs all decisions equally."""


@AlgorithmConfig.register_subclass("chunk_critic")
@dataclass(frozen=True, kw_only=True)
class ChunkCriticConfig(OffPolicyConfig):
    """Settings of off-policy learning from a critic over (state, executed chunk) and a teacher.

        critic   y = (1 − m)·[Σ_{j<n} γ^j r_j + γ^n (mean Q' − std Q')(s_n, μ(s_n))] + m·R  for each Q_i(s, c)
        teacher  L = E[(std Q − mean Q)(s, μ(s))] / E|Q| + ½·E_successes ‖μ(s) − c‖² / 0.3²
        policy   L = E[imitation loss of π(o) on μ(s)] + ½·E‖h(features(o)) − s‖²

    n is 4 decisions, m is ¼, s is the state of ``world_model.type``: the simulator's, which the policy never
    reads (asymmetric actor-critic, arXiv 1710.06542), or a latent one that is learned. The teacher μ is a
    small network of s, acts in half of the exploring episodes and labels every observation in memory (DAgger,
    arXiv 1011.0686); h is a linear map that exists only while training. Related: TD3+BC (arXiv 2106.06860),
    RLPD (2302.02948), Q-chunking (2507.07969).
    """

    update = "accerl_lerobot.algorithms.chunk_critic:ChunkCriticUpdate"

    gamma: Share = 0.98
    """Discount per decision."""
    critic_steps: Positive | None = None
    """Gradient steps of the critic for each new decision; the teacher makes half as many. None: 1 on the
    simulator's state, 0.5 on a state that is learned, where more had the critic learn episodes by heart."""


@dataclass(frozen=True, kw_only=True)
class LossInputs:
    """One batch of decisions, re-scored by the current policy."""

    log_prob_new: Tensor  # (N, L), log π of the stored latents under the current weights; carries gradient
    log_prob_old: Tensor  # (N, L), log μ as the behaviour policy stored it
    advantage: Tensor  # (N,), normalised over the batch by the caller
    value: Tensor  # (N,), V of the current critic; carries gradient
    returns: Tensor  # (N,), what V is regressed to
    entropy: Tensor  # (N,), entropy of π at each decision; carries gradient if it is to be used
    factors: Tensor
    """bool (N, L), False for a factor that does not exist, such as a token after the terminator; its content
    is never looked at."""
    ratios_per_decision: float | None = None
    """Mean number of ratios per decision of the batch that this one is a micro-batch of; with it the losses
    of micro-batches, weighted by their decisions, add up to that of the batch. None: this is all of it."""


@dataclass(frozen=True, kw_only=True)
class TrainerConfig(Section, section="trainer"):
    """How the policy is updated.

    The *version* of weights is the number of updates behind them; lag is counted in it.
    """

    updates: Steps = 1000
    """Updates of the run, by which its progress is measured. 0: the run evaluates its warm start alone."""
    batch_decisions: Annotated[int, Range("[1, 1000000]")] = 128
    """Decisions of one update; whole segments are drawn until there are at least as many."""
    micro_batch: Annotated[int, Range("[1, 1000000]")] = 1024
    """Decisions per backward pass of a rank; smaller saves memory, and costs algorithms with a likelihood
    ratio one more forward pass for the values."""
    lr: Annotated[float, Range("[0, 1)")] = 3e-5
    """Peak learning rate of the policy; 0 freezes it."""
    value_lr: Annotated[float, Range("[0, 1)")] = 1e-3
    """Peak learning rate of the critic head; with ``chunk_critic`` the constant rate of its critics."""
    warmup_updates: Steps = 20
    """Updates over which each rate rises linearly from 0: the critic's from the first update on, the policy's
    once `value_warmup_updates` are over."""
    final_lr_share: Share = 1.0
    """Share of the peak learning rate at the end: it falls there over `updates`, like a cosine, and stays
    there in the updates that a resumed run adds; 1: it is constant."""
    value_warmup_updates: Steps = 20
    """First updates, in which only the critic head learns: advantages of an untrained one are noise."""
    advantage_memory: Annotated[float, Range("[0, 1)")] = 0.0
    """Advantages are normalised by the moments of this batch and of those before it, of which each earlier
    one is weighted by this factor once more; 0: this batch alone. A small batch may hold nothing but
    failures. Its advantages are then the critic's noise, and their own deviation would amplify it."""
    grad_clip: Positive = 1.0
    """Largest gradient norm of the policy and, in algorithms with a likelihood ratio, of the critic head,
    each by itself."""
    betas: tuple[Annotated[float, Range("[0, 1)")], Annotated[float, Range("[0, 1)")]] = (0.9, 0.95)
    probe_every: Steps = 25
    """Updates between two measurements of the mismatch between acting and learning; 0: none. While it waits
    for one, the trainer holds a copy of the policy's weights."""
    num_threads: Threads = 1
    """CPU threads of each rank."""
    ranks: Annotated[int, Range("[1, 1024]")] = 1
    """Processes that make each update together, each from its part of the batch; on GPUs each has its own."""
    sharding: Literal["ddp", "zero2", "zero3"] = "ddp"
    """Part of the training state that each of several ranks keeps. ddp: everything. zero2: its part of
    weights, gradients and optimiser state, and all weights from an update's forward pass to the end of its
    backward pass. zero3: its part, and all weights of one block at a time (PyTorch's FSDP2)."""
    activation_checkpointing: bool = False
    """Repeated blocks of the network, a transformer's layers for instance, forget what they computed and
    compute it again for the gradient: less memory, about a third more work."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ranks > self.batch_decisions:
            hint = f"use at most trainer.batch_decisions, {self.batch_decisions}: a decision for each"
            raise InputError("trainer.ranks", self.ranks, hint)

    @property
    def zero(self) -> bool:
        """True if each rank keeps its part of the weights only."""
        return self.ranks > 1 and self.sharding != "ddp"

    def gpu_shares(self, gpus: float, others: int) -> tuple[float, float]:
        """Share of a GPU for each rank, and for each of the `others`, processes with a network.

        More than half a GPU each keeps two ranks off the same one, which NCCL refuses.
        """
        if not gpus:
            return 0.0, 0.0
        if self.ranks == 1:
            share = 1 / math.ceil((1 + others) / gpus)
            return share, share
        if self.ranks > gpus:
            without = f"{self.ranks} ranks on {gpus:g} GPUs leave {self.ranks - gpus:g} without"
            hint = f"each needs one, and {without}; use at most {gpus:g}, or policy.device=cpu"
            raise InputError("trainer.ranks", self.ranks, hint)
        if self.ranks == gpus:
            return 0.6, 0.4 / math.ceil(others / gpus)
        return 1.0, 1 / math.ceil(others / (gpus - self.ranks))

    def lr_share(self, update: int, start: int = 0) -> float:
        """Factor on a rate that begins with update `start`."""
        if update < start:
            return 0.0
        warm = start + self.warmup_updates
        if update < warm:
            return (update - start + 1) / self.warmup_updates
        done = min(1.0, (update - warm) / max(1, self.updates - warm))
        fall = 0.5 * (1 + math.cos(math.pi * done))
        return self.final_lr_share + (1 - self.final_lr_share) * fall
