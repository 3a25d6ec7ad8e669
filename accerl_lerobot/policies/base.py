# SPDX-License-Identifier: Apache-2.0
"""The engine's interface to a policy: π(chunk | observation) with a density, and V(observation).

An adapter wraps one LeRobot policy with its processors. `decide` acts, `evaluate` re-scores what was stored;
both run the same code on the same weights, so the ratio at equal weights is 1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.tensors import in_parts, part_of, whole
from accerl_lerobot.experience import TASK, Decision, Request
from accerl_lerobot.policies.value_head import Value

if TYPE_CHECKING:
    from accerl_lerobot.policies.config import PolicyConfig

OBS_STATE = "observation.state"


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A batch of stored decisions under the current weights."""

    log_prob: Tensor
    """(B, L), same factors as `Decision.log_prob`."""
    entropy: Tensor
    """(B,)."""
    value: Value
    """Values of B observations."""


class PolicyAdapter(nn.Module, ABC):
    """One policy as the engine sees it: stochastic, with a density and a critic.

    `adapter.LeRobotAdapter` is the one that runs use; tests have small ones of their own.
    """

    device: torch.device

    @property
    @abstractmethod
    def actions(self) -> int | None:
        """Into how many equal groups of consecutive log-prob factors the L fall, one per action of the chunk.

        None if they do not align with actions: ratios per action are refused then.
        """

    def factors(self, latent: dict[str, Tensor]) -> Tensor | None:
        """bool (B, L), False for log-prob factors that a latent does not have, such as tokens after the
        terminator; None if all latents have all of them.

        Args:
            latent: each (B, ...), as `decide` returned them.
        """
        return None

    @abstractmethod
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """Acts on a batch, without gradient. Answers in the order of the requests."""

    @abstractmethod
    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        """Re-scores stored latents, differentiably.

        Args:
            observations: each (B, ...), raw, as in `Segment.observations`.
            tasks: B instruction texts.
            latent: each (B, ...), as `decide` returned them.
        """

    @abstractmethod
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """V only, (B,), without gradient."""

    @abstractmethod
    def example(self) -> tuple[dict[str, np.ndarray], Sequence[str], dict[str, Tensor]]:
        """A few decisions as `evaluate` takes them, for those who want to see what it runs."""

    @abstractmethod
    def trainable(self) -> dict[str, nn.Parameter]:
        """Parameters that the trainer updates and publishes, by name; the critic's begin with
        ``value_head.``"""

    @abstractmethod
    def copy_weights(self) -> Any:
        """A copy of what `save` writes, which may go on being learnt."""

    @abstractmethod
    def save(self, directory: Path, config: PolicyConfig, weights: Any) -> None:
        """Writes ``pretrained_model``.

        Args:
            directory: created if it is missing.
            config: what the adapter was loaded by.
            weights: from `copy_weights`.
        """

    def load_trainable(self, tensors: dict[str, np.ndarray]) -> None:
        """Copies published weights in place: all of them, or none when they do not fit.

        Args:
            tensors: by name, all that `trainable` has.

        Raises:
            ValueError: names or shapes differ from `trainable`.
        """
        parameters = self.trainable()
        if parameters.keys() != tensors.keys():
            names = sorted(parameters.keys() ^ tensors.keys())[:4]
            raise ValueError(f"published weights differ by name: {names}")
        for name, parameter in parameters.items():
            if tuple(parameter.shape) != tensors[name].shape:
                raise ValueError(
                    f"published {name} has shape {tensors[name].shape}, not {tuple(parameter.shape)}"
                )
        with torch.no_grad():
            for name, parameter in parameters.items():
                _copy(parameter, tensors[name])

    def view_trainable(self) -> dict[str, np.ndarray]:
        """`trainable` as NumPy arrays, to be copied before the next update.

        On a CPU they are the parameters' own memory, else copies of them.
        """
        named = {name: whole(parameter.detach()) for name, parameter in self.trainable().items()}
        return {name: tensor.to("cpu", torch.float32).numpy() for name, tensor in named.items()}

    def export_trainable(self) -> dict[str, np.ndarray]:
        """A copy of `trainable` as NumPy arrays, safe to hand to another thread."""
        return {name: view.copy() for name, view in self.view_trainable().items()}


def _copy(parameter: nn.Parameter, tensor: np.ndarray) -> None:
    """Arrays that were received are read-only, which torch cannot express: NumPy copies where it can."""
    if parameter.device.type == "cpu" and parameter.dtype == torch.float32 and not in_parts(parameter):
        np.copyto(parameter.detach().numpy(), tensor)
    else:
        parameter.copy_(part_of(torch.tensor(tensor), parameter))


def stack_observations(requests: Sequence[Request]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Batches raw observations: each array (B, ...), and the B task texts."""
    keys = [k for k in requests[0].observation if k != TASK]
    arrays = {k: np.stack([r.observation[k] for r in requests]) for k in keys}
    return arrays, [str(r.observation[TASK]) for r in requests]
