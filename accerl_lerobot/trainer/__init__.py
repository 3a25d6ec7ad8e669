# SPDX-License-Identifier: Apache-2.0
"""The process that makes the updates, and its other ranks."""
