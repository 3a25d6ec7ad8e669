# SPDX-License-Identifier: Apache-2.0
"""Steps environments, asks the policy, cuts episodes into segments."""
