# SPDX-License-Identifier: Apache-2.0
"""Demonstrations: recorded from scripted experts, kept as LeRobotDatasets."""
