# SPDX-License-Identifier: Apache-2.0
"""Imagination: worlds that are learnt from experience, with the contract of real ones."""
