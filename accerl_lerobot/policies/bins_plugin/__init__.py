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
"""The policy type ``smolvla_bins``, a LeRobot plugin: a chunk as one token per action dimension.

The action head of OpenVLA-OFT's discrete variant (Kim et al., arXiv 2502.19645) and of AcceRL
(arXiv 2603.18464) on SmolVLA's backbone: the bins of all action dimensions of a chunk in one parallel pass,
with a vocabulary of nothing but bins.

Example:
    ::

        lerobot-train --policy.discover_packages_path=accerl_lerobot.policies.bins_plugin \\
          --policy.type=smolvla_bins --policy.push_to_hub=false --dataset.repo_id=...

Importing this registers the type.
"""

from accerl_lerobot.policies.bins_plugin.configuration_smolvla_bins import SmolVLABinsConfig

__all__ = ["SmolVLABinsConfig"]
