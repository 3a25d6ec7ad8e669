# SPDX-License-Identifier: Apache-2.0
"""Recipes and command lines: fields with their ranges, how they are read, and their help."""
