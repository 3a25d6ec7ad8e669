# SPDX-License-Identifier: Apache-2.0
"""One device answers many worlds: requests are gathered, decided in one pass, and handed back in order."""
