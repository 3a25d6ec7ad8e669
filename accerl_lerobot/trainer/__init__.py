# SPDX-License-Identifier: Apache-2.0
"""One update, and the process that repeats it."""
