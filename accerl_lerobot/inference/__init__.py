# SPDX-License-Identifier: Apache-2.0
"""Batched inference: requests of many environments are decided in one forward pass and answered in order."""
