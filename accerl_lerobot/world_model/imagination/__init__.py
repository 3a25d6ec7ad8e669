# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts of a policy in a world model."""
