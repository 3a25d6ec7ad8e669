# SPDX-License-Identifier: Apache-2.0
"""Held-out evaluation of world models."""
