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
"""A small success model as a LeRobot reward model: did a chunk achieve the task, and how far along is it?

LeRobot's own ``reward_classifier`` trains the last layers only and fetches the others; the large ones are for
inference. This one is a convolutional network of 0.3 million weights that looks at the frames before and
after a chunk, so it can be trained beside a policy.

Example:
    ::

        lerobot-train --reward_model.discover_packages_path=accerl_lerobot.world_model.success_plugin \\
          --reward_model.type=success_pairs --reward_model.push_to_hub=false --dataset.repo_id=...

Importing this registers the type.
"""

from accerl_lerobot.world_model.success_plugin.configuration_success_pairs import SuccessPairsConfig

__all__ = ["SuccessPairsConfig"]
