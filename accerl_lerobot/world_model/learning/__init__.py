# SPDX-License-Identifier: Apache-2.0
"""Training of world models and success models, before a run and during it."""
