# SPDX-License-Identifier: Apache-2.0
"""Settings of the trainer; free of torch, so that a run is parsed before it is loaded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from accerl_lerobot.config.ranges import Positive, Range, Section, Share, Steps, Threads
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class TrainerConfig(Section, section="trainer"):
    """How the policy is updated.

    The *version* of weights is the number of updates behind them; lag is counted in it.
    """

    updates: Steps = 1000
    """Optimiser steps of the run; the trainer is the run's clock. 0: the warm start, and what it is worth."""
    batch_decisions: Annotated[int, Range("[1, 1000000]")] = 128
    """Decisions of one update; whole segments are drawn until there are at least as many."""
    micro_batch: Annotated[int, Range("[1, 1000000]")] = 1024
    """Decisions per backward pass of a rank; smaller saves memory, and costs algorithms with a likelihood
    ratio one more forward pass for the values."""
    lr: Annotated[float, Range("[0, 1)")] = 3e-5
    """Peak learning rate of the policy; 0 freezes it."""
    value_lr: Annotated[float, Range("[0, 1)")] = 1e-3
    """Peak learning rate of the critic head."""
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
    failures; its advantages are then the critic's noise, which their own deviation would make loud."""
    grad_clip: Positive = 1.0
    """Largest gradient norm of the policy, and of the critic head, each by itself."""
    betas: tuple[Annotated[float, Range("[0, 1)")], Annotated[float, Range("[0, 1)")]] = (0.9, 0.95)
    hold_back: Steps = 0
    """Updates by which the acting policy's weights are held back: lag on purpose, to study it with
    ``launch.engine=local``; 0: none."""
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

    def lr_share(self, update: int, *, start: int = 0, updates: int | None = None) -> float:
        """Factor on a rate that begins with update `start` and falls over `updates`, or the config's."""
        if update < start:
            return 0.0
        warm = start + self.warmup_updates
        if update < warm:
            return (update - start + 1) / self.warmup_updates
        end = self.updates if updates is None else updates
        done = min(1.0, (update - warm) / max(1, end - warm))
        fall = 0.5 * (1 + math.cos(math.pi * done))
        return self.final_lr_share + (1 - self.final_lr_share) * fall
