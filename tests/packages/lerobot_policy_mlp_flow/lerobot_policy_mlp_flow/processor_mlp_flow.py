# SPDX-License-Identifier: Apache-2.0
"""Processors of ``mlp_flow``: LeRobot's normalisation, as ACT has it."""

from typing import Any

from lerobot.policies.act.processor_act import make_act_pre_post_processors

from lerobot_policy_mlp_flow.configuration_mlp_flow import MLPFlowConfig


def make_mlp_flow_pre_post_processors(
    config: MLPFlowConfig, dataset_stats: dict[str, Any] | None = None
) -> Any:
    return make_act_pre_post_processors(config, dataset_stats)  # reads no field that is ACT's own
