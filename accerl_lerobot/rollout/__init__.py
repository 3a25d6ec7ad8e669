# SPDX-License-Identifier: Apache-2.0
"""Steps worlds, asks the policy, cuts episodes into segments."""
