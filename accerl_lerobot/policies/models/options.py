# SPDX-License-Identifier: Apache-2.0
"""Options that several of LeRobot's flow policies share in their configs."""

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
