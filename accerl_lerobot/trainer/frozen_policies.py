# SPDX-License-Identifier: Apache-2.0
"""Frozen copies of the policy's weights, and log-probs under them.

``reference``  the weights that RL began with, for KL(π‖π_ref)
``proximal``   those of a few updates ago, for decoupled PPO
``probe``      those of one published version, see `probe`

A copy holds the policy's trainable weights, not the critic's, on the same device and in the same parts.
Nobody pays for a copy that nobody takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.checkpoint.tensors import part_of, whole
from accerl_lerobot.policies.adapter import PolicyAdapter
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
