# SPDX-License-Identifier: Apache-2.0
"""A run's episodes as a LeRobotDataset."""
