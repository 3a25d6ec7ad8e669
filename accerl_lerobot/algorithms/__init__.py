# SPDX-License-Identifier: Apache-2.0
"""The objectives as the papers state them: typed tensors in, loss and diagnostics out.

To add one: write a file with its config (a `RatioConfig`, registered under `AlgorithmConfig`) and its
function, then add one line to `ALGORITHMS`. No file that this package imports pulls in torch, so a run can be
parsed before torch is loaded.

Order of use inside an update::

    advantages, returns = gae(...)                    # advantages.py, with values of the current critic
    advantages = normalise(advantages, moments)       # moments summed over all ranks
    output = compute_loss(LossInputs(...), config)    # one file per algorithm
    output.loss.backward()
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from accerl_lerobot.algorithms.chunk_critic import ChunkCriticConfig
from accerl_lerobot.algorithms.contract import (
    AlgorithmConfig,
    Level,
    LossInputs,
    OffPolicyConfig,
    RatioConfig,
    check_level,
)
from accerl_lerobot.algorithms.losses import (
    AWRConfig,
    DecoupledConfig,
    GIPOConfig,
    ImportanceConfig,
    PPOConfig,
    SAPOConfig,
    awr_loss,
    decoupled_loss,
    gipo_loss,
    importance_loss,
    ppo_loss,
    sapo_loss,
)
from accerl_lerobot.algorithms.objective import LossOutput
from accerl_lerobot.algorithms.self_imitation import SelfImitationConfig

ALGORITHMS: dict[str, Callable[[LossInputs, Any], LossOutput]] = {
    "awr": awr_loss,
    "decoupled": decoupled_loss,
    "gipo": gipo_loss,
    "is": importance_loss,
    "ppo": ppo_loss,
    "sapo": sapo_loss,
}
"""Name on the command line → loss; the second argument is the config registered under the same name.
Each `OffPolicyConfig` has an update of its own instead, see `trainer.off_policy`."""


def compute_loss(inputs: LossInputs, config: RatioConfig) -> LossOutput:
    """The loss that belongs to `config`.

    Raises:
        KeyError: `config` is registered but has no line in `ALGORITHMS`.
    """
    return ALGORITHMS[config.type](inputs, config)


__all__ = [
    "ALGORITHMS",
    "AWRConfig",
    "AlgorithmConfig",
    "ChunkCriticConfig",
    "DecoupledConfig",
    "GIPOConfig",
    "ImportanceConfig",
    "Level",
    "LossInputs",
    "LossOutput",
    "OffPolicyConfig",
    "PPOConfig",
    "RatioConfig",
    "SAPOConfig",
    "SelfImitationConfig",
    "awr_loss",
    "check_level",
    "compute_loss",
    "decoupled_loss",
    "gipo_loss",
    "importance_loss",
    "ppo_loss",
    "sapo_loss",
]
