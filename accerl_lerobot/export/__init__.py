# SPDX-License-Identifier: Apache-2.0
"""A run's episodes and dreams as LeRobotDatasets."""
