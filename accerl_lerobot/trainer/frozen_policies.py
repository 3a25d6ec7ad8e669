# SPDX-License-Identifier: Apache-2.0
"""Frozen copies of the policy's weights, and log-probs under them.

``reference``  the weights that RL began with, for KL(π‖π_ref)
``proximal``   those of a few updates ago, for decoupled PPO
``probe``      those of one published version, see `probe`

A copy holds the policy's trainable weights, not the critic's, on the same device and in the same parts.
Nobody pays for a copy that nobody takes.

Do the process that acts and the one that learns agree on log-probs? Measured while both run.

At equal weights log π = log μ is what everything else relies on. The two are never at equal weights when it
could be compared, because samples are always a few versions old. So the trainer keeps a copy of one published
version, waits for a batch with decisions of that version, scores those under the copy, and reports

    logprob/mismatch_mean    mean of |Σ log π − Σ log μ| over these decisions, in nats
    logprob/mismatch_max     the largest
    logprob/mismatch_clip    share of them whose ratio is outside 1 ± 0.2

which is rounding, or a mistake. Version 0 is equal everywhere at the start and is the first to be probed. A
version may never have acted, because inference skipped it for a newer one: once most of a batch is newer,
another one is taken. That is after `replay.max_lag` updates at the latest.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.checkpoint.tensors import part_of, whole
from accerl_lerobot.policies.adapter import PolicyAdapter
from accerl_lerobot.trainer.batch import Batch
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.ranks import Ranks
from accerl_lerobot.trainer.sharding import swapped_in

CRITIC = "value_head."
"""How names of the critic's weights begin."""


class FrozenPolicies:
    """Copies by name.

    Args:
        adapter: the policy that is being trained.

    Example:
        >>> frozen = FrozenPolicies(adapter)
        >>> frozen.take("reference", version=0)
        >>> frozen.log_prob("reference", *batch.part(rows))  # (rows, L), of version 0 for ever
    """

    def __init__(self, adapter: PolicyAdapter) -> None:
        self.adapter = adapter
        self._live = [p for name, p in adapter.trainable().items() if not name.startswith(CRITIC)]
        self._copies: dict[str, tuple[int, list[Tensor]]] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._copies

    def take(self, name: str, version: int) -> None:
        """Keeps the weights of now, in place of an older copy of that name.

        Args:
            name: of the copy.
            version: of the weights; copies of the same version share their memory.
        """
        same = [tensors for number, tensors in self._copies.values() if number == version]
        self._copies.pop(name, None)  # before its successor is made, not after
        self._copies[name] = version, same[0] if same else [p.detach().clone() for p in self._live]

    def drop(self, name: str) -> None:
        """Frees a copy."""
        del self._copies[name]

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        return {"named": {name: version for name, (version, _) in self._copies.items()}} | {
            "weights": {
                version: [whole(t.detach()).clone() for t in kept] for version, kept in self._copies.values()
            }
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        weights = {
            version: [part_of(t, live) for t, live in zip(kept, self._live, strict=True)]
            for version, kept in state["weights"].items()
        }
        self._copies = {name: (version, weights[version]) for name, version in state["named"].items()}

    @torch.no_grad()
    def log_prob(
        self, name: str, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Tensor:
        """log-probs (B, L) of stored latents under a copy, without gradient.

        Args:
            name: of the copy.
            observations: each (B, ...).
            tasks: B instruction texts.
            latent: each (B, ...).
        """
        with swapped_in(self.adapter, self._live, self._copies[name][1]):
            return self.adapter.evaluate(observations, tasks, latent).log_prob


PROBE = "probe"
CLIP = 0.2
"""PPO's usual range: a mismatch outside it would be clipped as if the policy had moved."""


class Probe:
    """One copy after the other.

    Args:
        frozen: where the copy is kept.
        config: how often, and which versions are published.
        ranks: who measure together; None: this process alone.
    """

    def __init__(self, frozen: FrozenPolicies, config: TrainerConfig, ranks: Ranks | None = None) -> None:
        self._frozen, self._config, self._ranks = frozen, config, ranks or Ranks()
        self._version: int | None = None
        self._next = 0
        self.renew(0)

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; the copy itself is in `frozen_policies`."""
        return {"version": self._version, "next": self._next}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._version, self._next = state["version"], state["next"]

    def renew(self, version: int) -> None:
        """Takes a copy if it is time for one.

        Args:
            version: of the weights, which have just been made.
        """
        config = self._config
        due = config.probe_every and self._version is None and version >= self._next
        if due and config.publishes(version) and version < config.updates:
            self._frozen.take(PROBE, version)
            self._version, self._next = version, version + config.probe_every

    def read(self, batch: Batch) -> dict[str, float]:
        """The mismatch, if the batch holds decisions of the probed version; else nothing."""
        if self._version is None:
            return {}
        rows = np.flatnonzero(batch.version == self._version)
        if len(rows):
            metrics = self._measure(batch, rows)
        elif np.median(batch.version) > self._version:
            metrics, self._next = {}, 0
        else:
            return {}
        self._frozen.drop(PROBE)
        self._version = None
        return metrics

    def _measure(self, batch: Batch, rows: np.ndarray) -> dict[str, float]:
        apart = self._ranks.each(partial(self._apart, batch), rows, self._config.micro_batch)
        return {
            "logprob/mismatch_mean": float(apart.abs().mean()),
            "logprob/mismatch_max": float(apart.abs().max()),
            "logprob/mismatch_clip": float((apart.expm1().abs() > CLIP).double().mean()),
        }

    def _apart(self, batch: Batch, rows: np.ndarray) -> Tensor:
        """Σ log π − Σ log μ of each row, float64."""
        part = batch.part(rows)
        difference = self._frozen.log_prob(PROBE, *part).cpu() - batch.log_prob[rows]
        factors = self._frozen.adapter.factors(part[2])
        if factors is not None:
            difference = difference.masked_fill(~factors.cpu(), 0.0)
        return difference.double().sum(dim=-1)
