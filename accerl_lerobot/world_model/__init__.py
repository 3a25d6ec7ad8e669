# SPDX-License-Identifier: Apache-2.0
"""Imagination: environments that are learnt from experience, with the contract of real ones."""
