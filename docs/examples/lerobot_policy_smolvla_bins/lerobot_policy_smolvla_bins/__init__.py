# SPDX-License-Identifier: Apache-2.0
"""The policy type ``smolvla_bins``, a LeRobot plugin: a chunk as one token per action dimension.

The action head of OpenVLA-OFT's discrete variant (Kim et al., arXiv 2502.19645) and of AcceRL
(arXiv 2603.18464) on SmolVLA's backbone: the bins of all action dimensions of a chunk in one parallel pass,
with a vocabulary of nothing but bins. LeRobot imports an installed package of this name by itself, and that
registers the type; `adapter` has its likelihood.
"""

from lerobot_policy_smolvla_bins.configuration_smolvla_bins import SmolVLABinsConfig

__all__ = ["SmolVLABinsConfig"]

try:
    from accerl_lerobot.policies import register_policy
except ImportError:  # LeRobot alone runs it too
    pass
else:
    register_policy("smolvla_bins", "lerobot_policy_smolvla_bins.adapter:SmolVLABins", "tokens")
