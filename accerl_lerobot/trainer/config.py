# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Settings of the trainer; free of torch, so that a run is parsed before it is loaded."""

from __future__ import annotations

import math
from dataclasses import dataclass

from accerl_lerobot.errors import InputError

ZERO = ("zero2", "zero3")
"""Ways of sharing in which no rank keeps everything."""


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """How the policy is updated.

    The *version* of weights is the number of updates behind them; lag is counted in it.
    """

    updates: int = 1000
    """Optimiser steps of the run; the trainer is the run's clock. 0: the warm start, and what it is worth."""
    batch_decisions: int = 128
    """Decisions of one update; whole segments are drawn until there are at least as many."""
    micro_batch: int = 1024
    """Decisions per backward pass of a rank; smaller saves memory, and costs one more forward pass for the
    values."""
    lr: float = 1e-4
    """Peak learning rate of the policy, [0, 1); 0 freezes it."""
    value_lr: float = 1e-3
    """Peak learning rate of the critic head, [0, 1)."""
    warmup_updates: int = 20
    """Updates over which both rates rise linearly from 0."""
    schedule: str = "constant"
    """constant, or cosine: falls to `final_lr_share` of the peak over `updates`."""
    final_lr_share: float = 0.1
    value_warmup_updates: int = 20
    """First updates, in which only the critic head learns: advantages of an untrained one are noise.

    None with ``algorithm.advantage=group``, which asks no critic.
    """
    advantage_memory: float = 0.0
    """[0, 1). Advantages are normalised by the moments of this batch and of those before it, of which each
    earlier one is weighted by this factor once more; 0: this batch alone.

    A small batch may hold nothing but failures. Its advantages are then the critic's noise, which its own
    standard deviation would make as loud as any.
    """
    grad_clip: float = 1.0
    """Largest gradient norm; > 0."""
    weight_decay: float = 0.0
    betas: tuple[float, float] = (0.9, 0.95)
    publish_every: int = 1
    """Updates between two publications of the weights."""
    publish_changes: bool = False
    """Whether only the values that differ from the set before are sent, where that is less and the workers
    are on one machine. It pays where an update leaves most values as they are, as where little is trained at
    a time; an optimiser with momentum moves nearly every float32 value in every update."""
    hold_back: int = 0
    """Updates by which published weights are held back: lag on purpose, to study it; 0: none."""
    probe_every: int = 25
    """Updates between two measurements of the mismatch between acting and learning; 0: none.

    While it waits for one, the trainer holds a copy of the policy's weights.
    """
    max_nonfinite: int = 5
    """Updates with a non-finite loss or gradient are skipped and counted; so many in a row are an error."""
    num_threads: int = 1
    """CPU threads of each rank."""
    ranks: int = 1
    """Processes that make each update together, each from its part of the batch; on GPUs each has its own."""
    sharding: str = "none"
    """What of the training each of several ranks keeps. none: there is one rank. ddp: everything. zero2: its
    part of weights, gradients and optimiser state, and all weights from an update's forward pass to the end
    of its backward pass. zero3: its part, and all weights of one block at a time (PyTorch's FSDP2)."""
    cpu_offload: bool = False
    """With zero2 or zero3 on GPUs: a rank's part stays in the memory of the CPU, where the optimiser runs."""
    activation_checkpointing: bool = False
    """Repeated blocks of the network, a transformer's layers for instance, forget what they computed and
    compute it again for the gradient: less memory, about a third more work."""
    rank_timeout_s: float = 120.0
    """How long, in seconds, a rank waits for the others within an update; > 0. Then the trainer counts as
    lost."""

    def __post_init__(self) -> None:
        sizes = ("batch_decisions", "micro_batch", "publish_every", "max_nonfinite", "num_threads", "ranks")
        for name in sizes:
            if getattr(self, name) < 1:
                raise InputError(f"trainer.{name}", getattr(self, name), "use at least 1")
        for name in ("lr", "value_lr"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"trainer.{name}", getattr(self, name), "use a value in [0, 1), e.g. 1e-4")
        for name in (
            "updates", "warmup_updates", "value_warmup_updates", "weight_decay", "hold_back", "probe_every",
        ):  # fmt: skip
            if getattr(self, name) < 0:
                raise InputError(f"trainer.{name}", getattr(self, name), "use 0 or more")
        if self.schedule not in ("constant", "cosine"):
            raise InputError("trainer.schedule", self.schedule, "use constant or cosine")
        if not self.grad_clip > 0:
            raise InputError("trainer.grad_clip", self.grad_clip, "use a positive norm")
        if not 0 <= self.advantage_memory < 1:
            raise InputError("trainer.advantage_memory", self.advantage_memory, "use a value in [0, 1)")
        if not 0 <= self.final_lr_share <= 1:
            raise InputError("trainer.final_lr_share", self.final_lr_share, "use a share in [0, 1]")

        self._check_ranks()

    def _check_ranks(self) -> None:
        if self.sharding not in ("none", "ddp", *ZERO):
            raise InputError("trainer.sharding", self.sharding, "use none, ddp, zero2 or zero3")
        if self.ranks > 1 and self.sharding == "none":
            remedy = f"say how the {self.ranks} ranks share: ddp, zero2 or zero3"
            raise InputError("trainer.sharding", "none", remedy)
        if self.ranks == 1 and self.sharding != "none":
            raise InputError("trainer.sharding", self.sharding, "there is one rank: add --trainer.ranks=2")
        if self.ranks > self.batch_decisions:
            remedy = (
                f"use at most trainer.batch_decisions, {self.batch_decisions}: each rank needs a decision"
            )
            raise InputError("trainer.ranks", self.ranks, remedy)
        if self.cpu_offload and not self.zero:
            remedy = f"trainer.sharding={self.sharding} keeps everything on the device; use zero2 or zero3"
            raise InputError("trainer.cpu_offload", True, remedy)
        if not self.rank_timeout_s > 0:
            raise InputError(
                "trainer.rank_timeout_s", self.rank_timeout_s, "use a positive number of seconds"
            )

    @property
    def zero(self) -> bool:
        """Whether each rank keeps its part of the weights only."""
        return self.sharding in ZERO

    def publishes(self, version: int) -> bool:
        """Whether the weights of `version` are handed over."""
        return version % self.publish_every == 0 or version == self.updates

    def gpu_shares(self, gpus: float, others: int) -> tuple[float, float]:
        """What each rank, and each other process with a network, takes of a GPU.

        More than half a GPU each keeps two ranks off the same one, which NCCL refuses; where there are more
        GPUs than ranks, the others have those that are left.

        Args:
            gpus: how many there are; 0: all run on the CPU.
            others: processes with a network, beside the ranks.

        Raises:
            InputError: there are fewer GPUs than ranks.
        """
        if not gpus:
            return 0.0, 0.0
        if self.ranks == 1:
            share = 1 / math.ceil((1 + others) / gpus)
            return share, share
        if self.ranks > gpus:
            remedy = (
                f"each rank needs a GPU of its own, and {self.ranks} ranks on {gpus:g} GPUs leave "
                f"{self.ranks - gpus:g} without; use at most {gpus:g}, or policy.device=cpu"
            )
            raise InputError("trainer.ranks", self.ranks, remedy)
        if self.ranks == gpus:
            return 0.6, 0.4 / math.ceil(others / gpus)
        return 1.0, 1 / math.ceil(others / (gpus - self.ranks))

    def lr_share(self, update: int) -> float:
        """Factor on both learning rates at `update`, counted from 0."""
        if update < self.warmup_updates:
            return (update + 1) / self.warmup_updates
        if self.schedule == "constant":
            return 1.0
        done = min(1.0, (update - self.warmup_updates) / max(1, self.updates - self.warmup_updates))
        fall = 0.5 * (1 + math.cos(math.pi * done))
        return self.final_lr_share + (1 - self.final_lr_share) * fall
