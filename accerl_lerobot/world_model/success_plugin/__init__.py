# SPDX-License-Identifier: Apache-2.0
"""A small success model as a LeRobot reward model: did a chunk achieve the task, and how far along is it?

A convolutional network of 0.3 million weights looks at the frames before and after a chunk, so it can be
trained beside a policy. Importing this registers the type::

    lerobot-train --reward_model.discover_packages_path=accerl_lerobot.world_model.success_plugin \\
      --reward_model.type=success_pairs --reward_model.push_to_hub=false --dataset.repo_id=...
"""

from accerl_lerobot.world_model.success_plugin.configuration_success_pairs import SuccessPairsConfig

__all__ = ["SuccessPairsConfig"]
