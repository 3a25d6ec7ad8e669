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
"""What every objective receives and returns, and the settings all of them share.

Shape letters: N decisions of a batch, L log-prob factors of one decision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import draccus

from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

Level = Literal["action", "chunk"]


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfig(draccus.ChoiceRegistry):
    """Base of every algorithm config; subclasses register under the name given on the command line.

    Example:
        >>> draccus.decode(AlgorithmConfig, {"type": "gipo", "sigma": 0.5}).type
        'gipo'
    """

    gamma: float = 0.99
    """Discount per decision (not per env step), in [0, 1]."""
    lam: float = 0.95
    """λ of GAE per decision, in [0, 1]: 0 trusts the critic, 1 the observed rewards."""
    advantage: Literal["gae", "group"] = "gae"
    """``gae``: from the critic. ``group``: relative to other episodes from the same start, stamped on
    segments by the rollout worker; V is not used then, and `value_coef` may as well be 0."""
    level: Level = "action"
    """What one importance ratio covers: each of the L factors, or their product over the whole ``chunk``."""
    value_coef: float = 0.5
    """Weight of the mean squared error of V against the returns, ≥ 0."""
    kl_coef: float = 0.0
    """Weight of KL(μ‖π), the distance from the behaviour policy, ≥ 0."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus, ≥ 0."""

    @property
    def type(self) -> str:
        """The registered name."""
        return str(self.get_choice_name(self.__class__))

    def __post_init__(self) -> None:
        for name in ("gamma", "lam"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"algorithm.{name}", getattr(self, name), "use a number from 0 to 1")
        for name in ("value_coef", "kl_coef", "entropy_coef"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(f"algorithm.{name}", getattr(self, name), "use a finite number, 0 or larger")
        if self.level not in ("action", "chunk"):
            raise InputError("algorithm.level", self.level, "use action or chunk")
        if self.advantage not in ("gae", "group"):
            raise InputError("algorithm.advantage", self.advantage, "use gae or group")


@dataclass(frozen=True, kw_only=True)
class LossInputs:
    """One batch of decisions, re-scored by the current policy."""

    log_prob_new: Tensor
    """(N, L), log π of the stored latents under the current weights; carries gradient."""
    log_prob_old: Tensor
    """(N, L), log μ as the behaviour policy stored it.

    A factor that does not exist, such as a token after the terminator, is 0 in both.
    """
    advantage: Tensor
    """(N,), normalised by the caller."""
    value: Tensor
    """(N,), V of the current critic; carries gradient."""
    returns: Tensor
    """(N,), what V is regressed to."""
    entropy: Tensor
    """(N,), entropy of π at each decision; carries gradient if it is to be used."""
    mask: Tensor | None = None
    """bool (N,), False for padding, whose content is never looked at (it may be NaN). None: all are valid."""

    def __post_init__(self) -> None:
        n = self.log_prob_new.shape[0]
        if self.log_prob_new.dim() != 2 or self.log_prob_new.shape != self.log_prob_old.shape:
            new, old = tuple(self.log_prob_new.shape), tuple(self.log_prob_old.shape)
            raise ValueError(f"log_prob_new {new} and log_prob_old {old}: both must be (N, L)")
        for name in ("advantage", "value", "returns", "entropy", "mask"):
            tensor: Tensor | None = getattr(self, name)
            if tensor is not None and tuple(tensor.shape) != (n,):
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, not ({n},)")


@dataclass(frozen=True, kw_only=True)
class LossOutput:
    """What an update needs and what it logs."""

    loss: Tensor
    """(), call ``backward`` on it."""
    metrics: dict[str, Tensor]
    """Scalars without gradient, still on the device; `diagnostics` explains each."""
