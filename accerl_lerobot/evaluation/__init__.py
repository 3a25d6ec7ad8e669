# SPDX-License-Identifier: Apache-2.0
"""Numbers one can trust: paired seeds, how many episodes, and how sure one may be."""
