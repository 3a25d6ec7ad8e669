# SPDX-License-Identifier: Apache-2.0
"""A run's episodes, real and imagined, as LeRobotDatasets."""
