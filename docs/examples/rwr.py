# SPDX-License-Identifier: Apache-2.0
"""An off-policy algorithm of your own: reward-weighted regression (Peters and Schaal, ICML 2007)."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from accerl_lerobot.algorithms import AlgorithmConfig, OffPolicyConfig
from accerl_lerobot.algorithms.off_policy import OffPolicyUpdate
from accerl_lerobot.config.ranges import Range


@AlgorithmConfig.register_subclass("rwr")
@dataclass(frozen=True, kw_only=True)
class RWRConfig(OffPolicyConfig):
    update = "rwr:RWRUpdate"

    beta: Annotated[float, Range("(0, inf)")] = 0.25
    """Temperature of the discounted return."""


class RWRUpdate(OffPolicyUpdate):
    def __init__(self, adapter, algorithm, config):
        super().__init__(adapter, algorithm, config)
        self.beta = algorithm.beta

    def imitable(self):
        return np.arange(len(self.memory))  # decisions of failures, too

    def losses(self, rows, encoded, imitation):
        weight = (self.tensor("return", rows) / self.beta).exp()
        return {"imitation_loss": (weight * imitation).mean() / weight.mean()}
