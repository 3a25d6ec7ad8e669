# SPDX-License-Identifier: Apache-2.0
"""The policy type ``smolvla_bins``, a LeRobot plugin: a chunk as one token per action dimension.

The action head of OpenVLA-OFT's discrete variant (Kim et al., arXiv 2502.19645) and of AcceRL
(arXiv 2603.18464) on SmolVLA's backbone: the bins of all action dimensions of a chunk in one parallel pass,
with a vocabulary of nothing but bins. Importing this registers the type, in `lerobot-train` by
``--policy.discover_packages_path=accerl_lerobot.policies.bins_plugin``.
"""

from accerl_lerobot.policies.bins_plugin.configuration_smolvla_bins import SmolVLABinsConfig

__all__ = ["SmolVLABinsConfig"]
