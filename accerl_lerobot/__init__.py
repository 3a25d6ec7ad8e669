# SPDX-License-Identifier: Apache-2.0
"""Online reinforcement learning of LeRobot policies: asynchronous, exact and small."""

__version__ = "0.1.0"
