# SPDX-License-Identifier: Apache-2.0
"""Any LeRobot policy seen as π(chunk | observation) and V(observation); one file per family of likelihood."""

from accerl_lerobot.policies.config import register_policy

__all__ = ["register_policy"]
