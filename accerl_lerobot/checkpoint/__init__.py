# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: their layout, the formats in them, and checks of files from elsewhere."""
