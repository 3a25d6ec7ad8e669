# SPDX-License-Identifier: Apache-2.0
"""LeRobot's processors of it: batches go to the device as they are, frames are scaled in the model."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    DeviceProcessorStep,
    IdentityProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)

from accerl_lerobot.world_model.success_plugin.configuration_success_pairs import SuccessPairsConfig


def make_success_pairs_pre_post_processors(
    config: SuccessPairsConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Found by LeRobot under this name."""
    return (
        PolicyProcessorPipeline(
            steps=[DeviceProcessorStep(device=config.device or "cpu")], name="success_pairs_preprocessor"
        ),
        PolicyProcessorPipeline(
            steps=[DeviceProcessorStep(device="cpu"), IdentityProcessorStep()],
            name="success_pairs_postprocessor",
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )
