# SPDX-License-Identifier: Apache-2.0
"""Do the process that acts and the one that learns agree on log-probs? Measured while both run.

At equal weights log π = log μ is what everything else relies on, but samples are always a few versions old.
So the trainer keeps a copy of one published version, waits for a batch with decisions of it, and scores those
under the copy: a difference is rounding, or a mistake. A version may never have acted, because inference
skipped it for a newer one: once most of a batch is newer, another one is taken.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.algorithms import ranks
from accerl_lerobot.algorithms.batch import Batch
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.checkpoint.tensors import copy_of, part_of
from accerl_lerobot.experience import Metrics
from accerl_lerobot.policies.adapter import PolicyAdapter

CRITIC_PREFIX = "value_head."  # how names of the critic's weights begin


class Probe:
    """One copy of the policy's trainable weights after the other, without the critic's."""

    def __init__(self, adapter: PolicyAdapter, config: TrainerConfig) -> None:
        self.adapter = adapter
        self._config = config
        self._live: list[nn.Parameter] = []
        for name, parameter in adapter.trainable().items():
            if not name.startswith(CRITIC_PREFIX):
                self._live.append(parameter)
        self._copy: list[Tensor] = []
        self._version: int | None = None  # version of the copy; None: there is none
        self._next = 0  # version from which on a copy is taken
        self.renew(0)

    def state(self) -> State:
        weights = [copy_of(tensor) for tensor in self._copy]
        return {"version": self._version, "next": self._next, "weights": weights}

    def restore(self, state: State) -> None:
        self._version = state["version"]
        self._next = state["next"]
        # There are no weights in the state where there was no copy.
        self._copy = [part_of(t, live) for t, live in zip(state["weights"], self._live, strict=False)]

    def renew(self, version: int) -> None:
        """Copy the weights of this version, if a copy is due."""
        every = self._config.probe_every
        if not every or version >= self._config.updates:
            return
        if self._version is None and version >= self._next:
            self._copy = [parameter.detach().clone() for parameter in self._live]
            self._version = version
            self._next = version + every

    def read(self, batch: Batch) -> Metrics:
        """The mismatch, if the batch holds decisions of the probed version; else nothing."""
        if self._version is None:
            return {}
        rows = np.flatnonzero(batch.version == self._version)
        skipped = np.median(batch.version) > self._version
        metrics: Metrics = {}
        if len(rows):
            self._exchange()
            try:
                apart = ranks.over_rows(partial(self._apart, batch), rows, self._config.micro_batch)
            finally:
                self._exchange()
            metrics["logprob/mismatch_mean"] = float(apart.mean())
            metrics["logprob/mismatch_max"] = float(apart.max())
        elif skipped:
            self._next = 0
        else:
            return {}
        self._copy = []
        self._version = None
        return metrics

    @torch.no_grad()
    def _apart(self, batch: Batch, rows: np.ndarray) -> Tensor:
        """|Σ log π − Σ log μ| of each row, float64, with π of the copy."""
        observations, tasks, latent = batch.part(rows)
        log_prob = self.adapter.evaluate(observations, tasks, latent).log_prob.cpu()
        difference = log_prob - batch.log_prob[rows]
        factors = self.adapter.factors(latent)
        if factors is not None:
            difference = difference.masked_fill(~factors.cpu(), 0.0)
        return difference.double().sum(dim=-1).abs()

    @torch.no_grad()
    def _exchange(self) -> None:
        """Swap the values of the live weights and of the copy."""
        for parameter, tensor in zip(self._live, self._copy, strict=True):
            held = parameter.detach().clone()
            parameter.copy_(tensor)
            tensor.copy_(held)
        for module in self.adapter.modules():
            if hasattr(module, "reshard"):  # FSDP may have gathered the values of before
                module.reshard()
