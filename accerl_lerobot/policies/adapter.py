# SPDX-License-Identifier: Apache-2.0
"""A LeRobot policy with its processors, a likelihood and a critic."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.base import Evaluation, PolicyAdapter, stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.family import Encoded, Family, Model
from accerl_lerobot.policies.processing import Processing, example_observations, example_requests
from accerl_lerobot.policies.teacher import PREFIX, Teacher
from accerl_lerobot.policies.value_head import Value, ValueHead

SELF_CHECK_TOLERANCE = 1e-5
"""Largest difference, in normalised action units, between our sampler and LeRobot's; fp32 noise is 1e-6."""


class LeRobotAdapter(PolicyAdapter):
    """Puts a model and a family together.

    Args:
        policy: the LeRobot policy; holds the weights that are exported.
        processing: its LeRobot processors.
        model: runs `policy`.
        family: samples and scores.
        value_head: the critic.
        precision: fp32, or bf16 for the network under autocast. Densities are computed in fp32 either way.
    """

    def __init__(
        self,
        policy: Any,
        processing: Processing,
        model: Model,
        family: Family,
        value_head: ValueHead,
        precision: str = "fp32",
    ) -> None:
        super().__init__()
        self.policy, self.processing, self.model = policy, processing, model
        self.device = next(policy.parameters()).device
        self.family, self.value_head = family.to(self.device), value_head.to(self.device)
        self.precision = precision
        self.policy.eval()
        self.teacher: Teacher | None = None
        """Acts in its place in part of the exploring episodes; given by `teacher.WithTeacher`."""

    def encode(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Encoded:
        """Reads raw observations, each (B, ...), and B instructions, for the family; differentiable."""
        return self.model.encode(self.processing.prepare(observations, tasks))

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Surrounds whatever runs the network."""
        if self.precision == "fp32":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    @property
    def actions(self) -> int | None:
        """See the base class."""
        return self.family.actions

    def factors(self, latent: dict[str, Tensor]) -> Tensor | None:
        """See the base class."""
        return self.family.factors(latent)

    @torch.no_grad()
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """See the base class; each decision's noise is its own request's, whatever batch it lands in."""
        arrays, tasks = stack_observations(requests)
        with self.autocast():
            encoded = self.encode(arrays, tasks)
            action = self.family.act(encoded, requests)
        value = self._value(encoded).mean.cpu().numpy()
        executed = action.chunk.float()
        if self.teacher is not None:
            executed = self.teacher.replace(executed, requests)
        chunk = self.processing.unnormalise(executed).cpu().numpy()
        latent = {k: v.cpu().numpy() for k, v in action.latent.items()}
        log_prob = action.log_prob.float().cpu().numpy()
        return [
            Decision(
                chunk=chunk[i],
                latent={k: v[i] for k, v in latent.items()},
                log_prob=log_prob[i],
                value=float(value[i]),
                version=version,
            )
            for i in range(len(requests))
        ]

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        """See the base class."""
        with self.autocast():
            encoded = self.encode(observations, tasks)
            score = self.family.score(encoded, {k: v.to(self.device) for k, v in latent.items()})
        return Evaluation(
            log_prob=score.log_prob,
            entropy=score.entropy,
            value=self._value(encoded),
        )

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """See the base class."""
        with self.autocast():
            encoded = self.encode(observations, tasks)
        return self._value(encoded).mean

    def trainable(self) -> dict[str, nn.Parameter]:
        """See the base class; `tuning` has decided what of the policy that is."""
        parts = {"policy": self.policy, "family": self.family, "value_head": self.value_head}
        named = {
            f"{part}.{name}": parameter
            for part, module in parts.items()
            for name, parameter in module.named_parameters()
            if parameter.requires_grad
        }
        teacher = {} if self.teacher is None else dict(self.teacher.named_parameters())
        return named | {PREFIX + name: parameter for name, parameter in teacher.items()}

    def example(self) -> tuple[dict[str, np.ndarray], Sequence[str], dict[str, Tensor]]:
        """See the base class."""
        observations, tasks = example_observations(self.policy.config, self.processing.rename_map)
        requests = example_requests(self.policy.config, self.processing.rename_map)
        latents = [decision.latent for decision in self.decide(requests, 0)]
        stacked = {k: torch.from_numpy(np.stack([latent[k] for latent in latents])) for k in latents[0]}
        return observations, tasks, stacked

    def copy_weights(self) -> Any:
        """See the base class."""
        from accerl_lerobot.policies.loading import copy_weights

        return copy_weights(self)

    def save(self, directory: Path, config: PolicyConfig, weights: Any) -> None:
        """See the base class; stock LeRobot loads it."""
        from accerl_lerobot.policies.loading import save_pretrained

        save_pretrained(self, directory, config, weights)

    @torch.no_grad()
    def self_check(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> float:
        """Largest difference between our sampler without exploration and LeRobot's own on equal noise.

        Raises:
            InputError: above `SELF_CHECK_TOLERANCE`, or LeRobot's internals have changed.
        """
        try:
            batch = self.processing.prepare(observations, tasks)
            difference = self.family.difference(batch, self.model.encode(batch))
        except (AttributeError, ImportError, KeyError, NotImplementedError, TypeError) as error:
            raise self._incompatible(f"cannot drive it ({type(error).__name__}: {error})") from error
        self.policy.reset()
        if not difference <= SELF_CHECK_TOLERANCE:
            raise self._incompatible(f"differs from its sampler by {difference:.2e}")
        return difference

    def _value(self, encoded: Encoded) -> Value:
        value: Value = self.value_head(encoded.features, encoded.mask)
        return value

    def _incompatible(self, what: str) -> InputError:
        import lerobot

        remedy = (
            f"our adapter of {self.policy.name} does not fit LeRobot {lerobot.__version__}: it {what}, so "
            "log-probs would be those of another policy; install the LeRobot version that this package pins"
        )
        return InputError("lerobot", lerobot.__version__, remedy)
