# SPDX-License-Identifier: Apache-2.0
"""A LeRobot policy of somebody else's package, with its likelihood for accerl_lerobot, and an objective.

LeRobot finds the policy by the names of the three modules, and imports an installed package whose name begins
with ``lerobot_policy_`` by itself.
"""

from lerobot_policy_mlp_flow.configuration_mlp_flow import MLPFlowConfig

__all__ = ["MLPFlowConfig"]

try:
    from accerl_lerobot.policies import register_policy
except ImportError:  # LeRobot alone runs it too
    pass
else:
    register_policy("mlp_flow", "lerobot_policy_mlp_flow.adapter:MLPFlow", "flow")
