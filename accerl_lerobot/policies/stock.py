# SPDX-License-Identifier: Apache-2.0
"""LeRobot's policies of any type, which act here as they do in LeRobot and do not learn.

A decision is one call of LeRobot's `select_action`, for one env step. A policy may keep observations, a
chunk or a plan from one call to the next. Each episode has a policy object of its own, which shares the
weights with the others.
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.adapter import (
    Evaluation,
    PolicyAdapter,
    Processing,
    autocast_on,
    example_requests,
    stack_observations,
)  # fmt: skip
from accerl_lerobot.policies.config import PolicyConfig, no_likelihood
from accerl_lerobot.seeds import episode_of

EPISODES = 256  # episodes whose state is kept; the one that acted longest ago goes first
SHARED = ("config", "_modules", "_parameters", "_buffers")
"""Attributes of a policy that all episodes have in common."""


class StockAdapter(PolicyAdapter):
    """A LeRobot policy that acts by its own `select_action`."""

    def __init__(self, policy: Any, processing: Processing, precision: str = "fp32") -> None:
        super().__init__()
        self.policy, self.processing, self.precision = policy.eval(), processing, precision
        self.device = next(policy.parameters()).device
        self._episodes: OrderedDict[tuple[int, str], Any] = OrderedDict()

    @torch.no_grad()
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        if any(request.explore for request in requests):
            self._refuse()
        return [self._decide(request, version) for request in requests]

    def _decide(self, request: Request, version: int) -> Decision:
        arrays, tasks = stack_observations([request])
        policy = self._policy_of(episode_of(request.noise_seed), tasks[0])
        # LeRobot's samplers draw from the global generator: here from the request's seed.
        with torch.random.fork_rng(), autocast_on(self.device, self.precision):
            torch.manual_seed(request.noise_seed % 2**63)
            action = policy.select_action(self.processing.prepare(arrays, tasks))
        chunk = self.processing.unnormalise(action.float()).cpu().numpy()
        return Decision(chunk=chunk, latent={}, log_prob=np.zeros(1, np.float32), version=version)

    def _policy_of(self, episode: int, task: str) -> Any:
        """The episode's policy object, which is new and reset if this is its first decision."""
        if (policy := self._episodes.get((episode, task))) is None:
            policy = copy.copy(self.policy)
            own = {name: value for name, value in vars(policy).items() if name not in SHARED}
            shared = (*policy.modules(), *policy.parameters(), *policy.buffers())
            vars(policy).update(copy.deepcopy(own, {id(part): part for part in shared}))
            policy.reset()
            self._episodes[episode, task] = policy
        self._episodes.move_to_end((episode, task))
        if len(self._episodes) > EPISODES:
            self._episodes.popitem(last=False)
        return policy

    def example_requests(self) -> list[Request]:
        """Two requests with random observations for this policy, which do not explore."""
        return example_requests(self.policy.config, self.processing.rename_map, explore=False)

    def trainable(self) -> dict[str, nn.Parameter]:
        return {f"policy.{name}": parameter for name, parameter in self.policy.named_parameters()}

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        self._refuse()

    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        self._refuse()

    def example(self) -> tuple[dict[str, np.ndarray], Sequence[str], dict[str, Tensor]]:
        self._refuse()

    def copy_weights(self) -> Any:
        self._refuse()

    def save(self, directory: Path, config: PolicyConfig, weights: Any) -> None:
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise no_likelihood(self.policy.config.type)
