# SPDX-License-Identifier: Apache-2.0
"""Success rates on fixed seeds with their intervals, and pictures of them."""
