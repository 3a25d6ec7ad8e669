# SPDX-License-Identifier: Apache-2.0
"""Runs: the two engines, the workers they supervise, the machines they use, and the training loop."""
