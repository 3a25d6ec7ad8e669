# SPDX-License-Identifier: Apache-2.0
"""From worker to worker of one node: a message there, its answer back, whatever carries them."""
