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
"""What several flow policies of LeRobot call alike in their configs."""

from __future__ import annotations

from typing import Any

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.flow import FlowShape


def flow_shape(config: Any, num_steps: int) -> FlowShape:
    """The sizes in a LeRobot flow policy's config.

    Args:
        config: LeRobot's.
        num_steps: what this policy type calls its number of denoising steps.
    """
    return FlowShape(
        num_steps=num_steps,
        chunk_size=config.chunk_size,
        executed=config.n_action_steps,
        padded_dim=config.max_action_dim,
        action_dim=config.action_feature.shape[0],
    )


def refuse_options(config: Any) -> None:
    """Refuses what would change the sampler's density behind our back.

    Raises:
        InputError: real-time chunking or compilation is on.
    """
    if config.rtc_config is not None and config.rtc_config.enabled:
        raise InputError(
            "policy.rtc_config.enabled",
            True,
            "real-time chunking changes the sampler's density; turn it off",
        )
    if config.compile_model:
        raise InputError(
            "policy.compile_model",
            True,
            "a compiled sampler rounds unlike the re-scoring pass; set it to false in config.json",
        )
